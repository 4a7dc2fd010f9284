"""What a kept frame is worth to the robot: maps and tracking from the frames that arrived.

`frames` opens recordings of depth cameras, `room` makes one up, `mapping` fuses frames with their true poses into a
map and measures its error, `tracking` follows the camera by the frames alone and says where that fails. Needs the extra
`perception`; nothing is imported before it is asked for.
"""
