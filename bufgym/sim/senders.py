"""Senders that hold episodes, and the run of a policy on episodes of one queue or of several topics."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bufgym.model.buffer import UNLIMITED_BYTES, check_limits
from bufgym.model.link import PLACE_WORDS, KnotStore
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic, check_topics, copies_of, topic_table
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode
from bufgym.scenario.episode import WORDS
from bufgym.sim.audit import touched
from bufgym.sim.rollout import roll_out
from bufgym.sim.shared_link import Shares
from bufgym.sim.state import SENDER, beginning, new_batch
from bufgym.utils.errors import BufgymError

Begun = tuple[int, Episode, np.random.Generator | None]
"""Arguments of ``Senders.load``: a sender, the episode it begins, and the generator of its uniform draws."""


def _columns(names: Sequence[str]) -> NDArray[np.int64]:
    """Columns of these fields where a SENDER is seen as whole words: every field of it has eight bytes."""
    return np.array([list(cast(Any, SENDER.names)).index(name) for name in names], np.int64)


_EPISODE, _V, _PLACE = _columns(WORDS), _columns(["v_start"])[0], _columns(PLACE_WORDS)
"""Fields of SENDER that differ from episode to episode: ``Episode.words``, the place of V and of the link's knots."""


class Senders:
    """A batch of n senders that share L, B and V, each with an episode of its own.

    Shared settings are ``capacity`` (L, messages), ``max_bytes`` (B), ``decide_at``, ``value`` (V) and ``topics``.
    ``batch`` has the arrays (see ``Batch``). ``episodes`` has each sender's episode, or None. ``begun``, int64[n],
    counts the episodes begun. An episode of one queue may have a V of its own.
    """

    def __init__(
        self,
        n: int,
        capacity: int,
        v: Value,
        *,
        max_messages: int,
        max_bytes: int | None = None,
        decide_at: str = "arrival",
        topics: Sequence[Topic] = (),
    ) -> None:
        """Make n senders with room for L = ``capacity`` messages and B = ``max_bytes`` bytes, without episodes so far.

        ``topics`` has the rules of each topic, by the messages' topic numbers; empty for one queue without rules.
        """
        check_limits(capacity, max_bytes)
        if decide_at not in ("arrival", "overflow"):
            raise BufgymError(f"decide_at = {decide_at!r}: must be 'arrival' or 'overflow'")
        self.capacity = int(capacity)
        self.max_bytes = UNLIMITED_BYTES if max_bytes is None else int(max_bytes)
        self.decide_at = decide_at
        self.value = v
        self.topics = check_topics(topics)
        self.topic_table, values = topic_table(self.topics, self.capacity, v)
        self._v_starts = {v.array.tobytes(): 0}
        self.episodes: list[Episode | None] = [None] * n
        self.begun = np.zeros(n, np.int64)
        self._uniforms: list[np.random.Generator | None] = [None] * n
        self._knots = KnotStore()
        self.batch = new_batch(n, self.capacity, max_messages, len(self.topic_table), values)
        self._rules = self.topic_table.view(np.int64)
        when_full = int(decide_at == "overflow")
        limits = {"capacity": self.capacity, "max_bytes": self.max_bytes, "topics": len(self.topic_table)}
        screens, weight = int(when_full or self.max_bytes < UNLIMITED_BYTES), sum(self.topic_table["weight"].tolist())
        self._beginning = beginning(ask_when_full=when_full, screens=screens, weight=weight or 1.0, **limits)

    def __len__(self) -> int:
        return len(self.episodes)

    def load(self, i: int, episode: Episode, uniforms: np.random.Generator | None = None) -> None:
        """Begin ``episode`` at sender ``i``: empty buffer, idle socket, nothing arrived.

        ``uniforms`` is the generator for ``draw_uniforms``; None if the episode has its uniform draws.
        """
        self.load_all([(i, episode, uniforms)])

    def load_all(self, begun: Sequence[Begun]) -> None:
        """Call ``load`` for each of ``begun`` at once."""
        v_starts = [self._checked(episode) for _, episode, _ in begun]  # all, before any sender is changed
        batch, rows, episodes, places = self.batch, np.array([i for i, _, _ in begun], np.int64), [], []
        # NumPy copies records field by field; as whole words it copies them five times as fast.
        arrivals, topics, senders = (array.view(np.int64) for array in (batch.arrivals, batch.topics, batch.senders))
        for i, episode, uniforms in begun:
            words = episode.arrivals.view(np.int64)
            arrivals[i, : len(words)] = words
            episodes.append(episode.words)
            places.append(self._knots.place(episode.link.trace, i))
            self.episodes[i], self._uniforms[i] = episode, uniforms
        self.begun[rows] += 1
        topics[rows] = self._rules
        batch.past[rows] = 0.0
        beginnings = np.repeat(self._beginning[None], len(rows), 0)
        if begun:
            beginnings[:, _EPISODE], beginnings[:, _V], beginnings[:, _PLACE] = episodes, v_starts, places
        senders.reshape(len(self), -1)[rows] = beginnings
        # The store makes longer arrays as it grows, and kernels must read the new ones.
        if self._knots.us is not self.batch.knot_us:
            self.batch = self.batch._replace(knot_us=self._knots.us, knot_bytes=self._knots.bytes)

    def _checked(self, episode: Episode) -> int:
        """Index of the episode's V in the array of all V; raise if these senders can't play the episode."""
        if not isinstance(episode, Episode):
            raise BufgymError(f"episode: {episode!r} is not a bufgym.scenario Episode")
        n = len(episode.arrivals)
        if n > self.batch.arrivals.shape[1]:
            most = self.batch.arrivals.shape[1]
            raise BufgymError(f"episode of {n} messages: these senders have room for {most}")
        if self.topics and (unknown := episode.arrivals["topic"].max()) >= len(self.topics):
            raise BufgymError(f"episode: unknown topic {unknown}; the senders know {len(self.topics)}, from 0 on")
        if not self.topics:
            episode.check_one_queue()
        return 0 if episode.value is None else self._v_start(episode.value)

    def value_of(self, i: int) -> Value:
        """The V for the QoI of sender ``i``'s episode; without topics."""
        episode = self.episodes[i]
        return self.value if episode is None or episode.value is None else episode.value

    def draw_uniforms(self, i: int) -> None:
        """Draw the uniforms of sender ``i``'s episode unless it has them. Late, as only policies that play look at
        them.
        """
        rng, episode = self._uniforms[i], self.episodes[i]
        if rng is None or episode is None:
            return
        self.episodes[i], self._uniforms[i] = (episode := episode.with_uniforms(rng)), None
        self.batch.arrivals["uniform"][i, : len(episode.arrivals)] = episode.arrivals["uniform"]

    def _v_start(self, v: Value) -> int:
        """Index of V in the array of all V; a new V goes to its end."""
        key = v.array.tobytes()
        if key not in self._v_starts:
            if self.topics:
                raise BufgymError(f"episode: has V = {v.name} of its own; with several topics each topic has one")
            values = np.concatenate([self.batch.v, v.array])
            values.flags.writeable = False
            self._v_starts[key] = len(self.batch.v)
            self.batch = self.batch._replace(v=values)
        return self._v_starts[key]

    def new_memory(self, policy: Policy, i: int) -> NDArray[np.float64]:
        """Make fresh memory of ``policy`` for the episode of sender ``i``, float64[entries]."""
        memory: NDArray[np.float64] = policy.new_memory(1, self.capacity)[0]
        if policy.privileged is not None:
            memory = policy.privileged(self.episodes[i], self.capacity, self.max_bytes, self.value_of(i))
        return memory

    def run(self, policy: Policy, memory: NDArray[np.float64] | None = None, shares: Shares | None = None) -> None:
        """Run every loaded sender to its end under ``policy``; ``memory`` is float64[n, entries], fresh by default.

        ``shares`` are the cells whose links the senders share (see ``bufgym.sim.cell.Fleet``); None for own links.
        """
        if memory is None and policy.privileged is not None:
            memory = padded([self.new_memory(policy, i) for i in range(len(self))])
        elif memory is None:
            memory = policy.new_memory(len(self), self.capacity)
        self.follow(policy)
        roll_out(self.batch._replace(parameters=policy.parameter_array), shares, memory, policy)

    def follow(self, policy: Policy, senders: NDArray[Any] | None = None) -> None:
        """Configure when ``policy`` is asked, and how the client around it sends; in SENDER[n], by default these."""
        client, senders = policy.client, self.batch.senders if senders is None else senders
        senders["ask_at_dequeue"], senders["ask_at_send"] = policy.drops_at_dequeue, policy.schedules
        senders["measures"], senders["shows_left"] = policy.measures, policy.measures or policy.reads_left
        senders["remembers"] = policy.remembers
        for rule in ("limit_at_send", "limit_since_sent", "flush_no_drop"):
            senders[rule] = getattr(client, rule)
        if not client.awaits_acks:
            senders["window"], senders["ack_delay_us"] = 1, 0

    def check_untouched(self, policy: Policy) -> None:
        """Raise if ``policy`` has written to its view while it ran every sender to its end."""
        for i, episode in enumerate(self.episodes):
            if episode is not None and (found := touched(self.batch, i, episode, self.topic_table)):
                raise BufgymError(
                    f"policy {policy.name}: wrote to what it may only read: {found} (run {i + 1} of the batch)"
                )


