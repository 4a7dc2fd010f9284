"""Many topics: which messages to drop and to send, compared with Robofleet's published client on the same episodes.

The weighted QoI should be large. The age of information of the topics with the highest priority should be no larger
(``AGE_SHARE``), and the others' not much larger (``OTHERS_SHARE``). No ``no_drop`` message may be lost. QoI is
to be above that of the best hand-written rule (``RULES``) too. Training episodes have other topics and faster or slower
links (``varied``). The search begins at the plain rule of ``guided_topics``, and moves its numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from agents.objectives.objective import Evolved
from agents.tasks import Suites
from bufgym import policies
from bufgym.benchmark import tasks
from bufgym.model.link import FOREVER
from bufgym.policies import Policy
from bufgym.policies.guided_topics import SchedulerWeights
from bufgym.scenario import Client, suites
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.sim.rules import age_topic_until
from bufgym.utils import files
from bufgym.utils.errors import BufgymError

RIVAL = "robofleet"

RULES = ("robofleet", "strict-priority", "age-greedy", "edf", "ros-native")
"""Hand-written rules that the agent is to surpass in QoI."""

PARTS, EPISODES, EPISODE_S = 24, 1, 30.0
"""Parts of the training episodes, one a generation in turn; episodes per setting of the suite; their length, s."""
SIGMA = 0.3
"""First step size."""
AGE_SHARE, AGE_PENALTY = 0.9, 4.0
"""Target for the age of the first topics, as a share of the rival's, and the price of an excess."""
OTHERS_SHARE, OTHERS_PENALTY = 3.0, 0.25
"""The same for all other topics. Without it, topics of little weight would never be sent."""
BELOW_PENALTY, MARGIN = 3.0, 1.02
"""Price of QoI below ``MARGIN`` times the best rule's, by the missing share of the rival's."""
VALIDATION_EPISODES, VALIDATION_SEED = 6, 1
SCALES, KEPT = (0.7, 10.0), 0.75
"""Range of link speeds in training, and the probability that a topic is there. An agent that knows one client on scarce
links alone falls behind its rival on others."""
AMPLE = 6.0
"""Speed of the second set of validation links; the first set is unchanged."""
TINY = 1e-9
"""Least age, to divide by."""


class Reached(NamedTuple):
    """Results of a policy, summed over episodes.

    ``qoi`` is the weighted sum of the topics' H. ``first_age`` and ``others_age`` are the ages of information at the
    server, of the topics with the highest priority and of the others, integrated over time, s^2. ``lost`` counts
    ``no_drop`` messages.
    """

    qoi: float
    first_age: float
    others_age: float
    lost: int


class ClientEpisodes:
    """Episodes of one client over its traces, with the rival's results."""

    def __init__(self, client: Client, capacity: int, count: int, rng: np.random.Generator) -> None:
        traces = [client.traces[int(k)] for k in rng.permutation(len(client.traces))]
        chosen = [traces[k % len(traces)] for k in range(count)]
        self.client = client
        highest = max(topic.priority for topic in client.topics)
        self._first = np.array([topic.priority == highest for topic in client.topics])
        self._no_drop = np.array([topic.no_drop for topic in client.topics])
        self.episodes = [draw(replace(client, traces=(trace,)), int(rng.integers(10**6))) for trace in chosen]
        self.decisions = sum(len(episode.arrivals) for episode in self.episodes)
        """Decisions of a candidate, about one per arrival."""
        self._senders = Senders(count, capacity, client.value, max_messages=client.max_messages, topics=client.topics)
        reached = {name: self.reached(policies.get(name)) for name in RULES}
        self.rival, self.best_qoi = reached[RIVAL], max(each.qoi for each in reached.values())

    def reached(self, policy: Policy) -> Reached:
        """Results of a policy."""
        for i, episode in enumerate(self.episodes):
            self._senders.load(i, episode)
        self._senders.run(policy)
        batch, count = self._senders.batch, len(self.client.topics)
        for i in range(len(self.episodes)):
            for k in range(count):
                age_topic_until(batch, i, k, FOREVER)
        topics = np.asarray(batch.topics)[:, :count]
        qoi = batch.senders["delivered_gain"].sum() + ((topics["received"] > 0) * topics["weight"]).sum()
        dropped = np.asarray(batch.log["dropped_us"]) >= 0
        lost = sum(
            int((dropped[i, : len(episode.arrivals)] & self._no_drop[episode.arrivals["topic"]]).sum())
            for i, episode in enumerate(self.episodes)
        )
        ages = topics["aged"].sum(0)
        return Reached(float(qoi), float(ages[self._first].sum()), float(ages[~self._first].sum()), lost)


