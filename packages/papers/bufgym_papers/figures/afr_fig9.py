"""Fig. 9 of the AFR paper: duration of one decision.

Each built-in policy decides for a full queue in two ways. Inside compiled code, decisions run as in rollouts and
training. Called from Python, they run one at a time, as in a live queue. The paper's numbers come from its own machine
and ROS program, and its ORBBuf recomputes ORB features from images. We show ORBBuf twice: `orbbuf` compares recorded
motion, and `orbbuf-images` compares images of a made-up room at 640x480 and needs the extra ``perception``. Times
depend on this machine and differ from run to run, so compare orders of magnitude.
"""

import time
import timeit
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.jit import JIT, kernel, records
from bufgym.model.buffer import ACCEPT, MESSAGE, Buffer
from bufgym.policies.registry import Policy
from bufgym.scenario import Interruption
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures.figure import COLOURS, Figure, about, finish, legend_below, whole
from bufgym_papers.figures.rows import FigureRows, listed

IMAGES = "orbbuf-images"
PAPER = {"afr": "< 10 us", "drop-oldest": "< 10 us", "random": "< 10 us", IMAGES: "~ 10 ms"}
"""Decision times in the paper's figure; ORBBuf recomputes its features."""
PAPER_MS = 10.0  # ORBBuf's recalculation
LIMIT_PYTHON_US = 10.0  # Our limit for the paper's three fast policies: for the median call from Python
HOW = "compiled loop" if JIT else "Python loop (compilation is off)"  # Kind of loop that ``inside_us`` times
REPEATS = 5  # Compiled loops timed. The fastest counts, because the others shared the machine with other work.


@kernel
def decide_often(
    buffer: Buffer,
    arrivals: NDArray[Any],
    memory: NDArray[np.float64],
    start: NDArray[np.float64],
    on_arrival: Any,
    rounds: int,
) -> int:
    """Decide ``rounds`` times on each of ``arrivals``; return the decisions' sum so that none is optimized away."""
    total = 0
    for _ in range(rounds):
        # Each round is a new interruption; otherwise AFR's r would double without end.
        for j in range(len(start)):
            memory[j] = start[j]
        for k in range(len(arrivals)):
            total += on_arrival(buffer, arrivals[k], memory)
    return total


