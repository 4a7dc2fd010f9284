"""A robot of ROS at a relay, for test_robot.py: prints what came each way. Needs rospy and rosmaster, or rclpy.

node --/chatter, /odom--> ``bufgym robot`` --> relay --> viewer
viewer --/robots/r/to/speech, goal_pose, initialpose, cmd_vel and /robots/r/drive--> node
viewer --/robots/r/to/unheard--> nobody
"""

import asyncio
import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from loop_cases import beside
from pose_cases import ESTIMATE, POSE, message
from relay_cases import client, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.messages import Message
from bufgym_robot.wire.session import Session

TEXT = "std_msgs/msg/String"
CONFIG = '[[topic]]\nname = "chatter"\nrate_hz = 20\nsize_bytes = 20\n'
COMMANDS = [str(k) for k in range(8)]


def cdr(text: str) -> bytes:
    """A ``std_msgs/msg/String`` by hand: little endian, the length with the 0 at the end, the text."""
    return b"\0\1\0\0" + (len(text) + 1).to_bytes(4, "little") + text.encode() + b"\0"


def heard_kinds() -> dict[str, Any]:
    """Types of the topics that the node hears, as its version of ROS has them."""
    from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
    from std_msgs.msg import String

    return {"speech": String, "goal_pose": PoseStamped, "initialpose": PoseWithCovarianceStamped, "cmd_vel": Twist}


def node_1(folder: str, hear: dict[str, Any]) -> list[Any]:
    """A node of ROS 1 with its master: its publishers of texts and of poses."""
    from rosmaster.master import Master

    master = Master(0)
    master.start()
    port = master.master_node.server.socket.getsockname()[1]
    os.environ.update(ROS_MASTER_URI=f"http://127.0.0.1:{port}", ROS_IP="127.0.0.1", ROS_LOG_DIR=folder)
    import rospy
    from nav_msgs.msg import Odometry
    from std_msgs.msg import String

    rospy.init_node("node", disable_signals=True, disable_rosout=True)
    for topic, kind in heard_kinds().items():
        rospy.Subscriber(topic, kind, hear[topic])
    return [rospy.Publisher(topic, kind, queue_size=9) for topic, kind in (("chatter", String), ("odom", Odometry))]


def node_2(folder: str, hear: dict[str, Any]) -> list[Any]:
    """The same of ROS 2, in a domain of its own: two may run at a time."""
    os.environ["ROS_DOMAIN_ID"] = str(20 + os.getpid() % 80)
    import rclpy
    from nav_msgs.msg import Odometry
    from std_msgs.msg import String

    rclpy.init(args=[])
    node = rclpy.create_node("node")
    for topic, kind in heard_kinds().items():
        node.create_subscription(kind, topic, hear[topic], 9)
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    return [node.create_publisher(kind, topic, 9) for topic, kind in (("chatter", String), ("odom", Odometry))]


async def story(version: str, folder: Path) -> dict[str, Any]:
    config = folder / "client.toml"
    config.write_text(CONFIG)
    came, location, sent, heard = list[Message](), list[Any](), list[str](), list[str]()
    make = {"1": node_1, "2": node_2}[version]
    places, moves = dict[str, Any](), list[list[float]]()

    def move(twist: Any) -> None:
        now = [twist.linear.x, twist.angular.z]
        moves.extend([now] if moves[-1:] != [now] else [])

    hear = {
        "speech": lambda text: heard.append(text.data),
        "goal_pose": lambda said: places.update(goal=[said.header.frame_id, said.pose.position.x]),
        "initialpose": lambda said: places.update(pose=[said.header.frame_id, said.pose.pose.position.x]),
        "cmd_vel": move,
    }
    texts, poses = make(str(folder), hear)

    async def publish() -> None:
        from nav_msgs.msg import Odometry
        from std_msgs.msg import String

        text, pose = String(), Odometry()
        pose.header.frame_id, pose.pose.pose.position.x, pose.pose.pose.orientation.w = "map", 3.0, 1.0
        while True:
            text.data = f"text {len(sent):06}"  # 12 bytes with the 0: DDS fills up to a multiple of 4
            sent.append(text.data)
            texts.publish(text)
            poses.publish(pose)
            await asyncio.sleep(0.05)

    refusals = list[str]()

    async def command(*what: Any) -> None:
        while True:
            try:
                await wait("the relay's answer", viewer.command(*what))
                return
            except BufgymError as error:
                refusals.append(str(error))
                if "no_receiver" not in str(error):  # which passes: the robot is not there yet
                    return
                await asyncio.sleep(0.05)

    async with relay(settings(no_drop=("/robots/[^/]+/(command|to/.*)",))) as server:
        url = f"ws://127.0.0.1:{server.port}"
        words = ["robot", "--to", url, "--name", "r", "--config", str(config), "--ros", version]
        words += ["--odom", "odom", "--policies", "drop-oldest"]
        words += [word for topic in (*hear, "unheard") for word in ("--receive", topic)]
        robot = await asyncio.create_subprocess_exec(sys.executable, "-m", "bufgym", *words, stdout=sys.stderr)
        viewer = Session(url, "viewer", say=lambda text: print(text, file=sys.stderr))
        viewer.subscribe("^/robots/r/chatter$", came.append)
        viewer.subscribe("^/robots/r/status$", lambda one: location.append(json.loads(bytes(one.payload))["location"]))
        try:
            async with beside(viewer.run(), publish()):
                await until("texts and poses", lambda: len(came) >= 10 and any(location))
                # What is no message, of no type that is here, or not for this robot's ROS, stops nothing.
                await command("/robots/r/to/speech", b"\0\1\0\0\xff\xff\xff\xff", TEXT)
                await command("/robots/r/to/speech", b"", "no_such_msgs/msg/B")
                await command("/robots/r/to/private", cdr("secret"), TEXT)
                await command("/robots/r/to/unheard", cdr("nobody subscribes to this"), TEXT)
                for text in COMMANDS:
                    await command("/robots/r/to/speech", cdr(text), TEXT)
                await until("what was said", lambda: len(heard) >= len(COMMANDS))
                await command("/robots/r/to/goal_pose", message(POSE, 0, 1.5, "map"), POSE)
                await command("/robots/r/to/initialpose", message(ESTIMATE, 0, -2.0, "map"), ESTIMATE)
                await command("/robots/r/to/cmd_vel", b"\0\1\0\0" + bytes(48), "geometry_msgs/msg/Twist")
                await until("goal, pose and stop", lambda: len(places) == 2 and moves)
                async with client(server.port, name="ann") as ann:
                    velocity = json.dumps({"linear": 0.3, "angular": -0.2, "for_ms": 1000}).encode()
                    while len(moves) < 2:
                        await ann.put("/robots/r/drive", velocity, encoding="json")
                        await asyncio.sleep(0.1)
                    await server.close()
                await until("it stands", lambda: len(moves) == 3)
                assert robot.returncode is None
        finally:
            robot.terminate()
            await wait("the robot's end", robot.wait())
    return {
        "exact": all(bytes(message.payload) in {cdr(text) for text in sent} for message in came),
        "kinds": sorted({(message.encoding, message.type) for message in came}),
        "heard": heard,
        "unheard": [why.partition("not published: ")[2] for why in refusals if "/to/unheard: " in why],
        "location": next(filter(None, location)),
        **places,
        "moves": moves,
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(story(sys.argv[1], Path(sys.argv[2])))), flush=True)
    os._exit(0)
