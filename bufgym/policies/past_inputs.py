"""What a network among candidates sees of the past of link and camera, and of the stream's end: fields from -4 to 4.

A number is 0 where there is nothing to tell: the network skips it there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import Buffer
from bufgym.model.observe import ON_BOARD_FIELDS
from bufgym.model.observe.declare import writer
from bufgym.policies.registry import Arrival

NOTHING = {
    "since_change": 0.5, "rate_over_mean": 0.5, "top_rate": 0.5, "stall_now": 0.0, "stall_last": 0.0,
    "stall_before": 0.0, "since_stall": 1.0, "stalls_per_minute": 0.0, "rate_correlation": 0.5, "pace_now": 0.5,
    "since_stop": 1.0, "remaining": 1.0, "told": 0.0,
}  # fmt: skip
"""Field -> its number where there is nothing to tell, r; a network sees 4 (f - r)."""
_FIELDS = {field.name: field for field in ON_BOARD_FIELDS}
PAST_INPUTS = tuple(_FIELDS[name] for name in NOTHING)
PAST_NAMES = tuple(field.name for field in PAST_INPUTS)
N_PAST = len(PAST_INPUTS)
_NOTHING = np.array(list(NOTHING.values()))
_write = writer(PAST_INPUTS, "buffer, arrival")


@kernel
def past_inputs(buffer: Buffer, arrival: Arrival, out: NDArray[Any]) -> None:
    """Write what is seen into ``out``, float[N_PAST]."""
    _write(buffer, arrival, out)
    for i in range(N_PAST):
        out[i] = 4 * (out[i] - _NOTHING[i])
