"""Learned scheduling: what to drop and what to send of many topics, by CMA-ES over whole episodes.

A candidate is a vector of weights; its fitness compares it with Robofleet's published client on the same episodes: the
weighted QoI is to be large, the age of information of the topics with the highest priority no larger (``AGE_SHARE``),
that of the others not much larger (``OTHERS_SHARE``), and no ``no_drop`` message may be lost. All candidates of a
generation meet the same episodes, the next generation meets others, with other topics and faster or slower links
(``varied``); validation episodes say which mean to keep. The
search begins at what is greedy: drop what loses the least QoI now, send what gains the most a byte.

    python train.py --suite topics-v1 --algo evolution --seeds 5 --steps 25000000 --validate-every 1000000
"""

from __future__ import annotations

import argparse
import json
import pickle
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cma
import numpy as np
from numpy.typing import NDArray

from agents.callbacks import Record, seed_bar
from agents.seeds import conclude, each_seed, seeds_of
from bufgym import files, policies
from bufgym.benchmark.rows import Row, read_rows
from bufgym.benchmark.run import draw
from bufgym.benchmark.topics import ROWS, default_policies, run_parts, suite_parts
from bufgym.benchmark.topics_summary import Standing, plain, summary
from bufgym.errors import BufgymError
from bufgym.files import replaced
from bufgym.model.link import FOREVER
from bufgym.policies import Policy, learned_topics, weights
from bufgym.policies.learned import Network
from bufgym.policies.learned_topics import TopicWeights
from bufgym.scenario import Client, suites
from bufgym.sim import Senders, age_until

if TYPE_CHECKING:
    from train import Arguments

RIVAL = "robofleet"

CONTEXT = ("occupancy", "stalled", "service_ratio", "left", "in_flight")
SLOT = (
    *("rank", "time_merged", "motion_merged", "loss", "relative_loss", "size", "priority", "weight", "no_drop"),
    *("own", "waited", "silence", "lateness", "queued", "gain", "gain_per_byte"),
)
FIELDS = CONTEXT + SLOT
"""What the agent reads."""

PARTS, EPISODES, EPISODE_S = 24, 1, 30.0
"""Training episodes come in so many parts, one a generation in turn: so many a setting of the suite, so long."""
POPULATION, SIGMA, MEMORY = 16, 1.0, 10
"""Candidates a generation, first step size, generations over which the mean is averaged."""
AGE_SHARE, AGE_PENALTY = 0.9, 3.0
"""The age of the first topics is to be this part of the rival's; what is more costs so much."""
OTHERS_SHARE, OTHERS_PENALTY = 1.5, 0.25
"""The same of all other topics: without it, what weighs little is never sent."""
VALIDATION_SEED = 1
BELOW_PENALTY = 3.0
"""What a ground costs where the QoI is below the rival's, for each part of it that is missing."""
SCALES, KEPT = (0.7, 10.0), 0.75
"""In training links are so many times as fast, and a topic is there with this probability: who knows one client on
scarce links alone falls behind its rival on others."""
AMPLE = 6.0
"""Validation episodes come once as they are, and once on links so many times as fast."""
TINY = 1e-9
"""So that an age of 0 can be compared with."""

MODEL = "model.safetensors"


# --- weights as a vector ---------------------------------------------------------------------------------------------


def start() -> TopicWeights:
    """Greedy: drop what loses least, rather old than new; accept with room; send what gains most a byte."""
    drop, accept, send = (Network(_zeros(len(FIELDS)), _zeros(1), (), _zeros(0)) for _ in range(3))
    for name, number in (("loss", -10.0), ("rank", -0.4)):
        drop.skip[FIELDS.index(name)] = number
    accept.bias[0] = 5.0
    for name, number in (("gain_per_byte", 10.0), ("silence", 2.0)):
        send.skip[FIELDS.index(name)] = number
    return TopicWeights(FIELDS, drop, accept, send)


def _zeros(n: int) -> NDArray[np.float32]:
    return np.zeros(n, np.float32)


def to_vector(given: TopicWeights) -> NDArray[np.float64]:
    """The numbers to be searched: what the context adds to every candidate alike decides in ``accept`` alone."""
    c = len(CONTEXT)
    parts = [given.drop.skip[c:], given.accept.skip, given.accept.bias, given.send.skip[c:]]
    return np.concatenate(parts).astype(np.float64)


