"""Guided decisions: a few *outputs* change the numbers of one rule, ``gap-price``, for the decision at hand.

The outputs are factors and shifts on the rule's numbers, and come from an agent. All outputs zero are the rule itself.
So an agent begins at the rule and learns what to add to it, as residual policy learning does [silver2018residual;
johannink2019residual]. ``OUTPUTS`` are their meanings.

``INPUTS`` are what an agent may look at to find its outputs: what the rule knows, as logarithms of ratios. With

    lg(a, b) <- log(a / b), at most ``MOST`` either way
    r <- the rule's link rate;  size <- mean bytes of the queue and the newcomer
    come <- x_new - x_dequeued;  g <- the target gap, or come / (s + 1) where it is unknown

``linear`` is the policy whose outputs are linear in the inputs, by one set of weights under a light load and by another
under a heavy one, mixed by h. They are multiplied by 1 - ``plain``. So the plain rule stays on a measured steady link,
until the link has carried anything, and in bursts, where no target guides the outputs. A queue with one place is apart:
there the plain rule keeps an early message of each burst, which most outputs improve on.

    h <- (log(size / (mean rate over 20 s x arrival period)) - 0.7) / 1.5, at least 0 and at most 1
    outputs <- (1 - plain) (W_light + h W_heavy) inputs
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe.declare import Field, Function, writer
from bufgym.model.observe.on_board import mean_bytes
from bufgym.model.qoi import value
from bufgym.policies import chains, price_dp, target_gap
from bufgym.policies.gaps import gap_left
from bufgym.policies.price_dp import VARIANCE, remember_sizes, share
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.target_gap import SEEN_US, Numbers, bursty, head_goes, link_rate, needless, remember, target
from bufgym.policies.thinning import places, steady
from bufgym.utils.errors import BufgymError


class Output(NamedTuple):
    """One number of the rule that an agent sets."""

    name: str
    scale: float
    """Size of a large change. Files are checked by it, and nothing else reads it."""
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

MOST = 3.0  # Largest input and output, either way
SPREAD_US = 10e6  # Time over which the spread of the link's rate is measured, us
SLOW_US = 20e6
"""Time over which the mean rate says how heavy the load is, us. A shorter one opens the gate in every outage."""
HEAVY, HEAVIER = 0.7, 1.5
"""Log of messages that come for one that the link carries: where h begins to rise, and how much more makes it 1."""

LOG_RATE, LOG_RATE_VARIANCE, SLOW_RATE, RULE = range(4)  # Own entries of the memory, before those of the rule
REMEMBERED = {"log_rate": 0.0, "log_rate_variance": 0.0, "slow_rate": 0.0, **price_dp.REMEMBERED}
"""Memory: mean and variance of the log of the link's rate, bytes/s; its mean over ``SLOW_US``; what the rule keeps."""
BASE = np.array(list(price_dp.PARAMETERS.values()))  # The rule's numbers as they stand
NUMBERS, N_OUTPUTS = len(BASE), len(OUTPUTS)


@kernel
def lg(a: float, b: float) -> float:
    """The logarithm of a / b, at most ``MOST`` either way; 0 if both are 0."""
    if a > 0 and b > 0:
        return min(max(math.log(a / b), -MOST), MOST)
    if a <= 0 and b <= 0:
        return 0.0
    return MOST if a > 0 else -MOST


class Known(NamedTuple):
    """What the inputs are made of besides the buffer."""

    size: float  # mean bytes of the queue and the newcomer
    newcomer_bytes: float
    messages: int  # s + 1, the newcomer being one
    rate: float  # the rule's link rate r, bytes/us
    head_age_us: int  # time from the head's arrival to the newcomer's, us; 0 for an empty queue
    come: float  # motion since the message dequeued last
    has_target: bool  # whether the target gap is known
    gap: float  # the target gap g, or come / (s + 1) where it is unknown
    gain: float  # V(g)
    head_gap: float  # the gap left if the head is dropped; 0 for an empty queue
    log_rate_variance: float  # of the logarithm of the link's rate
    log_bytes_variance: float  # of the logarithm of bytes
    share: float  # a, the share of price-dp in the plain rule
    is_plain: bool  # whether outputs are not to change the rule


