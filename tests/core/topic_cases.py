"""Random episodes with topics, each for the package and for its reference model in ``naive_sender``."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import naive
import naive_sender
import numpy as np
from cases import Case, cases, reference_messages
from hypothesis import strategies as st

from bufgym import policies
from bufgym.model import observe, qoi
from bufgym.model.topics import Topic
from bufgym.policies.registry import ClientSettings
from bufgym.sim import Senders
from bufgym.sim.decisions import answer_dequeue, answer_send, decide
from bufgym.sim.state import DECISION, DEPARTURE, DEQUEUE, END, SEND
from bufgym.sim.transition import next_event

REFERENCE_V = {
    **{qoi.exponential(base): naive.exponential(base) for base in (0.3, 0.618, 0.95)},
    **{qoi.saturating(distance): naive.saturating(distance) for distance in (0.5, 2.0, 7.0)},
}
"""V functions and their reference models."""
V = st.sampled_from(list(REFERENCE_V))

EVENTS = dict(zip(range(5), ("end", "departure", "decision", "dequeue", "send"), strict=True))
"""The reference model's names of ``sim.END``, ``sim.DEPARTURE`` and so on."""
assert (END, DEPARTURE, DECISION, DEQUEUE, SEND) == tuple(range(5))

CLIENT_RULES = ("limit_at_send", "limit_since_sent", "flush_no_drop")
"""Settings of the client that change what a sender does."""


def decide_anything(buffer, arrival, memory):
    """Any decision, impossible ones included: -3 is none at all, then ACCEPT, REJECT, and slots beyond the last."""
    return int(arrival.uniform * (buffer.capacity + 5)) - 3


