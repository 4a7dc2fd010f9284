"""Guided decisions: a few *outputs* change the numbers of one rule, ``gap-price``, for the decision at hand.

The outputs are factors and shifts on the rule's numbers, and come from outside: from an agent, or from an action of an
environment. All outputs zero are the rule itself. So an agent begins at the rule and learns what to add to it, as
residual policy learning does [silver2018residual; johannink2019residual]. ``OUTPUTS`` are their meanings.

``INPUTS`` are what an agent may look at to find its outputs: what the rule knows, as logarithms of ratios. With

    lg(a, b) <- log(a / b), at most ``MOST`` either way
    r <- the rule's link rate;  size <- mean bytes of the queue and the newcomer
    come <- x_new - x_dequeued;  g <- the target gap, or come / (s + 1) where it is unknown

``linear`` is the policy whose outputs are linear in the inputs, by one set of weights under a light load and by another
under a heavy one, mixed by h. They are multiplied by 1 - ``plain``. So the plain rule stays on a measured steady link,
until the link has carried anything, and in bursts, where no target guides the outputs. A queue with one place is apart:
there the plain rule keeps an early message of each burst, which most outputs mend.

    h <- (log(size / (mean rate over 20 s x arrival period)) - 0.7) / 1.5, at least 0 and at most 1
    outputs <- (1 - plain) (W_light + h W_heavy) inputs
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.errors import BufgymError
from bufgym.ground.kernel import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe.on_board import mean_bytes
from bufgym.model.qoi import value
from bufgym.policies import chains, price_dp, target_gap
from bufgym.policies.gaps import gap_left
from bufgym.policies.price_dp import VARIANCE, remember_sizes, share
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.target_gap import SEEN_US, Numbers, bursty, last_chance, link_rate, needless, remember, target
from bufgym.policies.thinning import places, steady


class Output(NamedTuple):
    """One number of the rule that an agent sets."""

    name: str
    scale: float
    """The output for an action of 1."""
    meaning: str


OUTPUTS = (
    Output("threshold", 1.0, "factor e^o on the gap that may be left with room"),
    Output("discount", 0.5, "shift by o of the discount on old gaps"),
    Output("head", 1.0, "factor e^o on the head's own target"),
    Output("bias", 1.0, "factor e^o on the weight of the gap that the head would leave"),
    Output("near", 1.0, "factor e^o on how early the head is asked"),
    Output("kappa", 1.0, "factor e^o on the price of bytes"),
    Output("tail", 1.0, "factor e^o on how far behind the newcomer the chains end"),
    Output("price_threshold", 0.5, "shift by o units of the advantage that a drop with room must have"),
    Output("price_discount", 0.5, "shift by o (1 - k / s) units of the worth of dropping slot k of s"),
    Output("share", 1.0, "shift by 4 o of the share of price-dp, before the logistic function"),
)
O_THRESHOLD, O_DISCOUNT, O_HEAD, O_BIAS, O_NEAR, O_KAPPA, O_TAIL = range(7)
O_PRICE_THRESHOLD, O_PRICE_DISCOUNT, O_SHARE = range(7, 10)
SCALES = np.array([output.scale for output in OUTPUTS])

INPUTS = {
    "short": "lg(rate over 0.1 s, rate over 2 s)",
    "medium": "lg(rate over 0.5 s, rate over 2 s)",
    "load": "lg(r x arrival period, size): how much more the link carries than one message an arrival",
    "bend": "2 (2 V(g) - V(2 g)) / V(g) - 1: -1 where V is straight, 1 where it is flat",
    "spread": "2 (sd - 0.6), sd being that of the logarithm of the rate over 0.5 s, in the last 10 s",
    "head_age": "lg(r x the head's age + 0.1 size, (s + 1) size): 0.1 alone for an empty queue",
    "newcomer": "lg(come, (s + 1) g)",
    "stall": "log(1 + r x time since a message was dequeued / size) - 0.5",
    "size_spread": "2 min(1, standard deviation of the logarithm of bytes over the last arrivals)",
    "bytes": "lg(the newcomer's bytes, size)",
    "fill": "2 s / L - 1",
    "unknown": "1 where the target gap is unknown, otherwise 0",
    "one": "always 1",
    "head_gap": "lg(the gap left if the head goes, g); 0 for an empty queue",
    "share": "a, the share of price-dp in the plain rule",
    "plain": "1 on a measured steady link, in bursts if there are two places, and until the link has carried anything",
}
"""Names and meanings of the inputs, in their order."""
MOST = 3.0  # Largest input and output, either way
SPREAD_US = 10e6  # Time over which the spread of the link's rate is measured, us
SLOW_US = 20e6
"""Time over which the mean rate says how heavy the load is, us. A shorter one opens the gate in every outage."""
HEAVY, HEAVIER = 0.7, 1.5
"""Logarithm of messages that come for one that the link carries: where h begins to rise, and how much more makes it
1."""

LOG_RATE, LOG_RATE_VARIANCE, SLOW_RATE, RULE = range(4)  # Own entries of the memory, before those of the rule
REMEMBERED = {"log_rate": 0.0, "log_rate_variance": 0.0, "slow_rate": 0.0, **price_dp.REMEMBERED}
"""Memory: mean and variance of the logarithm of the link's rate, bytes/s; its mean over ``SLOW_US``; and what the rule
remembers."""
BASE = np.array(list(price_dp.PARAMETERS.values()))  # The rule's numbers as they stand
NUMBERS, N_INPUTS, N_OUTPUTS = len(BASE), len(INPUTS), len(OUTPUTS)
WORK = (chains.SCRATCH[0] + N_INPUTS + N_OUTPUTS + NUMBERS, chains.SCRATCH[1])
"""``Policy.work``: the rule's own, then inputs, outputs and numbers, at the memory's end."""


@kernel
def lg(a: float, b: float) -> float:
    """The logarithm of a / b, at most ``MOST`` either way; 0 if both are 0."""
    if a > 0 and b > 0:
        return min(max(math.log(a / b), -MOST), MOST)
    if a <= 0 and b <= 0:
        return 0.0
    return MOST if a > 0 else -MOST


@kernel
def recall(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers) -> None:
    """Update the memory; call it at every arrival."""
    rule = memory[RULE:]
    remember(buffer, arrival, rule, numbers)
    remember_sizes(buffer, arrival, rule)
    us, rate = float(arrival.arrival_us - buffer.previous_us), buffer.medium_rate_bytes_per_s
    if buffer.evictions > 0 or us <= 0 or rate <= 0:
        return
    slow = us / min(us + SLOW_US, rule[SEEN_US]) if memory[SLOW_RATE] > 0 else 1.0
    memory[SLOW_RATE] += slow * (rate - memory[SLOW_RATE])
    level = math.log(max(rate, 1.0))
    weight = us / min(us + SPREAD_US, rule[SEEN_US]) if memory[LOG_RATE] > 0 else 1.0
    off = level - memory[LOG_RATE]
    memory[LOG_RATE] += weight * off
    memory[LOG_RATE_VARIANCE] = (1 - weight) * (memory[LOG_RATE_VARIANCE] + weight * off * off)


@kernel
def inputs(buffer: Buffer, arrival: Arrival, memory: Memory, numbers: Numbers, out: NDArray[Any]) -> None:
    """Write ``INPUTS`` into ``out``, once ``recall`` has been called; ``numbers`` are the plain rule's."""
    rule, s, size = memory[RULE:], len(buffer.slots), mean_bytes(buffer, arrival)
    rate, long_rate = link_rate(buffer, rule, numbers), buffer.long_rate_bytes_per_s
    come, g = arrival.x - buffer.dequeued_x, target(buffer, arrival, rule, numbers)
    known = g > 0
    if not known:
        g = come / (s + 1)
    v = value(buffer.v, g)
    out[0] = lg(buffer.short_rate_bytes_per_s, long_rate)
    out[1] = lg(buffer.medium_rate_bytes_per_s, long_rate)
    out[2] = lg(rate * buffer.period_us, size)
    out[3] = 2 * (2 * v - value(buffer.v, 2 * g)) / v - 1 if v > 0 else -1.0
    out[4] = min(2 * (math.sqrt(memory[LOG_RATE_VARIANCE]) - 0.6), MOST)
    age_us = arrival.arrival_us - buffer.slots[0].arrival_us if s > 0 else 0
    out[5] = lg(rate * age_us + 0.1 * size, (s + 1) * size)
    out[6] = lg(come, (s + 1) * g)
    out[7] = min(math.log(1 + rate * max(buffer.stalled_us, 0) / size) - 0.5, MOST)
    out[8] = 2 * min(math.sqrt(rule[VARIANCE]), 1.0)
    out[9] = lg(float(arrival.size_bytes), size)
    out[10] = 2 * s / buffer.capacity - 1
    out[11] = 0.0 if known else 1.0
    out[12] = 1.0
    out[13] = lg(gap_left(buffer, arrival, 0), g) if s > 0 else 0.0
    out[14] = share(rule, numbers)
    out[15] = 1.0 if steady(buffer) or (bursty(rule) and places(buffer, arrival) > 1) or rate <= 0 else 0.0