def full_queue(capacity: int, arrivals: int) -> tuple[Buffer, NDArray[Any]]:
    """Make a full queue in an interruption, as a policy sees it, and the next messages, MESSAGE[``arrivals``]."""
    interruption = Interruption(law="fixed", t_max=capacity + arrivals)
    episode = interruption.episode(capacity + arrivals).with_uniforms(np.random.Generator(np.random.PCG64(0)))
    captured: list[Buffer] = []

    def watch(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        if len(buffer.slots) < capacity:
            return ACCEPT
        if not captured:
            slots = records(capacity, MESSAGE)
            slots[:] = buffer.slots  # a copy, because the sender goes on
            scalars = {f: v.item() for f, v in buffer._asdict().items() if isinstance(v, np.generic)}
            captured.append(buffer._replace(slots=slots, topics=buffer.topics.copy(), **scalars))
        return 0

    sim.run(Policy("watch", watch), [episode], capacity, interruption.value)
    return captured[0], episode.arrivals[capacity + 1 : -1].copy()


def inside_us(policy: Policy, buffer: Buffer, arrivals: NDArray[Any], decisions: int) -> float:
    """Time one decision in a compiled loop, in us; the loop is Python where compilation is off."""
    on_arrival = policy.compiled[0]
    buffer = buffer._replace(parameters=policy.parameter_array)
    rounds = max(1, decisions // len(arrivals))
    start, memory = policy.new_memory(2, buffer.capacity)
    decide_often(buffer, arrivals, memory, start, on_arrival, 1)
    timed = timeit.repeat(
        lambda: decide_often(buffer, arrivals, memory, start, on_arrival, rounds), number=1, repeat=REPEATS
    )
    return 1e6 * min(timed) / (rounds * len(arrivals))


def called_us(policy: Policy, buffer: Buffer, arrivals: NDArray[Any], calls: int) -> tuple[float, float]:
    """Time one call from Python: median and 99th percentile in us, including the clock's own time."""
    on_arrival, (start, memory) = policy.compiled[0], policy.new_memory(2, buffer.capacity)
    buffer = buffer._replace(parameters=policy.parameter_array)
    one_by_one = [arrivals[k] for k in range(len(arrivals))]
    times_ns = np.zeros(calls, np.int64)
    for i in range(calls):
        k = i % len(one_by_one)
        if k == 0:
            memory[:] = start
        start_ns = time.perf_counter_ns()
        on_arrival(buffer, one_by_one[k], memory)
        times_ns[i] = time.perf_counter_ns() - start_ns
    return float(np.median(times_ns)) / 1e3, float(np.percentile(times_ns, 99)) / 1e3


def with_images_us(decisions: int) -> tuple[float, float] | None:
    """Time ORBBuf's decision by images: median and 99th percentile in us, or None without the libraries."""
    try:
        from bufgym_papers.perception import orb, room

        times_ms = orb.decision_ms(room.made_up_room(0, frames=decisions + orb.COMPARED), decisions)
    except (BufgymError, ImportError):
        return None
    return 1e3 * float(np.median(times_ms)), 1e3 * float(np.percentile(times_ms, 99))


@dataclass(frozen=True)
class Reproduction(Figure):
    """Fig. 9 with L = ``capacity``, ``decisions`` in the compiled loop and ``calls`` from Python per policy."""

    capacity: int = 8
    decisions: int = 1_000_000
    calls: int = 20_000
    images: int = 30  # decisions of ORBBuf by images; 0 for none

    RULES = {"images": whole(0)}

    def simulate(self) -> FigureRows:
        buffer, arrivals = full_queue(self.capacity, 400)
        rows = FigureRows()
        for policy in map(policies.get, policies.names(for_topics=False)):
            # Only built-in policies, because a user's policy names no source.
            if policy.compile and policy.source and policy.privileged is None:
                inside = inside_us(policy, buffer, arrivals, self.decisions)
                median, p99 = called_us(policy, buffer, arrivals, self.calls)
                times = {"inside_us": inside, "called_median_us": median, "called_p99_us": p99}
                rows.append({"policy": policy.name, **times, "paper": PAPER.get(policy.name, "-")})
        if self.images and (found := with_images_us(self.images)) is not None:
            called = {"called_median_us": found[0], "called_p99_us": found[1]}
            rows.append({"policy": IMAGES, "inside_us": None, **called, "paper": PAPER[IMAGES]})
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        called = {"called": ("called_median_us", ".2f"), "p99": ("called_p99_us", ".2f"), "paper": ("paper", "")}
        return rows.listing({"policy": ("policy", ""), "inside": ("inside_us", ".4f")} | called)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        fast = [row for row in rows if row["paper"].startswith("<")]
        called = [f"{row['policy']} {'yes' if row['called_median_us'] < LIMIT_PYTHON_US else 'NO'}" for row in fast]
        low_ms, high_ms = about(PAPER_MS)
        images_ms = [row["called_median_us"] / 1e3 for row in rows if row["policy"] == IMAGES]
        return {
            "orbbuf": low_ms <= images_ms[0] <= high_ms if images_ms else None,
            "images": f"{images_ms[0]:.1f} ms, median of {self.images}" if images_ms else "Not tested: no images",
            "times": all(row["inside_us"] < 10 for row in fast),
            "inside_us": ", ".join(f"{row['policy']} {row['inside_us']:.3f} us" for row in fast),
            "called": listed(called),
        }

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return 7.0, 0.34 * len(rows) + 2.2

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes, at = figure.add_subplot(), np.arange(len(rows))
        inside, median, p99 = (rows.column(f"{name}_us") for name in ("inside", "called_median", "called_p99"))
        axes.plot(inside, at, "o", color=COLOURS["afr"], label=f"inside a {HOW}")
        axes.hlines(at, median, p99, color=COLOURS["random"], linewidth=1.5)
        axes.plot(median, at, "s", color=COLOURS["random"], label="called from Python, median to p99")
        for sign, us, label in (("<", 10.0, "paper: under 10 us"), ("~", 10e3, "paper: ORBBuf, features recomputed")):
            lines = [i for i, row in enumerate(rows) if row["paper"].startswith(sign)]
            axes.plot([us] * len(lines), lines, "<D"[sign == "~"], color=COLOURS["drop-oldest"], label=label)
        title = f"One decision on a full queue, L = {self.capacity}"
        finish(axes, title, xscale="log", xlabel="time of one decision, us")
        axes.set_yticks(at, rows.distinct("policy"))
        axes.invert_yaxis()
        legend_below(figure, 2)