def send_anything(buffer, memory):
    """Any choice of what to send, HOLD (-1) and impossible ones included."""
    return (buffer.now_us // 3 + 5 * len(buffer.slots) + 11 * buffer.dequeued) % (buffer.capacity + 3) - 1


def drop_some(buffer, memory):
    """Whether the head is to be dropped."""
    return (buffer.now_us // 7 + len(buffer.slots)) % 3 == 0


@dataclass
class TopicCase:
    """One episode, the rules of its topics (none: one queue), and how the program around the policy sends."""

    case: Case
    topics: tuple[Topic, ...]
    v: qoi.Value
    schedules: bool
    drops_heads: bool
    client: ClientSettings

    def senders(self) -> Senders:
        """With the episode loaded and the policy's flags set, as ``Senders.run`` does."""
        senders = self.case.senders(self.v, self.topics)
        rows = senders.batch.senders
        rows["ask_at_send"], rows["ask_at_dequeue"] = self.schedules, self.drops_heads
        for rule in CLIENT_RULES:
            rows[rule] = getattr(self.client, rule)
        return senders

    def run(self, policy: policies.Policy) -> Senders:
        senders = self.senders()
        senders.run(policy)
        return senders

    def policy(self, *, compile: bool) -> policies.Policy:
        """One that answers as ``decide_anything``, ``send_anything`` and ``drop_some`` do."""
        hooks: dict[str, Any] = {"on_send": send_anything} if self.schedules else {}
        hooks |= {"on_dequeue": drop_some} if self.drops_heads else {}
        return policies.Policy("test-anything", decide_anything, client=self.client, compile=compile, **hooks)

    def reference(self) -> naive_sender.Sender:
        case, episode = self.case, self.case.episode
        rules: Any = [reference_rules(topic, self.v) for topic in self.topics] or naive_sender.Rules(
            REFERENCE_V[self.v]
        )
        link = naive.Link(case.knots, episode.link.trace.after, episode.link.offset_us)
        settings = {rule: getattr(self.client, rule) for rule in CLIENT_RULES}
        settings |= {"window": episode.window, "ack_delay_us": episode.ack_delay_us}
        settings |= {"propagation_us": episode.link.propagation_us, "decide_at": case.decide_at}
        settings |= {"schedules": self.schedules, "drops_heads": self.drops_heads, "max_bytes": case.max_bytes}
        return naive_sender.Sender(link, rules, case.capacity, **settings)

    def beside_its_reference(self, check: Callable[[str, Senders, Any], None]) -> tuple[Senders, Any]:
        """Product and reference after the same answers to events; ``check(event, senders, reference)`` sees each."""
        senders = self.senders()
        batch, to_kernel = (senders.batch, {"decision": decide, "send": answer_send, "dequeue": answer_dequeue})

        def ask(reference: Any, event: str) -> Any:
            assert EVENTS[next_event(batch, None, 0)] == event
            check(event, senders, reference)
            answer = self.answer(reference, event)
            if event in to_kernel:
                to_kernel[event](batch, 0, answer)
            return answer

        return senders, self.run_reference(ask)

    def run_reference(self, ask: Callable[[Any, str], Any] | None = None) -> Any:
        """The reference model after the episode; ``ask(reference, event)`` answers, as the policy does if not given."""
        reference, episode = self.reference(), self.case.episode
        reference.ask = functools.partial(ask or self.answer, reference)
        return reference.run(self.case.reference_messages, episode.first_decision, episode.last_decision)

    def answer(self, reference: Any, event: str) -> Any:
        known = {"capacity": self.case.capacity, "now_us": reference.now, "dequeued": len(reference.dequeued)}
        buffer = SimpleNamespace(slots=reference.slots(), **known)
        if event == "decision":
            return decide_anything(buffer, SimpleNamespace(uniform=reference.newcomer["uniform"]), None)
        if event == "send":
            return send_anything(buffer, None)
        return drop_some(buffer, None) if event == "dequeue" else None


SLOT_NAMES = [field.name for field in observe.SLOT_FIELDS + observe.TOPIC_SLOT_FIELDS]
CONTEXT_NAMES = [field.name for field in observe.CONTEXT_FIELDS + observe.TOPIC_CONTEXT_FIELDS]


def observed(buffer: Any, arrival: Any, arriving: bool) -> dict[str, Any]:
    """What the kernels observe, by field; the places are full of rubbish before."""
    slots = np.full((len(SLOT_NAMES), buffer.capacity + 1), np.nan)
    context = np.full(len(CONTEXT_NAMES), np.nan)
    if len(buffer.topics) == 1:
        slots, context = slots[: len(observe.SLOT_FIELDS)], context[: len(observe.CONTEXT_FIELDS)]
        observe.observe(buffer, arrival, slots, context)
    else:
        observe.observe_topic_slots(buffer, arrival, arriving, slots)
        observe.observe_topic_context(buffer, arrival, arriving, context)
    return dict(zip(SLOT_NAMES, slots, strict=False)) | dict(zip(CONTEXT_NAMES, context, strict=False))


def reference_rules(topic: Topic, v: qoi.Value) -> naive_sender.Rules:
    return naive_sender.Rules(
        REFERENCE_V[topic.value or v],
        topic.priority,
        topic.priority if topic.weight is None else topic.weight,
        0 if topic.rate_limit_hz is None else round(1e6 / topic.rate_limit_hz),
        float("inf") if topic.limit is None else topic.limit,
        topic.no_drop,
        float("inf") if topic.deadline_s is None else round(topic.deadline_s * 1e6),
    )


@st.composite
def topic_rules(draw: st.DrawFn, name: str) -> Topic:
    no_drop = draw(st.sampled_from([False, False, True]))
    return Topic(
        name,
        priority=draw(st.sampled_from([0.0, 0.5, 1.0, 20.0])),
        rate_limit_hz=draw(st.sampled_from([None, 50.0, 300.0, 1e6 / 700, 1e6])),
        limit=None if no_drop else draw(st.sampled_from([None, None, 1, 2, 3])),
        no_drop=no_drop,
        weight=draw(st.sampled_from([None, 0.0, 0.3, 4.0])),
        value=draw(st.one_of(st.none(), V)),
        deadline_s=draw(st.sampled_from([None, 0.001, 0.02])),
    )


@st.composite
def topic_cases(draw: st.DrawFn, min_topics: int = 0, max_messages: int = 60) -> TopicCase:
    """Windows of 1 to 4, with and without pongs; 0 topics: a plain sender."""
    case = draw(cases(max_messages=max_messages))
    n = draw(st.integers(min_topics, 4))
    arrivals = case.episode.arrivals.copy()
    if n > 0:
        arrivals["topic"] = np.random.default_rng(draw(st.integers(0, 2**32))).integers(0, n, len(arrivals))
    window, ack_delay_us = draw(st.integers(1, 4)), draw(st.sampled_from([0, 0, 1, 700, 20_000]))
    episode = replace(case.episode, arrivals=arrivals, window=window, ack_delay_us=ack_delay_us)
    case = replace(case, episode=episode, reference_messages=reference_messages(arrivals))
    topics = tuple(draw(topic_rules(f"topic {k}")) for k in range(n))
    client = ClientSettings(**{rule: draw(st.booleans()) for rule in CLIENT_RULES})
    v, schedules, drops_heads = (
        draw(each) for each in (V, st.sampled_from([True, True, False]), st.sampled_from([False, False, True]))
    )
    return TopicCase(case, topics, v, schedules, drops_heads, client)