@kernel
def set_numbers(outputs: NDArray[Any], base: Numbers, numbers: NDArray[np.float64]) -> bool:
    """Copy ``base`` into ``numbers``, changed by ``outputs``; return whether any output is not zero."""
    changed = False
    for k in range(NUMBERS):
        numbers[k] = base[k]
    for k in range(N_OUTPUTS):
        changed = changed or outputs[k] != 0
    if not changed:
        return False
    o_threshold = bounded(outputs[O_THRESHOLD])
    numbers[price_dp.THRESHOLD] *= math.exp(o_threshold)
    numbers[price_dp.SPARE] *= math.exp(o_threshold)
    numbers[target_gap.DISCOUNT] += bounded(outputs[O_DISCOUNT])
    numbers[price_dp.SPARE_DISCOUNT] += bounded(outputs[O_DISCOUNT])
    numbers[price_dp.HEAD] *= math.exp(bounded(outputs[O_HEAD]))
    numbers[price_dp.BIAS] *= math.exp(bounded(outputs[O_BIAS]))
    near = math.exp(bounded(outputs[O_NEAR]))
    numbers[target_gap.NEAR] *= near
    numbers[price_dp.PRICE_NEAR] *= near
    numbers[price_dp.KAPPA] *= math.exp(bounded(outputs[O_KAPPA]))
    numbers[price_dp.TAIL] *= math.exp(bounded(outputs[O_TAIL]))
    numbers[price_dp.PRICE_THRESHOLD] += bounded(outputs[O_PRICE_THRESHOLD])
    numbers[price_dp.PRICE_DISCOUNT] += bounded(outputs[O_PRICE_DISCOUNT])
    numbers[price_dp.SHARE_LOW] -= 4 * bounded(outputs[O_SHARE])
    return True


