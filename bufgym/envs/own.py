"""What is computed beside the kernel of a step: your own observation fields and reward terms, and ``regret``.

Compiled functions are values of one function type, as policies are, so these kernels are compiled once for all of them.
Other functions run in ordinary Python. Row i of a batch and the single environment call the same function.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.observation import ObservationForm, Place
from bufgym.envs.output import StepOutput
from bufgym.envs.reward import APART
from bufgym.jit import compile_signature, kernel, named, unchecked_at, unchecked_slice
from bufgym.kernels.kinds import BOOL, FLOAT, INT, KernelError, Pointer, Tuple, array_kind, record_kind
from bufgym.model.buffer import MESSAGE, TOPIC, Buffer
from bufgym.model.documented import documented
from bufgym.model.observe import Field, OwnTerm
from bufgym.oracle.hindsight import Hindsight
from bufgym.policies.registry import view_kind
from bufgym.sim import Senders
from bufgym.sim.rollout import python_arrival, python_view
from bufgym.sim.state import ARRIVAL_WAITS, LOG_ENTRY, NOTHING_WAITS, Batch
from bufgym.sim.view import last_arrival, view
from bufgym.utils.errors import BufgymError

# Columns of ``marks``: counts of a sender at the step before, and that step's end.
TRANSMITTED, CREDITED, DROPS, UNTIL = range(4)


@documented
class Step(NamedTuple):
    """The events of one step, for reward terms. They are the truth; the robot knows only a part. Do not write to it.

    A reset is no step: the first step begins with the episode.
    """

    messages: NDArray[Any]
    """MESSAGE[arrived]: every message that has arrived so far, in order."""
    log: NDArray[Any]
    """LOG_ENTRY[arrived]: the fate of each message: ``transmitted_us``, ``dropped_us`` (-1 if not yet) and others."""
    transmitted: NDArray[np.int64]
    """int64[messages]: indices in ``messages`` whose last byte crossed the link in this step, in order."""
    delivered: NDArray[np.int64]
    """int64[messages]: indices that reached the server in this step, ``propagation_us`` later."""
    drops: int
    """Messages dropped in this step."""
    from_us: int
    """Begin of the step, us."""
    until_us: int
    """End of the step, us: the next decision, or the episode's last delivery."""
    propagation_us: int
    """Time from a message's last byte on the link to the server, us."""
    queued: int
    """Messages in the buffer at the step's end."""
    backlog_bytes: int
    """Bytes of these messages."""
    capacity: int
    """L, messages."""
    ended: bool
    """Whether the episode ends with this step."""
    topics: NDArray[Any]
    """TOPIC[topics]: settings and past of each topic."""
    parameters: NDArray[np.float64]
    """float64[parameters], read-only: the term's settings, in the order of its registration."""


@kernel
def write_slots(batch: Batch, function: Any, first: int, flat: NDArray[np.float32]) -> None:
    """Write a slot field into the columns from ``first`` on, for each row that waits for a decision."""
    for i in range(len(batch.senders)):
        sender = batch.senders[i]
        if sender.waiting != NOTHING_WAITS:
            buffer, arrival = view(batch, i), last_arrival(batch, i)
            for k in range(sender.occupancy):
                flat[i, first + k] = function(buffer, arrival, k)
            flat[i, first + sender.occupancy : first + sender.capacity + 1] = 0.0
            if sender.waiting == ARRIVAL_WAITS:
                flat[i, first + sender.capacity] = function(buffer, arrival, sender.occupancy)


@kernel
def write_context(batch: Batch, function: Any, first: int, flat: NDArray[np.float32]) -> None:
    """Write a context field into the column ``first``, for each row that waits for a decision."""
    for i in range(len(batch.senders)):
        if batch.senders[i].waiting != NOTHING_WAITS:
            flat[i, first] = function(view(batch, i), last_arrival(batch, i))


def write_in_python(place: Place, buffer: Buffer, arrival: Any, arriving: bool, row: NDArray[np.float32]) -> None:
    """Write a field into a row of numbers by calling its function, compiled or not, from Python."""
    field, first = place.field, place.first
    if field.per == "context":
        row[first] = field.function(buffer, arrival)
    else:
        s = len(buffer.slots)
        row[first : first + place.entries] = 0.0
        row[first : first + s] = [field.function(buffer, arrival, k) for k in range(s)]
        if arriving:
            row[first + place.entries - 1] = field.function(buffer, arrival, s)
    check_bounds(field, row[first : first + place.entries])


def check_bounds(field: Field, numbers: NDArray[np.float32]) -> None:
    """Raise a BufgymError if the field is outside its registered bounds."""
    inside = (numbers >= np.float32(field.low)) & (numbers <= np.float32(field.high))  # False for NaN
    if not inside.all():
        wrong = float(numbers[~inside].flat[0])
        raise BufgymError(f"field {field.name!r}: is {wrong:g}: must lie in its bounds, {field.low:g}..{field.high:g}")


