"""The test of an agent for one queue on rows that no training saw, and the page of the one that ships.

    python -m studies.learned --data DIR
    python -m studies.learned runs/new/learned.safetensors --against agents/pretrained/learned.safetensors --data DIR
    python -m studies.learned --data DIR --planner --out results/agents.md

Without a file it judges the agent that ships. ``--against`` names another agent of any kind, with which the first is
compared in pairs. ``--planner`` adds the hindsight planner. ``--only task,lte`` judges on these families alone, and
``unequal`` is judged only so. ``studies.families`` says what the rows are, ``studies.judging`` what the numbers are.
Bounds and the planner's runs are kept in ``--folder``: a stopped run goes on, and a second agent is only played.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.tasks import FAMILY_NAMES, Names
from bufgym import policies
from bufgym.benchmark.bootstrap import written as parts_of
from bufgym.policies import Policy, weights
from bufgym.policies.past_inputs import N_PAST
from bufgym.policies.rule_inputs import N_INPUTS
from bufgym.policies.ruled_network import EVEN_US, PER_CANDIDATE, QUEUE, RuledWeights
from bufgym.utils.errors import BufgymError
from studies import families, judging
from studies.causal_planner import NAME
from studies.judging import Row
from studies.page import command, publish

SHIPPED = Path("agents/pretrained/learned.safetensors")
FOLDER = Path("runs/judged")
"""Where bounds and the planner's runs are kept."""
TRAINING = "python train.py hindsight --families all --data DIR --steps 4000000 --seed 1"

PAGE = """# learned

**One network for every link**: at every arrival `learned` chooses among a few ordered candidates and the decision of
the rule `gap-price`. It was made by `{made}`{seed}.

- *Sees* the {k} candidates that are cheapest to drop and the head, each by {per_candidate} numbers, and {queue} numbers
  of queue and link (`bufgym.model.observe.candidates`). Beside these it sees the rule's {rule} inputs
  (`bufgym.policies.rule_inputs.INPUTS`), {past} of the past of link and camera and of the stream's end, where the
  robot was told it (`bufgym.policies.past_inputs`), whether there is room, log(L / 8), and which actions are the
  rule's: {seen} numbers in all. Where there is no odometry, x is the frame's index.
- *Does* one of {actions} actions: accept, or drop the cheapest where there is no room; drop one of the candidates or
  the head; do what `gap-price` does. It is asked at every arrival, and takes the action with the highest output among
  the actions that are offered.
- *Leaves to the rule* steady links whose rate has not changed by 10 % for {even:.0f} seconds, messages in bursts or of
  unequal bytes, and a V that is not exponential.
- *Is* a perceptron with hidden layers of {widths}, by {activation}.
- *Falls short* of a rule, on a row below, by an interval without zero: {short}.
- *Trained* on {families} families of links and streams at once. [Training](../docs/guide/training.md) says how.

"""
TEST = """```
{command}
```

Shares of AFR's regret: 0 is the clairvoyant, 1 AFR, less is better. A row's share is a ratio of sums; `random`, whose
runs differ in everything, has a mean of ratios. Neither training nor validation saw these links or motions.

- `task` has the links that the task holds out.
- `frames` has the default frames of 4.6 MB over new links of the six ways of moving that training knows, `fresh` over
  links of seven others.
- Each run has a jitter, an offset and a motion of its own.
- In brackets are 95 % intervals over links: all runs of a link are drawn together.
- `mean` is the mean of the rows.

{shares}

How far `{agent}` lies above the rule that leaves least on the same row{others}, paired. Below zero it is better.
It is better than the best rule by an interval without zero on {better} of {rows} rows, and worse {worse}.

{above}

Parts of rows:

{parts}

**Told when a stream ends** (`tells_duration=True`), `{agent}` leaves on the same runs:

{told}
"""
PLANNER = """
The hindsight planner (`studies/causal_planner.py`) on some of these runs. It knows the law of links and motion, and
`learned` does not. It is slow: [truth](../docs/guide/truth.md#what-an-agent-without-the-future-can-reach) says more.

{shares}

{above}
"""


def named(files: Sequence[Path]) -> dict[str, Policy]:
    """The agents by the names of their files, by their paths where two have one name."""
    stems = [file.stem for file in files]
    names = [file.stem if stems.count(file.stem) == 1 else str(file) for file in files]
    return dict(zip(names, map(policies.load, files), strict=True))


