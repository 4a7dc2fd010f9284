"""Suites over made-up links: LTE, generated like recordings, blackouts, steady, switching, one interruption."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.scenario.interruption import Interruption
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.scenario.uplink import Uplink
from bufgym.traces import Motion, Trace, drive_motion, markov_link, synthetic_lte
from bufgym.traces.generate.lte import LTE_MODES

RATE_HZ = 30.0
"""Messages a second of the camera."""
SIZE_BYTES = 230_000  # AFR's RGB-D frames: about 200 kB of depth and a JPEG
DEMAND_BYTES_PER_S = RATE_HZ * SIZE_BYTES
EPISODE_S = 60.0
camera = functools.partial(Uplink, rate_hz=RATE_HZ, size_bytes=SIZE_BYTES, duration_s=EPISODE_S)
"""An ``Uplink`` with this stream."""


# Checking a Value takes compiled code, which is slow to load: it is made at its first use, not for `bufgym list`.


@functools.cache
def time_value() -> Value:
    """V over frame indices, as in AFR's Fig. 5."""
    return qoi.exponential(0.618)


@functools.cache
def motion_value() -> Value:
    """V = 1 - exp(-motion), over fields of view."""
    return qoi.exponential(math.exp(-1))


FIRST_SEED = {"train": 1000, "validation": 2000, "test": 3000}
"""Seeds of generated traces and motions count up from here; those of the shipped ones are 0..7."""

TRACES = {"train": 24, "validation": 6, "test": 12}
"""Links in a split; some suites have a half or a third as many for each of their scenarios."""
MORE_TRACES = {"train": 48, "validation": 48, "test": 48}  # The same of suites that resolve smaller differences


def motions_of(split: str, count: int = 4) -> tuple[Motion, ...]:
    """The drives of a split."""
    return tuple(drive_motion(FIRST_SEED[split] + k) for k in range(count))


def lte_links(first: int, count: int, means: Sequence[float]) -> tuple[Trace, ...]:
    """Synthetic LTE links with seeds from ``first`` on; they take the means (bytes/s) and the modes in turn."""
    modes = list(LTE_MODES)
    return tuple(
        synthetic_lte(first + k, mean_bytes_per_s=means[k % len(means)], mode=modes[k % 3]) for k in range(count)
    )


def both_values(
    traces: Sequence[Trace], motions: tuple[Motion, ...], size_bytes: int = SIZE_BYTES, suffix: str = ""
) -> dict[str, Setting]:
    """The same links, once with time-based and once with motion-based QoI."""
    about = f"{RATE_HZ:g} messages/s of {size_bytes / 1000:g} kB for {EPISODE_S:g} s"
    timed = camera(traces=tuple(traces), size_bytes=size_bytes, value=time_value())
    moving = replace(timed, motion=motions, value=motion_value())
    return {
        f"time{suffix}": Setting(timed, f"{about}; x is the frame index"),
        f"motion{suffix}": Setting(moving, f"{about}; x is the camera's motion, in fields of view"),
    }


def both_sizes(traces: Sequence[Trace], motions: tuple[Motion, ...]) -> dict[str, Setting]:
    """Both values, once with AFR's frames and once with large ones."""
    return both_values(traces, motions, 230_000, "-230kB") | both_values(traces, motions, 900_000, "-900kB")


def _lte(split: str, data: Path, count: Mapping[str, int] = TRACES) -> dict[str, Setting]:
    """Means of 3, 5, 7 and 9 MB/s around the demand of 6.9 MB/s, in turn; modes likewise."""
    return both_values(lte_links(FIRST_SEED[split], count[split], (3e6, 5e6, 7e6, 9e6)), motions_of(split))


_MOVING = ("foot", "bicycle", "bus", "tram", "train", "car")


def _generated(split: str, data: Path, count: Mapping[str, int] = TRACES) -> dict[str, Setting]:
    """The settings of lte-belgium-v1 over generated links and motions; the ways of moving take turns."""
    traces = [markov_link(_MOVING[k % 6], FIRST_SEED[split] + k) for k in range(count[split])]
    return both_sizes(traces, motions_of(split))


OUTAGES_S = (5, 10, 20, 40, 60)
_AROUND_S = 60  # seconds of the episode outside the blackout