class OwnFields:
    """Your own fields that a form observes, filled after each step."""

    def __init__(self, form: ObservationForm) -> None:
        self._places = form.own_places
        self._compiled = [_compiled("field", p.field.per, p.field) if p.field.compile else None for p in self._places]

    def write(self, batch: Batch, output: StepOutput) -> None:
        """Write each field of every row that waits for a decision; other rows are 0 already."""
        records = named(batch)
        for place, compiled in zip(self._places, self._compiled, strict=True):
            if compiled is not None:
                compiled(batch, place.first, output.flat)
                check_bounds(place.field, output.flat[:, place.first : place.first + place.entries])
                continue
            for i in np.flatnonzero(batch.senders["waiting"] != NOTHING_WAITS).tolist():
                arriving = bool(batch.senders["waiting"][i] == ARRIVAL_WAITS)
                arrival = python_arrival(records, i, 0 if arriving else 1)
                write_in_python(place, python_view(records, i), arrival, arriving, output.flat[i])


@kernel
def step_of(batch: Batch, i: int, marks: NDArray[np.int64], ended: bool, parameters: NDArray[np.float64]) -> Step:
    """The step of row ``i`` since the ``marks``, int64[n, marks]."""
    sender = batch.senders[i]
    arrived = sender.next + 1 if sender.waiting == ARRIVAL_WAITS else sender.next
    return Step(
        unchecked_slice(batch.arrivals, i, 0, arrived),
        unchecked_slice(batch.log, i, 0, arrived),
        unchecked_slice(batch.order, i, marks[i, TRANSMITTED], sender.transmitted - marks[i, TRANSMITTED]),
        unchecked_slice(batch.order, i, marks[i, CREDITED], sender.credited - marks[i, CREDITED]),
        sender.rejected + sender.evicted - marks[i, DROPS],
        marks[i, UNTIL],
        end_of_step(batch, i, ended),
        sender.propagation_us,
        sender.occupancy,
        sender.backlog_bytes,
        sender.capacity,
        ended,
        unchecked_slice(batch.topics, i, 0, sender.topics),
        parameters,
    )


@kernel
def end_of_step(batch: Batch, i: int, ended: bool) -> int:
    """The present time; at an episode's end the time of the last delivery, if that is later."""
    sender = batch.senders[i]
    if not ended or sender.credited == 0:
        return int(sender.now_us)
    last = unchecked_at(batch.log, i, unchecked_at(batch.order, i, sender.credited - 1))
    return int(max(sender.now_us, last.transmitted_us + sender.propagation_us))


@kernel
def write_term(
    batch: Batch,
    function: Any,
    marks: NDArray[np.int64],
    ended: NDArray[np.bool_],
    memory: NDArray[np.float64],
    parameters: NDArray[np.float64],
    column: int,
    reward_terms: NDArray[np.float64],
) -> None:
    """Write the term's value for the step of every row; ``memory`` is float64[n, entries]."""
    for i in range(len(batch.senders)):
        reward_terms[i, column] = function(step_of(batch, i, marks, ended[i], parameters), memory[i])


class OwnTerms:
    """Your own reward terms that an environment names, in the columns from ``first`` on."""

    def __init__(self, terms: Sequence[OwnTerm], first: int, n: int) -> None:
        self._terms, self._first = terms, first
        self._parameters = [term.parameter_array for term in terms]
        self._memory = [np.zeros((n, max(1, len(term.memory)))) for term in terms]
        self._compiled = [_compiled("reward term", "term", term) if term.compile else None for term in terms]
        self._marks = np.zeros((n, 4), np.int64)
        for term in terms:
            if term.prepare is not None:
                term.prepare()

    def begin(self, batch: Batch, rows: NDArray[np.int64]) -> None:
        """Begin an episode in these rows."""
        self._marks[rows] = 0
        self._marks[rows, UNTIL] = batch.arrivals["arrival_us"][rows, 0]
        for term, memory in zip(self._terms, self._memory, strict=True):
            memory[rows, : len(term.memory)] = list(term.memory.values())

    def write(self, batch: Batch, output: StepOutput) -> None:
        """Write each term of the step that all rows have just taken."""
        ended = output.terminated
        for k, term in enumerate(self._terms):
            column, parameters, compiled = self._first + k, self._parameters[k], self._compiled[k]
            if compiled is not None:
                compiled(batch, self._marks, ended, self._memory[k], parameters, column, output.reward_terms)
            else:
                output.reward_terms[:, column] = 0.0
                asked = np.flatnonzero(ended | (not term.at_end)).tolist()
                records = named(batch) if asked else None
                for i in asked:
                    step = _read_only_step(records, i, self._marks, bool(ended[i]), parameters)
                    output.reward_terms[i, column] = term.function(step, self._memory[k][i])
            if not np.isfinite(output.reward_terms[:, column]).all():
                raise BufgymError(f"reward term {term.name!r}: is no finite number")
        senders = batch.senders
        self._marks[:, TRANSMITTED], self._marks[:, CREDITED] = senders["transmitted"], senders["credited"]
        self._marks[:, DROPS] = senders["rejected"] + senders["evicted"]
        self._marks[:, UNTIL] = senders["now_us"]