def declared(name: str, meaning: str, function: Function, low: float = -4.0, high: float = 4.0) -> Field:
    """Declare an input: a field of the context whose meaning says how it is scaled."""
    return Field(name, "context", "link", "see its meaning", meaning, function, low, high)


INPUT_FIELDS = (
    declared("short", "lg(rate over 0.1 s, rate over 2 s)",
             lambda buffer, known: lg(buffer.short_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    declared("medium", "lg(rate over 0.5 s, rate over 2 s)",
             lambda buffer, known: lg(buffer.medium_rate_bytes_per_s, buffer.long_rate_bytes_per_s)),
    declared("load", "lg(r x arrival period, size): how much more the link carries than one message an arrival",
             lambda buffer, known: lg(known.rate * buffer.period_us, known.size)),
    declared("bend", "2 (2 V(g) - V(2 g)) / V(g) - 1: -1 where V is straight, 1 where it is flat",
             lambda buffer, known:
             2 * (2 * known.gain - value(buffer.v, 2 * known.gap)) / known.gain - 1 if known.gain > 0 else -1.0),
    declared("spread", "2 (sd - 0.6), sd being that of the logarithm of the rate over 0.5 s, in the last 10 s",
             lambda buffer, known: min(2 * (math.sqrt(known.log_rate_variance) - 0.6), MOST)),
    declared("head_age", "lg(r x the head's age + 0.1 size, (s + 1) size): 0.1 alone for an empty queue",
             lambda buffer, known: lg(known.rate * known.head_age_us + 0.1 * known.size, known.messages * known.size)),
    declared("newcomer", "lg(come, (s + 1) g)", lambda buffer, known: lg(known.come, known.messages * known.gap)),
    declared("stall", "log(1 + r x time since a message was dequeued / size) - 0.5",
             lambda buffer, known: min(math.log(1 + known.rate * max(buffer.stalled_us, 0) / known.size) - 0.5, MOST)),
    declared("size_spread", "2 min(1, standard deviation of the logarithm of bytes over the last arrivals)",
             lambda buffer, known: 2 * min(math.sqrt(known.log_bytes_variance), 1.0)),
    declared("bytes", "lg(the newcomer's bytes, size)", lambda buffer, known: lg(known.newcomer_bytes, known.size)),
    declared("fill", "2 s / L - 1", lambda buffer, known: 2 * len(buffer.slots) / buffer.capacity - 1),
    declared("unknown", "1 where the target gap is unknown, otherwise 0",
             lambda buffer, known: 0.0 if known.has_target else 1.0),
    declared("one", "always 1", lambda buffer, known: 1.0),
    declared("head_gap", "lg(the gap left if the head goes, g); 0 for an empty queue",
             lambda buffer, known: lg(known.head_gap, known.gap) if known.messages > 1 else 0.0),
    declared("share", "a, the share of price-dp in the plain rule", lambda buffer, known: known.share),
    declared("plain",
             "1 on a measured steady link, in bursts if there are two places, and until the link has carried anything",
             lambda buffer, known: 1.0 if known.is_plain else 0.0),
)  # fmt: skip
INPUTS = {field.name: field for field in INPUT_FIELDS}
MEANINGS = [(field.name, field.meaning) for field in INPUT_FIELDS]
N_INPUTS = len(INPUTS)
WORK = (chains.SCRATCH[0] + N_INPUTS + N_OUTPUTS + NUMBERS, chains.SCRATCH[1])
"""``Policy.work``: the rule's own, then inputs, outputs and numbers, at the memory's end."""
write_inputs = writer(INPUT_FIELDS, "buffer, known")


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
    rule, s, come = memory[RULE:], len(buffer.slots), arrival.x - buffer.dequeued_x
    rate, g = link_rate(buffer, rule, numbers), target(buffer, arrival, rule, numbers)
    has_target = g > 0
    if not has_target:
        g = come / (s + 1)
    known = Known(
        size=mean_bytes(buffer, arrival),
        newcomer_bytes=float(arrival.size_bytes),
        messages=s + 1,
        rate=rate,
        head_age_us=arrival.arrival_us - buffer.slots[0].arrival_us if s > 0 else 0,
        come=come,
        has_target=has_target,
        gap=g,
        gain=value(buffer.v, g),
        head_gap=gap_left(buffer, arrival, 0) if s > 0 else 0.0,
        log_rate_variance=memory[LOG_RATE_VARIANCE],
        log_bytes_variance=rule[VARIANCE],
        share=share(rule, numbers),
        is_plain=steady(buffer) or (bursty(rule) and places(buffer, arrival) > 1) or rate <= 0,
    )
    write_inputs(buffer, known, out)


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
        if needless(buffer, arrival) < 0 and head_goes(buffer, arrival, rule, numbers):
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
    SETTINGS: ClassVar[Mapping[str, Any]] = {}
    SHAPE: ClassVar[tuple[int, int]] = (2 * N_OUTPUTS, N_INPUTS)
    LIGHT: ClassVar[tuple[int, int]] = (N_OUTPUTS, N_INPUTS)
    TABLE: ClassVar[list[Any]] = [MEANINGS, [tuple(output) for output in OUTPUTS], price_dp.PARAMETERS]
    """What defines inputs, outputs and the rule: weights found with others would decide nonsense."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.CONTEXT_NAMES

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy with outputs W c for the inputs c. W = 0 is gap-price."""
        numbers = self.numbers(name, BASE)
        policy = Policy(name, on_arrival, weights=numbers, memory=REMEMBERED, work=WORK, compile=True, reads_rate=True)
        return replace(policy, about=about, source=source)

    def numbers(self, name: str, base: Numbers) -> tuple[float, ...]:
        """The rule's numbers and W as the weights of that policy. W_light alone gets W_heavy = 0."""
        W = np.asarray(self.weight, np.float64)
        if W.shape == self.LIGHT != self.SHAPE:
            W = np.concatenate([W, np.zeros_like(W)])
        if W.shape != self.SHAPE or not np.isfinite(W).all():
            rule = f"must be {self.SHAPE[0]} x {self.SHAPE[1]} finite numbers"
            raise BufgymError(f"policy {name!r}: weights of shape {list(W.shape)}: {rule}")
        return tuple(np.concatenate([base, W.reshape(-1)]).tolist())

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The numbers by name, as in a file."""
        return {f"{self.NETWORKS[0]}.weight": self.weight}

    @classmethod
    def definition(cls, fields: Sequence[str]) -> list[Any]:
        """What defines inputs, outputs and the rule: weights found with others would decide nonsense."""
        return cls.TABLE

    @staticmethod
    def inputs_text(fields: Sequence[str], settings: Mapping[str, Any]) -> str:
        """What the shapes follow from."""
        return f"{len(fields)} fields"

    @classmethod
    def shapes(
        cls, fields: Sequence[str], widths: Sequence[int], given: Mapping[str, Any], settings: Mapping[str, Any]
    ) -> dict[str, tuple[int, ...]]:
        """The shapes of ``tensors`` by name; of two that are possible, the ``given`` one."""
        name = f"{cls.NETWORKS[0]}.weight"
        return {name: cls.LIGHT if given.get(name) == cls.LIGHT else cls.SHAPE}

    @classmethod
    def of(cls, fields: Sequence[str], tensors: Mapping[str, NDArray[np.float32]], settings: Mapping[str, Any]) -> Self:
        """Make the weights of these ``tensors``."""
        return cls(*tensors.values())
