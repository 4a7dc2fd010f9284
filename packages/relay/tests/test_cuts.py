"""Links cut at random moments under a robot of ROS 1, of ROS 2 and a made-up one.

No goal is executed after its deadline, nor one that stood behind a stop; after a stop a key that is held moves nothing.
"""

from pathlib import Path
from typing import Any

import pytest
import ros_program
from loop_cases import beside, compiled
from needs import needs

for library in ("websockets", "re2", "rosbags", "PIL"):
    pytest.importorskip(library, reason=needs("extras", library))

from break_story import Done, story  # noqa: E402
from made_up_robot import MadeUp  # noqa: E402

from bufgym_robot.fleet.robot import Robot  # noqa: E402
from bufgym_robot.wire import backoff  # noqa: E402

pytestmark = compiled
CUTS = [6, pytest.param(100, marks=pytest.mark.nightly)]


class Watched(MadeUp):
    """A made-up robot without a camera that keeps what it executes."""

    def __init__(self, done: Done) -> None:
        super().__init__(0, tuple(stream for stream in MadeUp().streams if stream.topic.name == "odom"))
        self.executed = done

    async def on_command(self, command: Any) -> None:
        if command["command"] == "goal":
            self.executed.goal(command["x"])
        else:
            self.executed.moves(command.get("linear", 0.0))
        await super().on_command(command)


async def goal(operator: Any, x: float) -> None:
    await operator.command("/robots/r/command", {"command": "goal", "id": str(x), "x": x, "y": 0, "yaw": 0})


@pytest.mark.parametrize("cuts", CUTS)
async def test_a_made_up_robot(cuts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.05)
    done = Done()
    async with story(done, goal) as (url, run), beside(Robot(url, "r", Watched(done), policy="drop-oldest").run()):
        assert await run(cuts, cuts) == {"cuts": cuts, "stops": (cuts + 1) // 4}


@pytest.mark.parametrize("cuts", CUTS)
@pytest.mark.parametrize("version", ["1", "2"])
def test_a_robot_of_ros(version: str, cuts: int, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    seen, _ = ros_program.run(request, "ros_cuts_session.py", version, tmp_path, cuts, cuts)
    assert seen == {"cuts": cuts, "stops": (cuts + 1) // 4}