class Regret:
    """The reward ``regret``, in column ``column``: how much of the best attainable H each decision gives up.

    Let V* be the best H that can still be reached from a state by somebody who knows the whole link and workload. The
    reward of a step is the change of V*, and at the end H takes its place. V*(start) is the clairvoyant's H of the
    episode; what is lost before the first decision counts in the first step. So the rewards of an episode sum to
    H - V*(start), and the best policy is the same as under ``retained``: this is reward shaping by a potential
    [ng1999policy]. The luck of link and motion is taken out of the reward. Only the reward sees the future:
    observations and evaluations do not.
    """

    def __init__(self, senders: Senders, column: int) -> None:
        self._hindsight, self._column = Hindsight(senders, "reward = 'regret'"), column
        self._most = np.zeros(len(senders))
        self._every = np.arange(len(senders))

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Note V* of the episodes that these ``rows`` have loaded and not begun to play."""
        self._most[rows] = self._hindsight.at_start(rows)[rows]

    def write(self, output: StepOutput) -> None:
        """Write the change of V* in the step that all rows have just taken."""
        now = np.where(output.terminated, output.qoi, self._hindsight.most(self._every))
        output.reward_terms[:, self._column] = now - self._most
        self._most = now


class Beside:
    """What a step computes in Python when its kernel is done: ``regret``, and fields and terms of your own.

    ``sums`` says whether the reward has such a term, which the kernel's sum lacks; ``has_any``, whether there is any
    field or term to ``begin`` and ``write``.
    """

    def __init__(self, senders: Senders, form: ObservationForm, own: Sequence[OwnTerm], names: Sequence[str]) -> None:
        """``own`` are the named terms that are in no table; ``names`` are those of all terms, by column."""
        of_steps = [term for term in own if term.name not in APART]
        self._senders = senders
        self._terms = OwnTerms(of_steps, len(names) - len(own), len(senders))
        self._regret = Regret(senders, names.index("regret")) if "regret" in names else None
        self._fields = OwnFields(form)
        self.sums = bool(of_steps) or self._regret is not None
        self.has_any = self.sums or bool(form.own_places)

    def load(self, rows: NDArray[np.int64]) -> None:
        """See the episodes that these ``rows`` have loaded and not begun to play."""
        if self._regret is not None:
            self._regret.begin(rows)

    def begin(self, rows: NDArray[np.int64], output: StepOutput) -> None:
        """Begin an episode in these rows, at their first decision."""
        self._terms.begin(self._senders.batch, rows)
        self._fields.write(self._senders.batch, output)

    def write(self, output: StepOutput) -> None:
        """Write the terms of the step that all rows have just taken, and the fields they observe now."""
        self._terms.write(self._senders.batch, output)
        if self._regret is not None:
            self._regret.write(output)
        self._fields.write(self._senders.batch, output)


_python_step_of: Any = getattr(step_of, "py_func", step_of)


def _read_only_step(*arguments: Any) -> Step:
    """``step_of`` for terms in Python."""
    step: Step = _python_step_of(*arguments)
    for array in step:
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return step


@functools.cache
def pointers() -> dict[str, Pointer]:
    """Kinds of the functions of fields and terms."""
    whole, message, reals = array_kind(np.int64), record_kind(MESSAGE), array_kind(float)
    kinds: dict[str, Any] = {
        "messages": array_kind(MESSAGE),
        "log": array_kind(LOG_ENTRY),
        "topics": array_kind(TOPIC),
        "parameters": array_kind(float, constant=True),
        "ended": BOOL,
        **dict.fromkeys(("transmitted", "delivered"), whole),
    }
    step = Tuple(tuple(kinds.get(name, INT) for name in Step._fields), Step._fields, "Step")
    return {
        "slot": Pointer((view_kind(), message, INT), FLOAT),
        "context": Pointer((view_kind(), message), FLOAT),
        "term": Pointer((step, reals), FLOAT),
    }


WRITERS: dict[str, Any] = {"slot": write_slots, "context": write_context, "term": write_term}
"""Kind of function -> the loop that calls it for all rows."""


def _compiled(what: str, kind: str, own: Field | OwnTerm) -> Callable[..., None]:
    """The loop that writes a "slot" or "context" field or a "term" of all rows."""
    try:
        function = compile_signature(pointers()[kind], own.function)
    except KernelError as error:
        rule = "leave out compile=True, and it runs as plain Python"
        raise BufgymError(f"{what} {own.name!r}: is no kernel: {error}; {rule}") from None
    return lambda batch, *rest: WRITERS[kind](batch, function, *rest)