def from_vector(vector: NDArray[np.float64]) -> TopicWeights:
    """The weights that ``to_vector`` came from."""
    made, c, n = start(), len(CONTEXT), len(FIELDS)
    drop, accept, bias, send = np.split(vector.astype(np.float32), np.cumsum([n - c, n, 1]))
    made.drop.skip[c:], made.accept.skip[:], made.accept.bias[:], made.send.skip[c:] = drop, accept, bias, send
    return made


def policy_of(vector: NDArray[np.float64]) -> Policy:
    """Who decides by these numbers."""
    return learned_topics.policy("evolved", from_vector(vector))


# --- where candidates are tried --------------------------------------------------------------------------------------


class Ground:
    """Episodes of one client over its traces, and what the rival makes of them."""

    def __init__(self, client: Client, capacity: int, count: int, rng: np.random.Generator) -> None:
        traces = [client.traces[int(k)] for k in rng.permutation(len(client.traces))]
        chosen = [traces[k % len(traces)] for k in range(count)]
        self.client = client
        self.first = np.array([t.priority == max(o.priority for o in client.topics) for t in client.topics])
        self.never = np.array([topic.no_drop for topic in client.topics])
        self.episodes = [draw(replace(client, traces=(trace,)), int(rng.integers(10**6))) for trace in chosen]
        self.senders = Senders(count, capacity, client.value, max_messages=client.max_messages, topics=client.topics)
        self.rival = self.reached(policies.get(RIVAL))

    @property
    def decisions(self) -> int:
        """About how many a candidate is asked for: one an arrival."""
        return sum(len(episode.arrivals) for episode in self.episodes)

    def reached(self, policy: Policy) -> tuple[float, float, float, int]:
        """(weighted QoI, age of the first topics and of the others, integrated, s^2, no_drop messages lost), summed."""
        for i, episode in enumerate(self.episodes):
            self.senders.load(i, episode)
        self.senders.run(policy)
        batch, count = self.senders.batch, len(self.client.topics)
        for i in range(len(self.episodes)):
            for k in range(count):
                age_until(batch, i, k, FOREVER)
        topics = np.asarray(batch.topics)[:, :count]
        qoi = batch.senders["delivered_gain"].sum() + ((topics["received"] > 0) * topics["weight"]).sum()
        dropped = np.asarray(batch.log["dropped_us"]) >= 0
        lost = sum(
            int((dropped[i, : len(e.arrivals)] & self.never[e.arrivals["topic"]]).sum())
            for i, e in enumerate(self.episodes)
        )
        aged = topics["aged"].sum(0)
        return float(qoi), float(aged[self.first].sum()), float(aged[~self.first].sum()), lost


def fitness(policy: Policy, grounds: Sequence[Ground]) -> float:
    """The less the better: minus the mean of QoI over the rival's, plus what the age is too large, plus losses."""
    total = 0.0
    for ground in grounds:
        (qoi, first, others, lost), theirs = ground.reached(policy), ground.rival
        total += lost - qoi / theirs[0] + AGE_PENALTY * max(0.0, first / max(theirs[1], TINY) - AGE_SHARE)
        total += BELOW_PENALTY * max(0.0, 1 - qoi / theirs[0])
        total += OTHERS_PENALTY * max(0.0, others / max(theirs[2], TINY) - OTHERS_SHARE)
    return total / len(grounds)


def grounds(
    suite: str, split: str, seed: int, episodes: int, episode_s: float | None = None, *, scale: float = 1.0
) -> list[Ground]:
    """One ground for each setting of a suite, its links ``scale`` times as fast; 0: each varied by chance."""
    rng, found = np.random.default_rng(seed), suites.get(suite)
    made = []
    for setting in found.settings(split).values():
        client = setting.scenario
        if not isinstance(client, Client):
            raise BufgymError(f"suite {suite}: has no topics")
        client = client if episode_s is None else replace(client, duration_s=episode_s)
        client = replace(client, scale=scale) if scale else varied(client, rng)
        made += [Ground(client, L, episodes, rng) for L in found.capacities]
    return made


