"""Page of suites from their registry."""

from bufgym.scenario.suites import SUITES
from website.markdown import table

WORDS = """
A suite is a frozen set of episodes that results are quoted on. It has a version in its name and never changes. Its
train, validation and test episodes share no trace. Train on `train`, choose on `validation`, report on `test`.

```
bufgym bench --suite lte-v1 --out results/lte
bufgym report results/lte
```

The *score* of a policy is 0 for Drop Oldest and 1 for the clairvoyant. The [leaderboard](results/leaderboard.md) lists
all policies, each row with the command that makes it again.
"""


def page() -> str:
    """The whole page."""
    rows = [
        (
            f"`{suite.name}`",
            suite.kind,
            ", ".join(map(str, suite.capacities)),
            suite.about,
            " and ".join(f"`{files}`" for files in suite.needs.split(" and ")) or "nothing",
        )
        for suite in SUITES.values()
    ]
    return f"# Suites\n{WORDS}\n" + table(("suite", "kind", "L", "what it is", "recordings it needs"), rows)