def tables(
    files: Sequence[Path],
    against: Path | None,
    makers: Mapping[str, families.Maker],
    folder: Path,
    planner: bool,
    line: str,
) -> tuple[str, str]:
    """What the test found, and on which rows the first agent falls short of a rule; ``line`` is the command."""
    agents = named([*files, *([against] if against else [])])
    agent, *others = agents
    rows, parts, runs = judging.judged_all(makers, folder, {**judging.rules(), **agents})
    columns = [*judging.RULES, *agents]
    better = [row for row in rows if row.above(agent, row.best_rule).high < 0]
    worse = [row for row in rows if row.above(agent, row.best_rule).low > 0]
    every = [*rows, judging.mean_of(rows)]
    text = TEST.format(
        command=line,
        agent=agent,
        others="".join(f", and above `{other}`" for other in others),
        better=len(better),
        rows=len(rows),
        worse=f"on {len(worse)}" if worse else "on none",
        shares=judging.shares_table(every, columns, agent),
        above=judging.above_table(every, agent, others),
        parts=judging.above_table(parts, agent, others) if parts else "none",
        told=judging.told_table(judging.told(makers, folder, agents[agent])),
    )
    if planner:
        found = list(judging.planned(runs, folder, {**judging.rules(), **agents}))
        shares = judging.shares_table(found, [NAME, *columns], agent)
        text += PLANNER.format(shares=shares, above=judging.above_table(found, NAME, [agent]))
    return text, ", ".join(_short(row, agent) for row in worse) or "nowhere here"


def _short(row: Row, agent: str) -> str:
    return f"`{row.best_rule}` on {row.name} ({' '.join(parts_of(row.above(agent, row.best_rule), '{:+.3f}'.format))})"


def _described(network: RuledWeights, notes: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says of the network and its making."""
    widths = [len(bias) for _, bias in network.layers]
    return {
        "made": notes.get("training", TRAINING),
        "seed": "".join(f", seed {seed}" for seed in notes.get("seeds", [])[:1]),
        "families": len(FAMILY_NAMES),
        "k": network.candidates,
        "per_candidate": PER_CANDIDATE,
        "queue": QUEUE,
        "rule": N_INPUTS,
        "past": N_PAST,
        "seen": len(network.layers[0][0]),
        "actions": widths[-1],
        "even": EVEN_US / 1e6,
        "widths": " and ".join(map(str, widths[:-1])),
        "activation": network.activation,
    }


def _line(
    files: Sequence[Path], against: Path | None, data: str | None, only: Sequence[str], planner: bool, out: Path | None
) -> str:
    """The command that makes the page again."""
    words = ["python -m studies.learned", *(map(str, files) if list(files) != [SHIPPED] else ())]
    words += [f"--against {against}"] * bool(against) + ["--data DIR"] * bool(data)
    words += [f"--only {','.join(only)}"] * bool(only) + ["--planner"] * planner + [f"--out {out}"] * bool(out)
    return " ".join(words)


def main(
    *files: Path,
    against: Path | None = None,
    data: str | None = None,
    only: Names = (),
    planner: bool = False,
    folder: Path = FOLDER,
    out: Path | None = None,
) -> None:
    """Judge agents for one queue beside the rules, on rows that no training saw.

    Args:
        files: agents, the one that is judged first; by default the one that ships.
        against: another agent, of any kind, with which the first is compared too.
        data: folder of recordings, to judge on recorded uplinks as well.
        only: families to judge on, such as task,lte; by default all but unequal, whose bounds take minutes.
        planner: whether the hindsight planner plays as well, on some runs of task and lte.
        folder: where bounds and the planner's runs are kept.
        out: a Markdown file for the page of the agent that ships, such as results/agents.md.
    """
    chosen, makers = files or (SHIPPED,), families.chosen(data, only)
    network, notes = weights.read(chosen[0]) if out else (None, {})
    if out and not isinstance(network, RuledWeights):
        raise BufgymError(f"{chosen[0]}: is no network among candidates and the decision of gap-price")
    line = _line(chosen, against, data, only, planner, out)
    text, short = tables(chosen, against, makers, folder, planner, line)
    if isinstance(network, RuledWeights):
        text = PAGE.format(**_described(network, notes), short=short) + text
    publish(text, out)


if __name__ == "__main__":
    command(main)
