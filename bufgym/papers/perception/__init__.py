"""Worth of kept frames to a robot: maps and tracking from the frames that arrived.

`frames` opens recordings of depth cameras, and `room` makes one up. `mapping` fuses frames with their true poses into a
map and measures its error. `tracking` follows the camera by the frames alone and finds where that fails. The extra
`perception` is needed; modules are imported on demand.
"""
