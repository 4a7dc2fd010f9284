"""One agent for all links: outputs that guide ``gap-price``, evolved on twelve families at once.

``python -m studies.joint --seed 0`` writes runs/joint/seed-0.safetensors. ``python -m studies.joint FILE ...`` compares
agents with the rules on the validation links, or with ``--split test`` on links that chose nothing. ``--data DIR`` adds
recorded uplinks.

The fitness of a candidate on a part of the training runs is the mean of its shares of AFR's regret over the families,
plus ``WORSE`` times the mean by which it is worse than the plain rule, plus a pull to zero. The agent is the mean of
the last ``MEMORY`` means of CMA-ES, in which the noise of single parts cancels. That noise makes the step size fall too
early, so it stays above ``LEAST``; and a diagonal covariance learns faster than a full one.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import cma
import numpy as np

from agents.families import Family, Run, divided
from bufgym import policies
from bufgym.policies import weights
from bufgym.policies.guided import GuidedWeights
from studies.families import families
from studies.page import command, publish, table, written

FOLDER = Path("runs/joint")
SIGMA, LEAST, POPULATION, MEMORY, GENERATIONS = 0.03, 0.02, 16, 40, 110
"""First and least step size (0.1 diverges), candidates a generation, means in the average, and generations."""
PARTS, WORSE, PULL = 8, 0.4, 1e-5
RUNS = {
    **{"task": 16, "default-frames": 18, "lte": 16, "generated": 24, "outage": 10, "sustained": 10},
    **{"interruption": 24, "random": 20, "unequal-heavy": 14, "unequal-light": 14, "equal-heavy": 8, "equal-light": 8},
}
"""Runs of each family in a part."""
RULE = "gap-price"
ABOUT = "The rule gap-price, its numbers set at every decision by ten outputs linear in sixteen inputs, on all links."
RULES = ("target-gap", "price-dp", RULE)


def agent(vector: np.ndarray) -> GuidedWeights:
    """The agent of these numbers."""
    return GuidedWeights(vector.reshape(GuidedWeights.SHAPE).astype(np.float32))


def train(seed: int, generations: int, out: Path) -> None:
    """Evolve one seed for so many generations, and write its agent."""
    rng, rule = np.random.default_rng(seed), policies.get(RULE)
    found = families("train", FOLDER)
    parts = list(zip(*(divided(name, runs, RUNS[name], PARTS, rng) for name, runs in found.items()), strict=True))
    plain = [np.array([family.share(rule) for family in part]) for part in parts]
    decisions = sum(family.decisions for family in parts[0])

    def fitness(vector: np.ndarray, p: int) -> float:
        policy = agent(vector).policy("joint")
        shares = np.array([family.share(policy) for family in parts[p]])
        return float(shares.mean() + WORSE * np.maximum(shares - plain[p], 0).mean() + PULL * np.square(vector).sum())

    options = {"popsize": POPULATION, "seed": seed + 1, "verbose": -9, "CMA_diagonal": True}
    search = cma.CMAEvolutionStrategy(np.zeros(int(np.prod(GuidedWeights.SHAPE))), SIGMA, options)
    means, began = [search.mean], time.process_time()
    for generation in range(generations):
        vectors = search.ask()
        search.tell(vectors, [fitness(vector, generation % PARTS) for vector in vectors])
        search.sigma = max(search.sigma, LEAST)
        means.append(search.mean.copy())
        if generation % 10 == 9:
            spent = f"{POPULATION} x {decisions:,} decisions, {time.process_time() - began:.0f} s"
            print(f"seed {seed}: {generation + 1} of {generations} generations of {spent}", flush=True)
    training = f"python -m studies.joint --seed {seed}"
    training += f" --generations {generations}" if generations != GENERATIONS else ""
    notes = {"name": "learned", "about": ABOUT, "training": training}
    print(f"wrote {weights.save(out, agent(np.mean(means[-MEMORY:], axis=0)), {**notes, 'seeds': [seed]})}")


def split_up(found: dict[str, list[Run]]) -> dict[str, list[Run]]:
    """The families, that of the default frames by L."""
    shown: dict[str, list[Run]] = {}
    for name, runs in found.items():
        parts = {L: [run for run in runs if run["capacity"] == L] for L in sorted({run["capacity"] for run in runs})}
        shown |= {f"{name}, L = {L}": own for L, own in parts.items()} if name == "default-frames" else {name: runs}
    return shown


PAGE = """# learned

