"""Worth of kept frames to a robot: maps and tracking from the frames that arrived.

`frames` opens recordings of depth cameras, and `room` makes one up. `mapping` fuses frames with their true poses into a
map and measures its error. `tracking` follows the camera by the frames alone and finds where that fails. The extra
`perception` is needed; modules are imported on demand.
"""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_papers.perception.frames import Sequence
    from bufgym_papers.perception.mapping import fuse, grid_of, map_error, points_of
    from bufgym_papers.perception.orb import OrbSimilarity, orbbuf_by
    from bufgym_papers.perception.recordings import open_sequence
    from bufgym_papers.perception.room import made_up_room
    from bufgym_papers.perception.tracking import Tracker, difference, jumped, track
    from bufgym_papers.perception.views import Coverage, seen_shares

__all__ = [
    "Coverage", "OrbSimilarity", "Sequence", "Tracker", "difference", "fuse", "grid_of", "jumped", "made_up_room",
    "map_error", "open_sequence", "orbbuf_by", "points_of", "seen_shares", "track",
]  # fmt: skip
__getattr__ = on_demand(__name__, {
    "Sequence": "frames", "fuse": "mapping", "grid_of": "mapping", "map_error": "mapping", "points_of": "mapping",
    "OrbSimilarity": "orb", "orbbuf_by": "orb", "open_sequence": "recordings", "made_up_room": "room",
    "Tracker": "tracking", "difference": "tracking", "jumped": "tracking", "track": "tracking", "Coverage": "views",
    "seen_shares": "views"
})  # fmt: skip