def _outage(split: str, data: Path) -> dict[str, Setting]:
    settings = {}
    for outage_s in OUTAGES_S:
        whole_s = outage_s + _AROUND_S
        traces = tuple(_blackout(FIRST_SEED[split] + k, outage_s) for k in range(TRACES[split] // 3))
        moving = camera(traces=traces, motion=motions_of(split), value=motion_value())
        scenario = replace(moving, duration_s=float(whole_s), link_offset_s=(0.0, 10.0))
        about = f"one blackout of {outage_s} s within {whole_s} s; x is the camera's motion"
        settings[f"outage-{outage_s}s"] = Setting(scenario, about, float(outage_s))
    return settings


def _blackout(seed: int, outage_s: int) -> Trace:
    """A good LTE link (mean 12 MB/s) of 75 s that stands still from its 30th second on for ``outage_s`` seconds."""
    lengths_us, rates = synthetic_lte(seed, _AROUND_S + 15, mean_bytes_per_s=12e6).samples()
    steps = [(float(us) / 1e6, float(rate)) for us, rate in zip(lengths_us, rates, strict=True)]
    return Trace.steps([*steps[:30], (float(outage_s), 0.0), *steps[30:]], name=f"blackout-{outage_s}s-{seed}")


SHARES = {"quarter": 0.25, "half": 0.5, "three-quarters": 0.75}
_SHIFT = {"train": 0.0, "validation": 1 / 3, "test": 5 / 6}
"""Shift of a split's rates, as a fraction of their spacing, so that no two splits share a rate."""


def steady_links(split: str, label: str, share: float, count: int) -> tuple[Trace, ...]:
    """Steady links, spread evenly within 6 % of the share of the demand."""
    shares = [share * (0.94 + 0.12 * (k + _SHIFT[split]) / count) for k in range(count)]
    return tuple(
        Trace.constant(each * DEMAND_BYTES_PER_S, 300.0, name=f"steady-{label}-{FIRST_SEED[split] + k}")
        for k, each in enumerate(shares)
    )


def _sustained(split: str, data: Path) -> dict[str, Setting]:
    settings: dict[str, Setting] = {}
    for label, share in SHARES.items():
        links = steady_links(split, label, share, TRACES[split] // 3)
        settings |= both_values(links, motions_of(split), suffix=f"-{label}")
    return settings


def _interruption(split: str, data: Path) -> dict[str, Setting]:
    """T up to 400; lengths with T mod 5 = 3 are for validation, 4 for testing, the others for training."""
    rests = {"train": (0, 1, 2), "validation": (3,), "test": (4,)}[split]
    lengths = tuple(T for T in range(1, 401) if T % 5 in rests)
    values: dict[str, Value] = {
        "exponential-0.618": time_value(),
        "exponential-0.9": qoi.exponential(0.9),
        "saturating-8": qoi.saturating(8),
    }
    about = f"one interruption of T messages, T log-uniform on 1..400 with T mod 5 in {rests}"
    return {
        label: Setting(Interruption(lengths=lengths, value=v), f"{about}; V = {v.name}") for label, v in values.items()
    }


TOPS, STAYS = (0.75, 0.9, 1.2, 1.4), (0.8, 0.9, 0.95)
"""Top rates of switching links over the demand, and chances to keep a rate from one arrival to the next; the links take
them in turn. The top rate is never the demand: a link at exactly the demand favours rules that keep it so."""
SWITCHING_HZ, SWITCHING_BYTES, SWITCHING_MESSAGES = 10.0, 100_000, 100
SWITCHING_LINKS = {"train": 108, "validation": 36, "test": 108}
"""Switching links of a split; each has a law of its own, and carries one episode."""


def switching_link(seed: int, top: float, stay: float) -> Trace:
    """A link that switches at arrivals among four rates, and keeps the demand's rate after the stream.

    The rates are 0, about a quarter and about half of the demand, and ``top`` of it. The link keeps its rate with the
    chance ``stay``, and takes each other rate equally often.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    rates = (0.0, 0.25 * rng.uniform(0.7, 1.4), 0.5 * rng.uniform(0.8, 1.3), top)
    demand, state, steps = SWITCHING_HZ * SWITCHING_BYTES, int(4 * rng.random()), []
    for _ in range(SWITCHING_MESSAGES):
        steps.append((1 / SWITCHING_HZ, rates[state] * demand))
        if rng.random() >= stay:
            state = (state + 1 + int(3 * rng.random())) % len(rates)
    return Trace.steps([*steps, (1.0, demand)], name=f"switching-{seed}", after="hold")


def _switching(split: str, data: Path) -> dict[str, Setting]:
    links = tuple(
        switching_link(FIRST_SEED[split] + k, TOPS[k % len(TOPS)], STAYS[k % len(STAYS)])
        for k in range(SWITCHING_LINKS[split])
    )
    stream = Uplink(links, rate_hz=SWITCHING_HZ, jitter=0.0, size_bytes=SWITCHING_BYTES, random_offset=False)
    stream = replace(stream, duration_s=SWITCHING_MESSAGES / SWITCHING_HZ)
    about = "100 messages of 100 kB at 10 Hz over links that switch among four rates"
    return {
        f"switching-{base:g}": Setting(replace(stream, value=qoi.exponential(base)), f"{about}; V = 1 - {base:g}^d")
        for base in (0.5, 0.618, 0.8)
    }


LTE = Suite("lte-v1", "30 Hz camera over synthetic LTE links", _lte)

SUITES = (
    Suite(
        "interruption-v1",
        "one interruption of unknown length (AFR paper, Sec. III-B)",
        _interruption,
        capacities=(4, 5, 8, 10, 15, 16, 20, 25, 32),
        seeds=200,
    ),
    LTE,
    Suite("outage-v1", "one blackout of 5 to 60 s on a good link", _outage),
    Suite("sustained-v1", "steady links of a quarter, half and three quarters of the demand", _sustained),
    Suite("switching-v1", "short queues over links that switch among four rates", _switching, (2, 3, 4, 5), seeds=1),
    Suite("generated-v1", "30 Hz camera over links generated like recordings of six ways of moving", _generated),
    *(
        Suite(
            f"{name}-v2",
            f"{name}-v1 on four times as many test links",
            functools.partial(build, count=MORE_TRACES),
            seeds=2,
        )
        for name, build in (("lte", _lte), ("generated", _generated))
    ),
)
