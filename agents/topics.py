"""Many topics: which messages to drop and to send, compared with Robofleet's published client on the same episodes.

The weighted QoI should be large. The age of information of the topics with the highest priority should be no larger
(``AGE_SHARE``), and the others' not much larger (``OTHERS_SHARE``). No ``no_drop`` message may be lost. QoI is
to be above that of the best hand-written rule (``RULES``) too. Training episodes have other topics and faster or slower
links (``varied``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bufgym import policies
from bufgym.model.link import FOREVER
from bufgym.policies import Policy
from bufgym.scenario import Client
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.sim.rules import age_topic_until

RIVAL = "robofleet"

RULES = ("robofleet", "strict-priority", "age-greedy", "edf", "ros-native")
"""Rules that a tuned one is to surpass in QoI."""

AGE_SHARE, AGE_PENALTY = 0.9, 4.0
"""Target for the age of the first topics, as a share of the rival's, and the price of an excess."""
OTHERS_SHARE, OTHERS_PENALTY = 3.0, 0.25
"""The same for all other topics. Without it, topics of little weight would never be sent."""
BELOW_PENALTY, MARGIN = 3.0, 1.02
"""Price of QoI below ``MARGIN`` times the best rule's, by the missing share of the rival's."""
SCALES, KEPT = (0.7, 10.0), 0.75
"""Range of link speeds in training, and the probability that a topic is there. A rule tuned for one client on scarce
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

    def measure(self, policy: Policy) -> float:
        """Minus QoI over the rival's, plus excess age, plus losses: the less the better."""
        found, rival = self.reached(policy), self.rival
        share = found.qoi / rival.qoi
        older = max(0.0, found.first_age / max(rival.first_age, TINY) - AGE_SHARE)
        others = max(0.0, found.others_age / max(rival.others_age, TINY) - OTHERS_SHARE)
        missing = max(0.0, MARGIN * self.best_qoi / rival.qoi - share)
        return found.lost - share + AGE_PENALTY * older + BELOW_PENALTY * missing + OTHERS_PENALTY * others


def varied(client: Client, rng: np.random.Generator) -> Client:
    """The same client with at least three of its topics, on links of another speed."""
    kept = rng.random(len(client.streams)) < KEPT
    kept[rng.permutation(len(kept))[:3]] = True
    streams = tuple(stream for stream, is_kept in zip(client.streams, kept, strict=True) if is_kept)
    return replace(client, streams=streams, scale=float(np.exp(rng.uniform(*np.log(SCALES)))))
