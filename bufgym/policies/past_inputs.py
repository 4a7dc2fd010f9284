"""What a network among candidates sees of the past of link and camera, and of the stream's end: fields from -2 to 2."""

from typing import Any

from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe import ON_BOARD_FIELDS, PAST_FIELDS
from bufgym.model.observe.declare import writer
from bufgym.policies.registry import Arrival

END = ("remaining", "told")
PAST_INPUTS = (*PAST_FIELDS, *(field for field in ON_BOARD_FIELDS if field.name in END))
"""Fields of one queue; a network sees 4 f - 2 of each number f."""
PAST_NAMES = tuple(field.name for field in PAST_INPUTS)
N_PAST = len(PAST_INPUTS)
_write = writer(PAST_INPUTS, "buffer, arrival")


@kernel
def past_inputs(buffer: Buffer, arrival: Arrival, out: NDArray[Any]) -> None:
    """Write what is seen into ``out``, float[N_PAST]."""
    _write(buffer, arrival, out)
    for i in range(N_PAST):
        out[i] = 4 * out[i] - 2
