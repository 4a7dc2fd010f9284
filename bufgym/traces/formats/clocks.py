"""Log times of a recording's messages, and whether the recorder's clock can have shown them.

Arrival times are log times, so a clock that was set back would shuffle the messages. docs/methods.md, "Clocks, jumps
and units", says what is refused and what is warned of.
"""

import struct
from array import array
from collections.abc import Callable, Sequence
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.traces import plausible
from bufgym.traces.formats.definitions import BagTopic, is_plain_cdr, typestore
from bufgym.traces.formats.faults import LeftOut, StrPath, fault, warn
from bufgym.traces.sheet import Facts
from bufgym.traces.trace import MAX_DURATION_S, Int64Array, first_true

NS_PER_S: Final = 10**9
DAY_S: Final = 86_400
MAX_LOG_NS: Final = 2**63 - 1  # in the year 2262

# Threads of a recorder may log two messages of one topic in either order; what is further apart is a step of the clock.
_THREADS_NS: Final = NS_PER_S // 100
_ALONE_NS: Final = NS_PER_S  # A single message may be out of order by this much
_AROUND: Final = 3  # Messages before and after a step whose header stamps must agree on it

_HEADER: Final = {True: struct.Struct("<4xiI"), False: struct.Struct(">4xiI")}  # seconds and ns, by little-endian


