"""Any fields of one queue: one kernel writes exactly those that an agent's observation names.

Facts that fields share are computed once, and only where a chosen field needs them.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe.declare import Field
from bufgym.model.observe.on_board import ON_BOARD_FIELDS, ON_BOARD_SLOT_FIELDS, choose_context, choose_on_board_slots
from bufgym.model.observe.queue import CONTEXT_FIELDS, SLOT_FIELDS, choose_of_tables

BUILT_IN: Mapping[str, Field] = {
    field.name: field for field in (*SLOT_FIELDS, *CONTEXT_FIELDS, *ON_BOARD_SLOT_FIELDS, *ON_BOARD_FIELDS)
}
"""Every field of one queue by name."""


class Chosen(NamedTuple):
    """Fields to write into a row of numbers.

    Fields:
        slots: int64[SLOT_FIELDS], the index of each field's first number in the row, or -1 for one that is left out.
        context: int64[CONTEXT_FIELDS], likewise, and so on.
        on_board_slots: int64[ON_BOARD_SLOT_FIELDS].
        on_board: int64[ON_BOARD_FIELDS].
        counts: int64[4], how many of each kind are chosen.
    """

    slots: NDArray[np.int64]
    context: NDArray[np.int64]
    on_board_slots: NDArray[np.int64]
    on_board: NDArray[np.int64]
    counts: NDArray[np.int64]


def chosen_at(first: Mapping[str, int]) -> Chosen:
    """The fields of these names, and where each one's numbers begin in the row."""
    tables = SLOT_FIELDS, CONTEXT_FIELDS, ON_BOARD_SLOT_FIELDS, ON_BOARD_FIELDS
    places = [np.array([first.get(field.name, -1) for field in table], np.int64) for table in tables]
    slots, context, on_board_slots, on_board = places
    counts = np.array([(part >= 0).sum() for part in places], np.int64)
    return Chosen(slots, context, on_board_slots, on_board, counts)


@kernel
def write_chosen(buffer: Buffer, arrival: Any, chosen: Chosen, row: NDArray[np.floating[Any]]) -> None:
    """Write the chosen fields of one queue into ``row``; empty slots are 0, the newcomer is last."""
    if chosen.counts[0] + chosen.counts[1] > 0:
        choose_of_tables(buffer, arrival, chosen.slots, chosen.counts[0] > 0, chosen.context, row)
    write_chosen_on_board(buffer, arrival, True, chosen, row)


@kernel
def write_chosen_on_board(
    buffer: Buffer, arrival: Any, arriving: bool, chosen: Chosen, row: NDArray[np.floating[Any]]
) -> None:
    """Write the chosen fields outside the tables, which several topics have too.

    Where the socket asks (not ``arriving``), ``arrival`` is the latest one and has no column.
    """
    if chosen.counts[2] > 0:
        choose_on_board_slots(buffer, arrival, arriving, chosen.on_board_slots, row)
    if chosen.counts[3] > 0:
        choose_context(buffer, arrival, chosen.on_board, row)
