"""The page about a run's schedulers: ``python -m studies.scheduling runs/NAME --out docs/topics.md``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from agents.runs import MODEL, read_settings
from bufgym import policies
from bufgym.benchmark.rows import Row, read_rows
from bufgym.benchmark.score import Standing
from bufgym.benchmark.summary import Summary, table_of
from bufgym.benchmark.tasks import TASKS
from bufgym.utils.errors import BufgymError
from studies.page import command, publish, written

PAGE = """# Learned scheduling on topics-v1

Eight topics of Robofleet's example client share an uplink. It is slower than the client publishes, and it drops out
now and then (`bufgym list suites`). The agents set the numbers of one rule (`bufgym.policies.guided_topics`): 17
weights and thresholds, linear in nine inputs such as the link's rate and the messages in flight. At every arrival it
chooses the message to drop, and at every free socket the message to send. Training begins at the plain rule. There
links are 0.7 to 10 times as fast, and topics are left out by chance. The page shows all training seeds.

Training rewards QoI over Robofleet's QoI. It subtracts the age of the topics of priority 20 beyond 0.9 of their age
under Robofleet, and QoI that is missing to 1.02 times the best rule's. `learned-scheduler` is seed {best}, the best on
validation by this measure.

The agents are made by `{command}`. This page is made by `python -m studies.scheduling runs/NAME --out docs/topics.md`.
Without training, run `bufgym topics --suite topics-v1`.

The figures are means over the {settings} settings of the test split, with {episodes} episodes each. QoI is the weighted
sum of each topic's H. It is compared with `robofleet`, as published, on the same episodes, with paired 95 % intervals
over links. QoI / robofleet's and age / robofleet's are means of the settings' ratios, not ratios of sums. Age is the
age of information at the server. "First" are the topics of priority 20, and "others" are the rest.

| policy | QoI / robofleet's | no_drop lost | age, first / robofleet's | age, first, s | age, others, s | late |
|---|---|---:|---|---:|---:|---:|
{overall}

{notes}

## Against the best rule of each setting

The best rule is the hand-written one with the most QoI in the setting, on the test split itself. A second row has the
best one that keeps to n_T, as the agents must: `ros-native` does not wait for acks. Differences are in QoI /
robofleet's, with paired 95 % intervals over links. Age is the age of the topics of priority
20, as a share of Robofleet's.

| setting | rule | seed {best} minus the rule | all seeds | age, seed {best} | age, rule | no_drop lost, rule |
|---|---|---|---|---|---|---:|
{rules}

## By setting

```text
{text}
```
"""


def main(run: Path, out: Path | None = None) -> None:
    """The results of a finished run's schedulers, as a page.

    Args:
        run: the run's folder, runs/NAME.
        out: Markdown file to write; the page is printed in any case.
    """
    if not (run / "rows.csv").is_file():
        raise BufgymError(f"{run / 'rows.csv'}: no such file; the run has not ended")
    task = TASKS["topics"]
    rows = read_rows(run / "rows.csv", task.layout)
    results = task.summary(rows)
    kept = (run / MODEL).read_bytes()
    best = next(path.parent.name[5:] for path in sorted(run.glob(f"seed-*/{MODEL}")) if path.read_bytes() == kept)
    unbounded = {name for name in policies.names() if not policies.get(name).ranked}
    # Unbounded queues come last: their messages arrive long after.
    standings = sorted(results.overall, key=lambda standing: standing.policy in unbounded)
    agents = [standing for standing in results.overall if standing.policy.startswith("agent")]
    low, high = (bound([standing["relative"].value for standing in agents]) for bound in (min, max))
    older = max(standing["age_relative"].high for standing in agents)
    lost = sum(standing["lost"].value for standing in agents)
    notes = (
        f"Over all seeds QoI is {low:.2f} to {high:.2f} times Robofleet's. The seeds lose {lost:g} no_drop messages. "
        f"Their topics of priority 20 are at most {older:.3f} times as old, by the upper end of the interval. "
        "`rosbridge` has an unbounded queue. It loses nothing, and its messages arrive long after."
    )
    text = PAGE.format(
        best=best,
        command=read_settings(run)["command"],
        settings=len(results.cells),
        episodes=len({(row["trace"], row["seed"]) for row in rows if row["scenario"] == rows[0]["scenario"]}),
        overall="\n".join(_line(standing) for standing in standings),
        notes=notes,
        rules="\n".join(_against_rules(rows, results, f"agent (seed {best})", unbounded)),
        text=table_of(results).plain(),
    )
    publish(text, out)


def _against_rules(rows: list[Row], results: Summary, best: str, unbounded: set[str]) -> Iterator[str]:
    """Rows of the table of the best rules, two a setting where they differ."""
    for (scenario, L), standings in results.cells.items():
        rules = [s for s in standings if not s.policy.startswith("agent") and s.policy not in unbounded]
        first, waits = (max(of, key=lambda s: s["relative"].value) for of in (rules, [s for s in rules if _waits(s)]))
        for rule in dict.fromkeys((first.policy, waits.policy)):
            by_name = {s.policy: s for s in TASKS["topics"].summary(rows, against=rule).cells[scenario, L]}
            less = [s["against"].value for name, s in by_name.items() if name.startswith("agent")]
            mine, other = by_name[best], by_name[rule]
            ages = written(mine["age_relative"], ".3f"), written(other["age_relative"], ".3f")
            more = written(mine["against"], "+.3f"), f"{min(less):+.3f} to {max(less):+.3f}"
            yield f"| {' | '.join([scenario, rule, *more, *ages, format(other['lost'].value, 'g')])} |"


def _waits(standing: Standing) -> bool:
    return policies.get(standing.policy).client.awaits_acks


def _line(standing: Standing) -> str:
    columns = [
        standing.policy,
        written(standing["relative"], ".3f"),
        f"{standing['lost'].value:g}",
        written(standing["age_relative"], ".3f"),
        f"{standing['age_first_s'].value:.2f}",
        f"{standing['age_others_s'].value:.2f}",
        f"{standing['late'].value:.1%}",
    ]
    return f"| {' | '.join(columns)} |"


if __name__ == "__main__":
    command(main)