class LogTimes:
    """Log time, topic and header stamp of each message of a recording, in the order of the file."""

    def __init__(self, path: StrPath) -> None:
        """Take the recording's name, for messages about it."""
        self.path = path
        self._time_ns, self._topic, self._ahead_ns = array("q"), array("q"), array("q")
        self._stamped = bytearray()
        self.topics: dict[str, int] = {}
        """Topic -> its number, in order of their first messages."""

    def add(self, channel: BagTopic, logged_ns: int, data: bytes) -> None:
        """Add a message."""
        if not 0 <= logged_ns <= MAX_LOG_NS:
            place = f"message {len(self._time_ns) + 1} ({channel.topic})"
            raise fault(self.path, "must be from 0 to 2**63 - 1 ns", value=logged_ns, field=f"{place}, log time in ns")
        stamp_ns = _stamp_ns(channel, data)
        self._time_ns.append(logged_ns)
        self._topic.append(self.topics.setdefault(channel.topic, len(self.topics)))
        self._ahead_ns.append(logged_ns - (stamp_ns or logged_ns))
        self._stamped.append(stamp_ns is not None)

    @property
    def time_ns(self) -> Int64Array:
        """Log times, int64[n]."""
        return np.array(self._time_ns, np.int64)

    @property
    def topic(self) -> Int64Array:
        """Which of `topics`, int64[n]."""
        return np.array(self._topic, np.int64)

    def order(self) -> Int64Array:
        """The messages in order of log time, int64[n]."""
        time_ns = self.time_ns
        self._check_range(time_ns)
        self._check_steps(time_ns)
        order = np.argsort(time_ns, kind="stable")
        behind_ns = np.maximum.accumulate(time_ns) - time_ns if len(time_ns) else time_ns
        if (behind_ns > _THREADS_NS).any():
            k, count = int(np.argmax(behind_ns)), int(np.count_nonzero(behind_ns))
            warn(
                self.path,
                f"{count} of {len(time_ns)} messages logged before a message above them, at most "
                f"{behind_ns[k] / NS_PER_S:.6g} s ({self._place(k)}): taken in order of log time",
            )
        return order

    def stamps(self, needed: bool) -> tuple[Facts, Callable[[Int64Array], Int64Array]]:
        """How header stamps went on and how late messages were, and the map from log times to the stamps' clock.

        Both are by the topic with most stamps; a clock of stamps that is ``needed`` must be there.
        """
        stamped, topic = np.frombuffer(self._stamped, np.bool_), self.topic
        counts = np.bincount(topic[stamped], minlength=1)
        name = list(self.topics)[int(np.argmax(counts))] if counts.max() else ""
        chosen = np.flatnonzero(stamped & (topic == int(np.argmax(counts))))
        log_ns, behind_ns = self.time_ns[chosen], np.array(self._ahead_ns, np.int64)[chosen]
        order = np.argsort(log_ns, kind="stable")
        log_ns, stamp_ns = log_ns[order], np.maximum.accumulate((log_ns - behind_ns)[order])
        if needed and (len(log_ns) < 2 or log_ns[0] == log_ns[-1]):
            raise fault(self.path, "no topic has header stamps: clock (--clock) must be log")
        rate = None if not len(log_ns) else plausible.stamp_rate(self.path, name, log_ns, stamp_ns, needed)

        def on_stamps(time_ns: Int64Array) -> Int64Array:
            at = np.interp(time_ns - log_ns[0], log_ns - log_ns[0], stamp_ns - stamp_ns[0])
            slope = float(stamp_ns[-1] - stamp_ns[0]) / float(log_ns[-1] - log_ns[0])
            outside = np.minimum(time_ns - log_ns[0], 0) + np.maximum(time_ns - log_ns[-1], 0)
            since_ns: Int64Array = np.rint(at + slope * outside).astype(np.int64)
            return np.asarray(since_ns + stamp_ns[0], np.int64)

        if rate is None:
            return (), on_stamps
        delay_s = float(np.median(behind_ns)) / NS_PER_S
        delay = f"delay {delay_s:.4g} s (median)" if abs(delay_s) < DAY_S else "of another clock"
        return (("stamps", f"{rate:.4g} s in a second of log time, {delay}, {name}"),), on_stamps

    def _check_range(self, time_ns: Int64Array) -> None:
        zero = first_true(time_ns == 0)
        if zero is not None and len(time_ns) > 1 and time_ns[time_ns > 0].min(initial=MAX_LOG_NS) > NS_PER_S:
            raise fault(self.path, f"{self._place(zero)} has no log time: all messages must have one")
        most_ns = MAX_DURATION_S * NS_PER_S
        if len(time_ns) == 0 or int(np.ptp(time_ns)) <= most_ns:
            return
        step = first_true(np.abs(np.diff(time_ns)) > most_ns)
        far = first_true(np.abs(time_ns - time_ns[0]) > most_ns) if step is None else step + 1
        assert far is not None
        other = 0 if step is None else step
        apart_s = abs(int(time_ns[far] - time_ns[other])) // NS_PER_S
        rule = f"is {apart_s} s from {self._place(other)}: a recording spans at most {MAX_DURATION_S} s"
        raise fault(self.path, f"{self._place(far)} {rule}")

    def _check_steps(self, time_ns: Int64Array) -> None:
        """Refuse a clock that went back: by the log times of a topic, or by their distance from header stamps."""
        by_topic = np.argsort(self.topic, kind="stable")
        ahead_ns, stamped = np.array(self._ahead_ns, np.int64), np.frombuffer(self._stamped, np.bool_)
        ends = np.cumsum(np.bincount(self.topic))
        back_ns = time_ns[:-1] - time_ns[1:]
        falls = np.flatnonzero(back_ns > _THREADS_NS) + 1  # messages before which the clock may have gone back
        fell_ns, steady = np.zeros(len(falls), np.int64), np.zeros(len(falls), np.bool_)
        steps: list[tuple[int, int]] = []  # message, message above it
        for places in np.split(by_topic, ends[:-1]):
            steps += [(int(places[k + 1]), int(places[k])) for k in np.flatnonzero(_goes_back(time_ns[places]))]
            places = places[stamped[places]]
            known, of_topic_ns = _fell(ahead_ns[places], np.searchsorted(places, falls))
            fell_ns = np.maximum(fell_ns, of_topic_ns)
            steady |= known & (of_topic_ns == 0)
        sizes_ns = dict(zip(falls.tolist(), np.where(steady, 0, fell_ns).tolist(), strict=True))
        steps += [(k, k - 1) for k, fell in sizes_ns.items() if fell >= back_ns[k - 1] - _THREADS_NS and fell > 0]
        if not steps:
            return
        message, above = min(steps)
        size_ns = sizes_ns.get(message, 0)
        least = "" if size_ns else "at least "
        size_ns = max(size_ns, int(time_ns[above] - time_ns[message]))
        raise fault(
            self.path,
            f"the recorder's clock goes back by {least}{size_ns / NS_PER_S:.6g} s before {self._place(message)}, after "
            f"{self._place(above)}: must not, as log times say when messages arrived (split the recording there)",
        )

    def _place(self, k: int) -> str:
        topic = list(self.topics)[self._topic[k]]
        seconds, ns = divmod(self._time_ns[k], NS_PER_S)
        return f"message {k + 1} ({topic}, logged at {seconds}.{ns // 10**6:03d} s)"


