"""Settings of topics and of the in-flight window that are refused. (What they do to a sender: ``test_topics_twin``.)"""

import numpy as np
import pytest
from cases import order, trace
from refusal_cases import refused

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.checks import check_window
from bufgym.model.link import Link
from bufgym.model.topics import Topic, check_topics
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders, run

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.5)
MS = 1_000


def episode(times_ms, topic=0, **more):
    """Messages of 1000 bytes over a link of 1 MB/s."""
    arrivals = messages(np.array(times_ms) * MS, 1_000)
    arrivals["topic"] = topic
    return Episode(arrivals, Link(trace([(0, 0), (1_000 * MS, 1_000_000)], "loop")), **more)


def after_run(played, topics=()):
    return run(policies.get("drop-newest"), [played], 5, V, topics=topics)


A_B = (Topic("a"), Topic("b"))


test_what_is_refused = refused(
    (lambda: Topic(""), "topic '': a name must be a non-empty text"),
    *((lambda p=p: Topic("a", priority=p), "must be a number >= 0") for p in (-1, None, True, np.inf, 10**400)),
    *((lambda hz=hz: Topic("a", rate_limit_hz=hz), "must be a number > 0") for hz in (0, "10")),
    (lambda: Topic("a", weight=float("nan")), "weight = nan: must be a number >= 0"),
    *((lambda s=s: Topic("a", deadline_s=s), r"deadline_s = .*: must be a number > 0") for s in (0, 1e300)),
    (lambda: Topic("a", no_drop=1), "no_drop = 1: must be true or false"),
    *((lambda n=n: Topic("a", limit=n), "must be a whole number from 1") for n in (0, 1.5)),
    (lambda: Topic("a", value=0.618), "value = 0.618: must be a V of bufgym.model.qoi"),
    (lambda: Topic("a", no_drop=True, limit=3), "limit = 3: a no_drop topic can't have a limit"),
    (lambda: Senders(1, 2, V, max_messages=1, topics=[*A_B, Topic("a")]), "topic 'a': two topics have this name"),
    (lambda: check_topics(["a"]), "'a' is not a bufgym"),
    (lambda: check_topics([Topic(str(k)) for k in range(257)]), "257 topics: must be at most 256"),
    (lambda: after_run(episode([0, 1], [0, 2]), A_B), "episode: unknown topic 2; the senders know 2, from 0 on"),
    (lambda: after_run(episode([0, 1], [0, -1]), A_B), "message 1: topic = -1: must be >= 0"),
    *((lambda n=n: check_window(n), "n_T must be a whole number from 1") for n in (0, 1.0, True, "2", 10**6 + 1)),
    (lambda: after_run(episode([0], window=0)), "n_T must be a whole number from 1"),
    *((lambda us=us: episode([0], ack_delay_us=us), "must be a whole number from 0 to") for us in (-1, 0.5, None)),
)


def test_the_slowest_rate_limit():
    # Slower than any episode is long: the first message and no other.
    assert order(after_run(episode([0, 1, 10**9]), (Topic("a", rate_limit_hz=1e-300),))) == [0]