def padded(rows: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """float64[rows, longest]: rows of different lengths as one array, padded with zeros."""
    table = np.zeros((len(rows), max(map(len, rows))))
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table


def run(
    policy: Policy,
    episodes: Sequence[Episode],
    capacity: int,
    v: Value,
    *,
    max_bytes: int | None = None,
    decide_at: str = "arrival",
    memory: NDArray[np.float64] | None = None,
    topics: Sequence[Topic] = (),
) -> Senders:
    """Run ``policy`` through each of ``episodes``, one sender each; return the senders afterwards.

    The queue of an unbounded policy has room for all messages, whatever ``capacity`` and ``max_bytes`` are.
    """
    if not episodes:
        raise BufgymError("no episode to run")
    if policy.client.encoding:
        episodes = [episode.encoded(policy.client.encoding) for episode in episodes]
    if policy.client.copies and topics:
        copies = max(episode.consumers for episode in episodes)
        episodes = [episode.copied(len(topics)) for episode in episodes]
        topics = copies_of(topics, copies)
    longest = max(len(episode.arrivals) for episode in episodes)
    if policy.unbounded:
        capacity, max_bytes = longest, None
        topics = [replace(topic, limit=None) for topic in topics]
    senders = Senders(
        len(episodes), capacity, v, max_messages=longest, max_bytes=max_bytes, decide_at=decide_at, topics=topics
    )
    senders.load_all([(i, episode, None) for i, episode in enumerate(episodes)])
    senders.run(policy, memory)
    senders.check_untouched(policy)
    return senders
