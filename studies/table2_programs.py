"""The two programs of Robofleet's Table II. Each sends the messages that it reads to a server, and says its costs.

``python table2_programs.py PROGRAM PORT`` says "ready", then reads messages from its standard input, ROS binary behind
its length as ROS's own sockets have it, until there are no more. Then it writes its share of a core and its virtual
memory, as JSON. It is run as a file, so that each program loads its own libraries and no more.
"""

import asyncio
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any, Final

KIND: Final = "PointCloud2"
TYPE: Final = f"sensor_msgs/msg/{KIND}"
TOPIC: Final = "/robots/robot/lidar"


def read() -> bytes:
    """The next message; empty when there are no more."""
    length = int.from_bytes(sys.stdin.buffer.read(4), "little")
    return sys.stdin.buffer.read(length)


def plain(value: Any, arrays_as_lists: bool) -> Any:
    """A message of rosbags as dictionaries."""
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: plain(getattr(value, name), arrays_as_lists) for name in names if not name.startswith("__")}
    if isinstance(value, list):
        return [plain(item, arrays_as_lists) for item in value]
    return value.tolist() if arrays_as_lists and hasattr(value, "tolist") else value


class Cost:
    """The costs since ``begin``."""

    def begin(self) -> None:
        self._wall_s, self._cpu_s = time.monotonic(), time.process_time()

    def say(self) -> None:
        share = (time.process_time() - self._cpu_s) / (time.monotonic() - self._wall_s)
        sizes = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        megabytes = {name: int(sizes[name].split()[0]) * 1024 / 1e6 for name in ("VmSize", "VmRSS")}
        print(
            json.dumps({"cpu": share, "virtual_mb": megabytes["VmSize"], "resident_mb": megabytes["VmRSS"]}), flush=True
        )


def rosbridge(port: int) -> None:
    """RosLibPy's client: JSON in which bytes are numbers."""
    import roslibpy
    from rosbags.typesys import Stores, get_typestore  # not bufgym's, which this program must not load

    store, cost = get_typestore(Stores.ROS1_NOETIC), Cost()
    ros = roslibpy.Ros("127.0.0.1", port)
    ros.run(timeout=30)
    topic = roslibpy.Topic(ros, TOPIC, TYPE.replace("/msg/", "/"))
    topic.advertise()
    print("ready", flush=True)
    cost.begin()
    while raw := read():
        topic.publish(roslibpy.Message(plain(store.deserialize_ros1(raw, TYPE), True)))
    cost.say()
    ros.close()
    while ros.is_connected:  # it has only asked for the end, and the messages before it may not have left yet
        time.sleep(0.01)


async def robofleet(port: int) -> None:
    """Our sender with Robofleet's rule, n_T = 1 and a flatbuffer for each message, in the place of Robofleet's own."""
    from bufgym_robot.channels import WebSocketChannel
    from bufgym_robot.sender import Sender
    from bufgym_robot.wire.queue import PolicyQueue
    from studies.encodings import encode, stores

    store, cost, queue = stores()["ros1"], Cost(), PolicyQueue("robofleet", 32, window=1)
    sender = Sender(queue, lambda: WebSocketChannel.connect("127.0.0.1", port))
    sending = asyncio.create_task(sender.run())
    await asyncio.wait_for(sender.connected.wait(), 60)
    print("ready", flush=True)
    cost.begin()
    while raw := await asyncio.to_thread(read):
        message = encode(KIND, plain(store.deserialize_ros1(raw, TYPE), False), "robofleet", TOPIC)
        queue.put(message, len(message))
    queue.close()
    await sending
    cost.say()


if __name__ == "__main__":
    program, port = sys.argv[1], int(sys.argv[2])
    if program == "rosbridge":
        rosbridge(port)
    else:
        asyncio.run(robofleet(port))