@kernel
def bounded(output: float) -> float:
    """``output``, at most ``MOST`` either way."""
    return min(max(output, -MOST), MOST)


@kernel
def follow(buffer: Buffer, arrival: Arrival, memory: Memory, base: Numbers, outputs: NDArray[Any]) -> int:
    """The decision of the rule with the numbers ``base`` changed by ``outputs``, once ``recall`` has been called."""
    rule, numbers = memory[RULE:], memory[len(memory) - NUMBERS :]
    changed = set_numbers(outputs, base, numbers)
    a = share(rule, numbers)
    if a == 0:
        if not changed:
            return target_gap.decide(buffer, arrival, rule, numbers)
        if needless(buffer, arrival) < 0 and last_chance(buffer, arrival, rule, numbers):
            return 0
    return price_dp.decide(buffer, arrival, rule, numbers, a)


@kernel
def heaviness(buffer: Buffer, arrival: Arrival, memory: Memory) -> float:
    """h of the module's text; 0 until the link has carried anything."""
    carried = memory[SLOW_RATE] * 1e-6 * buffer.period_us
    if carried <= 0:
        return 0.0
    return min(max((math.log(mean_bytes(buffer, arrival) / carried) - HEAVY) / HEAVIER, 0.0), 1.0)


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The rule gap-price, its numbers linear in what the robot sees."""
    base, weights = buffer.parameters[:NUMBERS], buffer.parameters[NUMBERS:]
    seen = memory[len(memory) - NUMBERS - N_OUTPUTS - N_INPUTS :]
    outputs = memory[len(memory) - NUMBERS - N_OUTPUTS :]
    recall(buffer, arrival, memory, base)
    inputs(buffer, arrival, memory, base, seen)
    h = heaviness(buffer, arrival, memory)
    for o in range(N_OUTPUTS):
        total = 0.0
        for i in range(N_INPUTS):
            k = o * N_INPUTS + i
            total += (weights[k] + h * weights[N_OUTPUTS * N_INPUTS + k]) * seen[i]
        outputs[o] = total * (1 - seen[N_INPUTS - 1])
    return follow(buffer, arrival, memory, base, outputs)


@dataclass(frozen=True)
class GuidedWeights:
    """Weights of an agent whose outputs are linear in the inputs, as in a file."""

    weight: NDArray[np.float32]
    """float32[2 x outputs, inputs], W_light above W_heavy; or W_light alone, where W_heavy is 0."""

    SLOT_NAMES: ClassVar[tuple[str, ...]] = ()
    CONTEXT_NAMES: ClassVar[tuple[str, ...]] = tuple(INPUTS)
    NETWORKS: ClassVar[tuple[str, ...]] = ("guided",)
    LAYERS: ClassVar[int] = 0
    SHAPE: ClassVar[tuple[int, int]] = (2 * N_OUTPUTS, N_INPUTS)
    LIGHT: ClassVar[tuple[int, int]] = (N_OUTPUTS, N_INPUTS)
    TABLE: ClassVar[list[Any]] = [list(INPUTS.items()), [tuple(output) for output in OUTPUTS], price_dp.PARAMETERS]
    """What defines inputs, outputs and the rule: weights found with others would decide nonsense."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.CONTEXT_NAMES

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights."""
        return linear(name, self.weight, about, source)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The numbers by name."""
        return {"weight": self.weight}


def numbers_of(name: str, base: Numbers, weights: NDArray[Any], shape: tuple[int, int]) -> tuple[float, ...]:
    """The rule's numbers and W, which must have this shape, as a policy's weights. W_light alone gets W_heavy = 0."""
    W = np.asarray(weights, np.float64)
    if W.shape == GuidedWeights.LIGHT != shape:
        W = np.concatenate([W, np.zeros_like(W)])
    if W.shape != shape or not np.isfinite(W).all():
        rule = f"must be {shape[0]} x {shape[1]} finite numbers"
        raise BufgymError(f"policy {name!r}: weights of shape {list(W.shape)}: {rule}")
    return tuple(np.concatenate([base, W.reshape(-1)]).tolist())


def linear(name: str, weights: NDArray[np.floating[Any]], about: str = "", source: str = "") -> Policy:
    """Make the policy with outputs W c for the inputs c; ``weights`` is W [outputs, inputs]. W = 0 is gap-price."""
    numbers = numbers_of(name, BASE, weights, GuidedWeights.SHAPE)
    policy = Policy(name, on_arrival, weights=numbers, memory=REMEMBERED, work=WORK, compile=True, reads_rate=True)
    return replace(policy, about=about, source=source)
