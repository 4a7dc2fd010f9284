"""``python -m bufgym_robot.ros1 --policy afr NODE.py ARGS`` runs a rospy node with its queues under a policy."""

import argparse
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from bufgym.utils.errors import BufgymError
from bufgym_robot import ros1
from bufgym_robot.wire.sockets import BACKOFF_S

RULES = "also mine.safetensors or module:function, whose code is run; 'rospy': rospy's own queue"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node; return the exit code."""
    about = "Run a rospy node as it is, its queues under a policy."
    parser = argparse.ArgumentParser(prog="python -m bufgym_robot.ros1", description=about)
    names = f"for all topics (afr), or for one; may be given several times; {RULES}"
    parser.add_argument("--policy", action="append", default=[], metavar="[/TOPIC=]NAME", help=names)
    parser.add_argument("--odom", metavar="TOPIC", help="poses that x is summed from (default: x counts messages)")
    parser.add_argument("--value", metavar="V", help="as in bench: exponential:0.618")
    parser.add_argument("--log", metavar="FOLDER", help="log every decision there")
    tries = "longest time between two tries of TCP at a dead link, s (1; Linux from 6.15 on)"
    parser.add_argument("--backoff", type=float, default=BACKOFF_S, metavar="S", help=tries)
    parser.add_argument("node", metavar="NODE.py", help="the node")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGS", help="its arguments")
    options = parser.parse_args(arguments)
    from bufgym.model import qoi

    try:
        if not Path(options.node).is_file():
            raise BufgymError(f"{options.node}: no such file")
        topics = dict(map(_choice, options.policy))
        value = None if options.value is None else qoi.parse(options.value)
        chosen = {"topics": topics, "odometry": options.odom, "value": value, "log": options.log}
        ros1.install(topics.pop("", "afr"), **chosen, backoff_s=options.backoff)
    except BufgymError as error:
        print(f"bufgym_robot.ros1: error: {error}", file=sys.stderr)
        return 2
    sys.argv = [options.node, *options.arguments]
    sys.path[0] = str(Path(options.node).resolve().parent)
    runpy.run_path(options.node, run_name="__main__")
    return 0


def _choice(text: str) -> tuple[str, str | None]:
    """Parse a choice: the topic, "" for all, and its policy, None for rospy's own queue."""
    topic, _, name = text.partition("=") if text.startswith("/") else ("", "", text)
    if name == "rospy":
        return topic, None
    from bufgym.benchmark import sources

    return topic, sources.load(name) if sources.is_source(name) else name


if __name__ == "__main__":
    sys.exit(main())
