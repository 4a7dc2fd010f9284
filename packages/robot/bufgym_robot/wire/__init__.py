"""What a robot and a relay share: the messages between them (PROTOCOL.md), the queue ahead of them, and a client.

The relay's package imports of the robot's nothing but this; and nothing here imports the rest of the robot's.
"""
