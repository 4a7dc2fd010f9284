"""Learned policies: a slot scorer's weights from a file, decided by a compiled forward pass. No torch, no code.

See docs/methods.md, "Slot scorers".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, newcomer_stays
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    FIELDS,
    ON_BOARD_FIELDS,
    ON_BOARD_SLOT_FIELDS,
    PAST_FIELDS,
    SLOT_FIELDS,
    observe,
    observe_on_board,
    observe_on_board_slots,
)
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.scoring import DROP, KEEP, Network, Scorer, Scratch, begin, divide, score, unpack

__all__ = ["NAMES", "Network", "Weights"]

SLOT_NAMES = tuple(field.name for field in (*SLOT_FIELDS, *ON_BOARD_SLOT_FIELDS))
CONTEXT_NAMES = tuple(field.name for field in (*CONTEXT_FIELDS, *ON_BOARD_FIELDS))
NAMES = SLOT_NAMES + CONTEXT_NAMES
SLOTS, CONTEXT = len(SLOT_NAMES), len(CONTEXT_NAMES)
# Fields beyond these are observed only if they are read.
TABLE_SLOTS, TABLE = len(SLOT_FIELDS), len(CONTEXT_FIELDS)
BESIDE = (*ON_BOARD_FIELDS, *ON_BOARD_SLOT_FIELDS)


@kernel
def look(buffer: Buffer, arrival: Arrival, scorer: Scorer, scratch: Scratch) -> None:
    """Observe what the scorer reads."""
    context, slot = scorer.fields[: scorer.context], scorer.fields[scorer.context :]
    if reads(context, 0, TABLE) or reads(slot, 0, TABLE_SLOTS):
        observe(buffer, arrival, scratch.rows[:TABLE_SLOTS], scratch.context[:TABLE])
    if reads(context, TABLE, CONTEXT):
        observe_on_board(buffer, arrival, scratch.context[TABLE:CONTEXT])
    if reads(slot, TABLE_SLOTS, SLOTS):
        observe_on_board_slots(buffer, arrival, scratch.rows[TABLE_SLOTS:SLOTS])


@kernel
def reads(fields: NDArray[np.float64], begin: int, end: int) -> bool:
    """Whether any of ``fields`` is in this part of the observation."""
    found = False
    for field in fields:
        found = found or begin <= field < end
    return found


@kernel
def choose(buffer: Buffer, arrival: Arrival, scorer: Scorer, scratch: Scratch) -> int:
    """The decision with the highest score, by what is observed."""
    s, L = len(buffer.slots), buffer.capacity
    for i in range(scorer.context):
        scratch.f[i] = scratch.context[int(scorer.fields[i])]
    common = begin(scorer, DROP, scratch)
    own, best, decision, freed_bytes = score(scorer, DROP, common, L, scratch), -np.inf, REJECT, 0
    for k in range(s):
        dropped = score(scorer, DROP, common, k, scratch)
        if dropped >= own:
            freed_bytes += buffer.slots[k].size_bytes
        if dropped > best:
            best, decision = dropped, k
    if not newcomer_stays(buffer, arrival, own <= best, freed_bytes):
        best, decision = own, REJECT
    if has_space(buffer, arrival):
        common = begin(scorer, KEEP, scratch)
        if score(scorer, KEEP, common, L, scratch) >= best:
            decision = ACCEPT
    return decision


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision with the highest score."""
    scorer = unpack(buffer.parameters)
    scratch = divide(memory, scorer, CONTEXT, SLOTS, buffer.capacity)
    look(buffer, arrival, scorer, scratch)
    return choose(buffer, arrival, scorer, scratch)


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained slot scorer."""
    return decide(buffer, arrival, memory)


@dataclass(frozen=True)
class Weights:
    """A slot scorer for one queue: the fields that it reads, and its networks."""

    SLOT_NAMES: ClassVar[tuple[str, ...]] = SLOT_NAMES
    CONTEXT_NAMES: ClassVar[tuple[str, ...]] = CONTEXT_NAMES
    NETWORKS: ClassVar[tuple[str, ...]] = ("drop", "accept")
    LAYERS: ClassVar[int] = 2
    SETTINGS: ClassVar[Mapping[str, Any]] = {}

    fields: tuple[str, ...]
    """Names of the fields read, in the order of the networks' inputs."""
    drop: Network
    """Scores dropping a candidate."""
    accept: Network
    """Scores accepting the newcomer, where there is room."""

    @property
    def context(self) -> tuple[str, ...]:
        """The context's fields."""
        return tuple(name for name in self.fields if name in self.CONTEXT_NAMES)

    @property
    def slot(self) -> tuple[str, ...]:
        """The candidate's own fields."""
        return tuple(name for name in self.fields if name in self.SLOT_NAMES)

    @property
    def widths(self) -> tuple[int, int]:
        """Widths of the two hidden layers; 0 for none."""
        first, second, *_ = *self.drop.widths, 0, 0
        return first, second

    def parameters(self) -> NDArray[np.float64]:
        """The scorer as parameters for ``unpack``."""
        context, slot = self.context, self.slot
        order = [self.fields.index(name) for name in (*context, *slot)]
        places = [*map(self.CONTEXT_NAMES.index, context), *map(self.SLOT_NAMES.index, slot)]
        networks = [getattr(self, name).flat(order) for name in self.NETWORKS]
        header = [len(self.fields), len(context), *self.widths, len(networks[0])]
        return np.concatenate([header, places, *networks])

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The numbers by name, as in a file."""
        return {f"{n}.{name}": tensor for n in self.NETWORKS for name, tensor in getattr(self, n).tensors().items()}

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights; it works for every L."""
        on_link = any(field.group == "link" for field in BESIDE if field.name in self.fields)
        past = any(field.name in self.fields for field in PAST_FIELDS)
        numbers, (first, second) = tuple(self.parameters().tolist()), self.widths
        work = 2 * len(self.fields) - len(self.context) + 2 * first + second + CONTEXT, SLOTS  # see ``divide``
        policy = Policy(name, on_arrival, weights=numbers, work=work, compile=True, reads_left=True, built_in=True)
        return replace(policy, reads_rate=on_link, reads_past=past, about=about, source=source)

    @staticmethod
    def definition(fields: Sequence[str]) -> list[Any]:
        """What defines the observation; fields beside the table count only if they are among ``fields``."""
        beside = [field for field in BESIDE if field.name in fields]
        return [(field.name, field.per, field.unit, field.meaning) for field in (*FIELDS, *beside)]

    @staticmethod
    def inputs_text(fields: Sequence[str], settings: Mapping[str, Any]) -> str:
        """What the shapes follow from."""
        return f"{len(fields)} fields"

    @classmethod
    def shapes(
        cls, fields: Sequence[str], widths: Sequence[int], given: Mapping[str, Any], settings: Mapping[str, Any]
    ) -> dict[str, tuple[int, ...]]:
        """The shapes of ``tensors`` for these fields and hidden layers of these widths, by name."""
        one = Network.shapes(len(fields), widths)
        return {f"{n}.{name}": shape for n in cls.NETWORKS for name, shape in one.items()}

    @classmethod
    def of(
        cls, fields: Sequence[str], tensors: Mapping[str, NDArray[np.float32]], settings: Mapping[str, Any]
    ) -> "Weights":
        """Make the weights of these fields and ``tensors``."""
        return cls(tuple(fields), *(Network.of(tensors, f"{n}.") for n in cls.NETWORKS))