**Its action space is a rule**, `gap-price`: at every decision `learned` sets the numbers of that rule. It is seed
{seed}, made by `{command}`. The fitness of the search, on validation, chose it among five
seeds. Seeds that lie more than 0.02 above the rule on a family were left out.

- *Reads* sixteen numbers: rates of the link, load, the bend of V at the target gap, how much the rate varies, the
  head's age and gap, the newcomer's gap and bytes, the time without a departure, the spread of sizes, the fill level,
  whether the target gap is known, and the share of `price-dp` (`bufgym.policies.guided.INPUTS`). Where there is no
  odometry, x is the frame's index.
- *Sets* ten: threshold, discount, the head's target and bias, how early the head is asked, the price of bytes, the
  chains' end, the price's threshold and discount, and the share of `price-dp` (`OUTPUTS`). They are linear in the
  inputs, by one set of weights under a light load and by another under a heavy one.
- *Keeps the plain rule* on a measured steady link, and until the link has carried anything: outputs learned on other
  links made steady ones worse by 0.10. So in interruptions it is the rule. It also is in bursts, where the target gap
  is unknown, unless the queue has one place.
- *Falls short* of a rule, by the intervals below: {short}.
- *Trained* on twelve families of links and streams at once, by CMA-ES from zero weights, which are the rule. A search
  takes five minutes of one core, the bounds of the families another twelve at first.

```
{command}    # and the same with other seeds
python -m studies.joint {files} --split {split}{data} --out docs/agents.md
```

Shares of AFR's regret on the {split} links, which are drawn apart from the training links. Less is better. A family's
share is a ratio of sums; `random`, whose runs differ in everything, has a mean of ratios.

{shares}

How far `learned` lies above a rule, with 95 % intervals over links:

{less}
"""


def page(files: Sequence[Path], split: str, data: str | None) -> str:
    """The page of these agents, the one to ship first: families, and its differences to each rule."""
    agents = [policies.load(file) for file in files]
    rules = [policies.get(name) for name in RULES]
    shares, less, sums, short = [], [], np.zeros(len(rules) + len(agents)), []
    for name, runs in split_up(families(split, FOLDER, data)).items():
        found = Family(name, runs).against([*rules, *agents])
        above = dict(zip(RULES, found[len(rules)][1], strict=False))
        shares.append([name, *(f"{share:.3f}" for share, _ in found)])
        less.append([name, *(written(interval, "+.3f") for interval in above.values())])
        short += [f"{rule} on {name} ({one.value:+.3f})" for rule, one in above.items() if one.low > 0]
        sums += [share for share, _ in found]
        print(" | ".join(shares[-1]), flush=True)
    shares.append(["mean", *(f"{total / len(less):.3f}" for total in sums)])
    notes = weights.read(files[0])[1]
    return PAGE.format(
        seed=notes["seeds"][0],
        command=notes["training"].replace("agents.joint", "studies.joint"),  # where this module was when it ran
        files=" ".join(map(str, files)),
        split=split,
        data=" --data DIR" if data else "",
        short=", ".join(short) or "nowhere here",
        shares="\n".join(table(["", *RULES, *(file.stem for file in files)], shares)),
        less="\n".join(table(["", *RULES], less)),
    )


def main(
    *files: Path,
    seed: int = 0,
    generations: int = GENERATIONS,
    out: Path | None = None,
    split: str = "validation",
    data: str | None = None,
) -> None:
    """Evolve one agent for all links; or, given files, compare agents with the rules.

    Args:
        files: agents to compare, the one to ship first.
        seed: of the search, and of the choice of training runs.
        generations: of the search, about three seconds of processor time each.
        out: the agent's file, by default runs/joint/seed-SEED.safetensors; or the Markdown file of the comparison.
        split: validation or test, of the links to compare on.
        data: folder of recordings, to compare on recorded uplinks as well.
    """
    if files:
        publish(page(files, split, data), out)
    else:
        train(seed, generations, out or FOLDER / f"seed-{seed}.safetensors")


if __name__ == "__main__":
    command(main)