def varied(client: Client, rng: np.random.Generator) -> Client:
    """The same client with some of its topics, three at least, on links of another speed."""
    kept = rng.random(len(client.streams)) < KEPT
    kept[rng.permutation(len(kept))[:3]] = True
    streams = tuple(stream for stream, here in zip(client.streams, kept, strict=True) if here)
    return replace(client, streams=streams, scale=float(np.exp(rng.uniform(*np.log(SCALES)))))


# --- training --------------------------------------------------------------------------------------------------------


@dataclass
class Search:
    """Where a seed's evolution stands; what a checkpoint holds."""

    es: Any
    """pycma's strategy."""
    average: NDArray[np.float64]
    """Of its latest means: this is the agent."""
    steps: int = 0
    generations: int = 0
    seconds: float = 0.0


def wanted(arguments: Arguments) -> bool:
    """Whether these arguments ask for a scheduler; an error if they ask for more than that."""
    topics = [suite for suite in arguments.suites if suite in suites.TOPIC_SUITES]
    if topics and (len(arguments.suites) > 1 or arguments.algo != "evolution"):
        raise BufgymError(f"suite {topics[0]}: a scheduler learns from one suite alone, by --algo evolution")
    return bool(topics)


def train(arguments: Arguments, folder: Path, seed: int, line: int = 0) -> tuple[float, float]:
    """Evolve one seed until ``arguments.steps`` decisions were rolled out, from its last checkpoint if there is one.

    What did best on validation is kept as ``model.safetensors``.

    Returns:
        (fitness on validation, seconds of training).
    """
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    saved = home / "evolution.pkl"  # one's own run alone: pickles run code when they are read
    suite = arguments.suite
    yards = [grounds(suite, "train", 1000 * seed + part, EPISODES, EPISODE_S, scale=0) for part in range(PARTS)]
    judges = [g for scale in (1.0, AMPLE) for g in grounds(suite, "validation", VALIDATION_SEED, 6, scale=scale)]
    begin = to_vector(start())
    if saved.exists():
        search, best, validated = pickle.loads(saved.read_bytes())
    else:
        settings = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9}
        search, best, validated = Search(cma.CMAEvolutionStrategy(begin, SIGMA, settings), begin), np.inf, -1
    began = time.perf_counter() - search.seconds
    bar = seed_bar(arguments.steps, search.steps, seed, line)
    validations = Record(home / "validation.csv", ("steps", "seconds", "fitness"), search.steps)
    while True:
        if validated < 0 or search.steps - validated >= arguments.validate_every or search.steps >= arguments.steps:
            reached, validated = fitness(policy_of(search.average), judges), search.steps
            if reached < best:
                best = reached
                noted = {"name": "evolved", "suite": suite, "seeds": [seed], "algo": "evolution"}
                weights.save(home / MODEL, from_vector(search.average), noted)
            if not validations.rows or validations.rows[-1][0] < search.steps:
                validations.append(search.steps, round(search.seconds, 1), reached)
            if bar.disable:
                print(f"seed {seed}: {search.steps:,} of {arguments.steps:,} steps, {reached:.3f}", flush=True)
        if search.steps >= arguments.steps:
            break
        yard = yards[search.generations % PARTS]
        vectors = search.es.ask()
        search.es.tell(vectors, [fitness(policy_of(vector), yard) for vector in vectors])
        search.average = search.average + (search.es.mean - search.average) / MEMORY
        search.steps += sum(ground.decisions for ground in yard) * len(vectors)
        search.generations += 1
        search.seconds = time.perf_counter() - began
        with replaced(saved) as unfinished:
            unfinished.write_bytes(pickle.dumps((search, best, validated)))
        bar.update(search.steps - bar.n)
    bar.close()
    return float(best), search.seconds


def train_and_report(arguments: Arguments, folder: Path) -> None:
    """All seeds, each in a process of its own if there are several; then every scheduler on the test split."""
    seeds, found = seeds_of(arguments), each_seed(train, arguments, folder)
    rows = test_rows(arguments, folder, seeds)
    best = seeds[int(np.argmin([reached for reached, _ in found]))]
    conclude(folder, MODEL, best, [seconds for _, seconds in found], rows, ROWS, plain(summary(rows)))


