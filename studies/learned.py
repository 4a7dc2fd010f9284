"""The page of the shipped agent: `learned` beside the rules on links that taught it nothing.

python -m studies.learned agents/pretrained/learned.safetensors --split test --data DIR --out docs/agents.md

Several files are compared, such as the seeds of ``python train.py hindsight --families all --seeds 3``; the page tells
of the first. ``--against FILE`` adds another agent, such as an older one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from agents.families import Family, Run
from agents.tasks import FAMILY_NAMES, Names
from bufgym import policies
from bufgym.policies import Policy, weights
from bufgym.policies.rule_inputs import N_INPUTS
from bufgym.policies.ruled_network import EVEN_US, PER_CANDIDATE, QUEUE, RuledWeights
from bufgym.utils.errors import BufgymError
from studies.families import families
from studies.page import command, publish, table, written

FOLDER = Path("runs/families")
"""Where the bounds of the families are kept."""
TRAINING = "python train.py hindsight --families all --steps 4000000 --validate-every 400000 --seed 1"
RULES = ("target-gap", "price-dp", "gap-price")


def split_up(found: dict[str, list[Run]]) -> dict[str, list[Run]]:
    """The families, that of the default frames by L."""
    shown: dict[str, list[Run]] = {}
    for name, runs in found.items():
        parts = {L: [run for run in runs if run["capacity"] == L] for L in sorted({run["capacity"] for run in runs})}
        shown |= {f"{name}, L = {L}": own for L, own in parts.items()} if name == "default-frames" else {name: runs}
    return shown


PAGE = """# learned

**One network for every link**: at every arrival `learned` chooses among a few ordered candidates and the decision of
the rule `gap-price`. It was made by `{command}`{seed}.

- *Sees* the {k} candidates that are cheapest to drop and the head, each by {per_candidate} numbers, and {queue} numbers
  of queue and link (`bufgym.model.observe.candidates`). Beside these it sees the rule's {rule} inputs
  (`bufgym.policies.rule_inputs.INPUTS`), whether there is room, log(L / 8), and which actions are the rule's: {seen}
  numbers in all. Where there is no odometry, x is the frame's index.
- *Does* one of {actions} actions: accept, or drop the cheapest where there is no room; drop one of the candidates or
  the head; do what `gap-price` does. It is asked at every arrival, and takes the action with the highest output among
  the actions that are offered.
- *Keeps to the rule* on a link that has not varied for {even:.0f} seconds: there the rule alone is offered.
- *Is* a perceptron with hidden layers of {widths}, by {activation}.
- *Sizes differ*: there it does what `gap-price` does. `bufgym bench --policies gap-price,learned --sizes jpeg` says
  whether their rows are the same.
- *Falls short* of a rule, by the intervals below: {short}.
- *Trained* on {families} families of links and streams at once. [Training](guide/training.md) says how.

```
{training}
python -m studies.learned {files} --split {split}{more} --out docs/agents.md
```

Shares of AFR's regret on the {split} links, which are drawn apart from the training links. Less is better. A family's
share is a ratio of sums; `random`, whose runs differ in everything, has a mean of ratios.

{shares}

How far `learned` lies above {others}, with 95 % intervals over links:

{less}
"""


def page(
    files: Sequence[Path], split: str, data: str | None, against: Path | None = None, leave_out: Sequence[str] = ()
) -> str:
    """The page of these agents, the one to ship first: its families, and its differences to rules and another agent."""
    network, notes = weights.read(files[0])
    if not isinstance(network, RuledWeights):
        raise BufgymError(f"{files[0]}: is no network among candidates and the decision of gap-price")
    rivals: dict[str, Policy] = {name: policies.get(name) for name in RULES}
    if against is not None:
        rivals[against.stem] = policies.load(against)
    agents = [policies.load(file) for file in files]
    shares, less, sums, short = [], [], np.zeros(len(rivals) + len(agents)), []
    for name, runs in split_up(families(split, FOLDER, data, leave_out)).items():
        found = Family(name, runs).against([*rivals.values(), *agents])
        above = dict(zip(rivals, found[len(rivals)][1], strict=False))
        shares.append([name, *(f"{share:.3f}" for share, _ in found)])
        less.append([name, *(written(interval, "+.3f") for interval in above.values())])
        short += [f"{rule} on {name} ({above[rule].value:+.3f})" for rule in RULES if above[rule].low > 0]
        sums += [share for share, _ in found]
        print(" | ".join(shares[-1]), flush=True)
    shares.append(["mean", *(f"{total / len(less):.3f}" for total in sums)])
    more = (" --data DIR" if data else "") + (f" --against {against}" if against else "")
    more += f" --leave-out {','.join(leave_out)}" if leave_out else ""
    return PAGE.format(
        **_described(network, notes),
        files=" ".join(map(str, files)),
        split=split,
        more=more,
        short=", ".join(short) or "nowhere here",
        others="a rule" if against is None else f"a rule and {against.stem}",
        shares="\n".join(table(["", *rivals, *(file.stem for file in files)], shares)),
        less="\n".join(table(["", *rivals], less)),
    )


def _described(network: RuledWeights, notes: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says of the network and its making."""
    widths = [len(bias) for _, bias in network.layers]
    return {
        "command": notes.get("training", TRAINING),
        "seed": "".join(f", seed {seed}" for seed in notes.get("seeds", [])[:1]),
        "training": TRAINING,
        "families": len(FAMILY_NAMES),
        "k": network.candidates,
        "per_candidate": PER_CANDIDATE,
        "queue": QUEUE,
        "rule": N_INPUTS,
        "seen": len(network.layers[0][0]),
        "actions": widths[-1],
        "even": EVEN_US / 1e6,
        "widths": " and ".join(map(str, widths[:-1])),
        "activation": network.activation,
    }


def main(
    *files: Path,
    split: Literal["validation", "test"] = "validation",
    data: str | None = None,
    against: Path | None = None,
    leave_out: Names = (),
    out: Path | None = None,
) -> None:
    """Compare agents for one queue with the rules, as a page.

    Args:
        files: agents to compare, the one to ship first.
        split: validation or test, of the links to compare on.
        data: folder of recordings, to compare on recorded uplinks as well.
        against: another agent, of any kind, with which the first is compared too.
        leave_out: families to leave out, such as unequal-heavy,unequal-light, whose bounds take a quarter of an hour.
        out: the Markdown file; printed in any case.
    """
    if not files:
        raise BufgymError("name at least one file of an agent, such as agents/pretrained/learned.safetensors")
    publish(page(files, split, data, against, leave_out), out)


if __name__ == "__main__":
    command(main)