def mean_fitness(policy: Policy, parts: Sequence[ClientEpisodes]) -> float:
    """Fitness, the less the better: minus the mean of QoI over the rival's, plus excess age, plus losses."""
    total = 0.0
    for part in parts:
        agent, rival = part.reached(policy), part.rival
        share = agent.qoi / rival.qoi
        older = max(0.0, agent.first_age / max(rival.first_age, TINY) - AGE_SHARE)
        total += agent.lost - share + AGE_PENALTY * older
        total += BELOW_PENALTY * max(0.0, MARGIN * part.best_qoi / rival.qoi - share)
        total += OTHERS_PENALTY * max(0.0, agent.others_age / max(rival.others_age, TINY) - OTHERS_SHARE)
    return total / len(parts)


def client_episodes(
    chosen: Suites, split: str, seed: int, episodes: int, episode_s: float | None = None, *, scale: float = 1.0
) -> list[ClientEpisodes]:
    """Episodes of each setting of the suite, its links ``scale`` times as fast; scale 0 varies clients by chance."""
    (suite,), rng = chosen.suite, np.random.default_rng(seed)
    drawn = []
    for setting in suites.get(suite).settings(split, chosen.data).values():
        client = setting.scenario
        if not isinstance(client, Client):
            raise BufgymError(f"suite {suite}: has no topics")
        client = client if episode_s is None else replace(client, duration_s=episode_s)
        client = replace(client, scale=scale) if scale else varied(client, rng)
        drawn += [ClientEpisodes(client, L, episodes, rng) for L in chosen.capacities_of(suite)]
    return drawn


def varied(client: Client, rng: np.random.Generator) -> Client:
    """The same client with at least three of its topics, on links of another speed."""
    kept = rng.random(len(client.streams)) < KEPT
    kept[rng.permutation(len(kept))[:3]] = True
    streams = tuple(stream for stream, is_kept in zip(client.streams, kept, strict=True) if is_kept)
    return replace(client, streams=streams, scale=float(np.exp(rng.uniform(*np.log(SCALES)))))


class TopicsObjective(Evolved):
    """The clients of one suite."""

    name = "evolved"
    columns = ("fitness",)
    best = min
    message = "{:.3f}"
    sigma = SIGMA

    @functools.cached_property
    def training(self) -> list[list[ClientEpisodes]]:
        """``PARTS`` sets of episodes of varied clients."""
        chosen, seeds = self.settings.suites, [1000 * self.seed + part for part in range(PARTS)]
        return [client_episodes(chosen, "train", seed, EPISODES, EPISODE_S, scale=0) for seed in seeds]

    @functools.cached_property
    def judges(self) -> list[ClientEpisodes]:
        """The suite's clients as they are, and on ample links."""
        chosen = self.settings.suites
        (suite,) = chosen.suite
        cells = 2 * len(chosen.capacities_of(suite)) * len(suites.get(suite).settings("validation", chosen.data))
        rest = chosen, "validation", VALIDATION_SEED, self.settings.validations(VALIDATION_EPISODES, cells)
        return [episodes for scale in (1.0, AMPLE) for episodes in client_episodes(*rest, scale=scale)]

    def start(self) -> SchedulerWeights:
        """The plain rule."""
        return SchedulerWeights(np.zeros(SchedulerWeights.SHAPE, np.float32))

    def measure(self, policy: Policy, episodes: Sequence[ClientEpisodes]) -> float:
        """Compute ``mean_fitness``."""
        return mean_fitness(policy, episodes)

    def rivals(self) -> list[Policy]:
        """All schedulers but the shipped agent."""
        shipped = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")
        names = tasks.TASKS["topics"].default_policies("")
        return [policies.get(name) for name in names if name not in shipped]