def test_rows(arguments: Arguments, folder: Path, seeds: Sequence[int]) -> list[Row]:
    """Each seed's agent and all schedulers on the suite's test split."""
    agents = [replace(weights.load(folder / f"seed-{seed}" / MODEL), name=f"agent (seed {seed})") for seed in seeds]
    shipped = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")
    rivals = [policies.get(name) for name in default_policies() if name not in shipped]
    suite = suites.get(arguments.suite)
    parts = suite_parts(suite, "test", arguments.test_seeds or None)
    return run_parts([*agents, *rivals], parts, suite.capacities, progress=True)


# --- the page --------------------------------------------------------------------------------------------------------

PAGE = """# Learned scheduling on topics-v1

Eight topics of Robofleet's example client share an uplink that is slower than what they publish and drops out now
and then (`bufgym list suites`). Agents are slot scorers over each queued message's features, its topic's among them;
they decide at every arrival what is dropped and at every free socket what goes. In training links are 0.7 to 10 times
as fast and topics are left out by chance. All training seeds are shown; `learned-scheduler` is seed {best}, the best
on validation by what is trained for: QoI over Robofleet's, less what the topics of priority 20 are older than 0.9 of
its age there.

Agents: `{command}`. This page: `python -m agents.scheduling runs/NAME --out docs/topics.md`.
Without training: `bufgym topics --suite topics-v1`.

Mean over the {settings} settings of the test split, {episodes} episodes each. QoI is the weighted sum of each topic's
H; beside `robofleet`, as published, on the same episodes, with paired 95 % intervals over episodes. Age is that of
information at the server, of the topics of priority 20 ("first") and of the others.

| policy | QoI / robofleet's | no_drop lost | age, first / robofleet's | age, first, s | age, others, s | late |
|---|---|---:|---|---:|---:|---:|
{overall}

{notes}

## By setting

```
{text}
```
"""


def page(folder: Path) -> str:
    """What a finished run reached, as Markdown."""
    from agents.export import command

    rows = read_rows(folder / "rows.csv", ROWS)
    settings = json.loads((folder / "settings.json").read_text(encoding="utf-8"))
    found = summary(rows)
    kept = (folder / MODEL).read_bytes()
    best = next(path.parent.name[5:] for path in sorted(folder.glob(f"seed-*/{MODEL}")) if path.read_bytes() == kept)
    unbounded = {name for name in policies.names() if not policies.get(name).ranked}
    standings = sorted(found.overall, key=lambda standing: standing.policy in unbounded)  # their QoI comes long after
    lines = ["| " + " | ".join(_cells(standing)) + " |" for standing in standings]
    ours = [standing for standing in found.overall if standing.policy.startswith("agent")]
    low, high = (f([s.relative.value for s in ours]) for f in (min, max))
    older = max(s.age_relative.high for s in ours)
    notes = (
        f"Over all seeds: QoI {low:.2f} to {high:.2f} times Robofleet's, {sum(s.lost for s in ours):g} no_drop "
        f"messages lost, the topics of priority 20 at most {older:.3f} times as old (upper end of the interval). "
        "`rosbridge` has an unbounded queue: it loses nothing and delivers it long after."
    )
    return PAGE.format(
        best=best,
        command=command(settings),
        settings=len(found.cells),
        episodes=len({(row["trace"], row["seed"]) for row in rows if row["scenario"] == rows[0]["scenario"]}),
        overall="\n".join(lines),
        notes=notes,
        text=plain(found),
    )


def _cells(standing: Standing) -> list[str]:
    relative, age = standing.relative, standing.age_relative
    return [
        standing.policy,
        f"{relative.value:.3f} [{relative.low:.3f}, {relative.high:.3f}]",
        f"{standing.lost:g}",
        f"{age.value:.3f} [{age.low:.3f}, {age.high:.3f}]",
        f"{standing.age_first_s.value:.2f}",
        f"{standing.age_others_s.value:.2f}",
        f"{standing.late.value:.1%}",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m agents.scheduling RUN --out FILE``."""
    parser = argparse.ArgumentParser(
        prog="python -m agents.scheduling", description="the page about a run's schedulers"
    )
    parser.add_argument("run", type=Path, help="its folder, runs/NAME")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="Markdown")
    options = parser.parse_args(arguments)
    if not (options.run / "rows.csv").is_file():
        raise SystemExit(f"error: {options.run / 'rows.csv'}: no such file; the run has not ended")
    options.out.write_text(page(options.run), encoding="utf-8")
    print(f"page: {options.out}")


if __name__ == "__main__":
    main()