def warn_of_shared_times(path: StrPath, time: Int64Array, topic: Int64Array, names: Sequence[str]) -> None:
    """Warn of topics whose messages arrive several at a time, in any unit: a clock of coarse steps has logged them."""
    by_topic = np.argsort(topic, kind="stable")
    for places in np.split(by_topic, np.flatnonzero(np.diff(topic[by_topic])) + 1):
        if len(places):
            shared = LeftOut()
            shared.add(time[places], places + 1)
            shared.said(path, f"messages on {names[topic[places[0]]]}", "message", ": they arrive at once", verb="")


def _goes_back(time_ns: Int64Array) -> npt.NDArray[np.bool_]:
    """Whether the clock went back before each message of a topic but the first, bool[n-1].

    A single message that comes too late or too early by at most a second is no step of the clock.
    """
    back_ns = time_ns[:-1] - time_ns[1:]
    stays, was_before = np.zeros((2, len(back_ns)), np.bool_)
    stays[:-1] = time_ns[2:] < time_ns[:-2]  # so is the next message, below the one above the step
    was_before[1:] = time_ns[2:] < time_ns[:-2]  # below the one before that, too
    return np.asarray((back_ns > _ALONE_NS) | ((back_ns > _THREADS_NS) & stays & was_before))


def _fell(ahead_ns: Int64Array, after: Int64Array) -> tuple[npt.NDArray[np.bool_], Int64Array]:
    """Whether a topic shows how log times less header stamps went on from each of its messages ``after``, and by how
    much they fell there for good: 0 where they did not, or vary as much around it.
    """
    known = (after >= _AROUND) & (after <= len(ahead_ns) - _AROUND)
    fell_ns = np.zeros(len(after), np.int64)
    if known.any():
        windows = np.lib.stride_tricks.sliding_window_view(ahead_ns, _AROUND)
        before, below = windows[after[known] - _AROUND], windows[after[known]]
        spread_ns = np.maximum(np.ptp(before, axis=1), np.ptp(below, axis=1))
        fell = (np.median(before, axis=1) - np.median(below, axis=1)).astype(np.int64)
        fell_ns[known] = np.where(before.min(axis=1) - below.max(axis=1) > _THREADS_NS + spread_ns, fell, 0)
    return known, fell_ns


@cache
def _has_stamp(type: str, encoding: str) -> bool:
    """Whether messages of this type begin with a std_msgs/Header."""
    if encoding not in ("cdr", "ros1"):
        return False
    _, fields = typestore(encoding).fielddefs.get(type, ((), ()))
    return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"


def _stamp_ns(channel: BagTopic, data: bytes) -> int | None:
    """The header stamp of a message, ns; None where it has none, or none above 0."""
    if len(data) < 12 or not _has_stamp(channel.type, channel.encoding):
        return None
    if channel.encoding == "cdr" and not is_plain_cdr(data):
        return None
    # Before it stand 4 bytes: of CDR its encoding, of ROS 1 a sequence number.
    seconds, ns = _HEADER[channel.encoding == "ros1" or bool(data[1] & 1)].unpack_from(data)
    stamp_ns: int = seconds * NS_PER_S + ns
    return stamp_ns if stamp_ns > 0 else None
