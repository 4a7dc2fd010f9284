"""Does an installed bufgym work? An episode, a benchmark, errors. With ``--oldest FILE``: the oldest dependencies.

Needs nothing but bufgym and what it brings.
"""

import contextlib
import io
import re
import sys
import tomllib


def oldest(pyproject: str) -> list[str]:
    """Each dependency of this Python at the lowest version that the file allows."""
    with open(pyproject, "rb") as file:
        dependencies = tomllib.load(file)["project"]["dependencies"]
    lowest = []
    for dependency in dependencies:
        match = re.fullmatch(r"([\w-]+)>=([\d.]+)[^;]*(?:; python_version(<|>=)'3\.(\d+)')?", dependency)
        if match is None:
            raise SystemExit(f"{pyproject}: no lowest version: {dependency}")
        name, version, relation, minor = match.groups()
        if relation is None or (sys.version_info.minor < int(minor)) == (relation == "<"):
            lowest.append(f"{name}=={version}")
    return lowest


def check() -> None:
    """Play an episode and compare two policies."""
    import gymnasium as gym

    import bufgym
    from bufgym.cli import main

    env = gym.make("bufgym/Uplink-v0", capacity=4, duration_s=5.0)
    _, info = env.reset(seed=0)
    ended = False
    while not ended:
        _, _, ended, _, info = env.step(env.action_space.sample(info["action_mask"]))
    assert info["arrived"] == info["delivered"] + info["dropped"] == 150, info
    assert main(["bench", "--policies", "learned,afr,drop-oldest", "--seconds", "5", "--seeds", "1"]) == 0
    assert main(["report", "nowhere"]) == 2
    places = {"live": "robot", "ros2": "robot", "robot": "robot", "relay": "robot relay", "reproduce": "papers"}
    for command, names in places.items():
        with contextlib.redirect_stderr(io.StringIO()) as errors:
            assert main([command]) == 2
        folders = " ".join(f"packages/{name}" for name in names.split())
        where = f"bufgym-{names.split()[-1]}: pip install {folders}, in bufgym's source tree"
        assert errors.getvalue() == f"bufgym: error: {command} comes with the package {where}\n", errors.getvalue()
    try:
        gym.make("bufgym/Mapping-v0")
        raise AssertionError("bufgym/Mapping-v0 was made")
    except bufgym.BufgymError as error:
        assert "comes with the package bufgym-papers: pip install packages/papers" in str(error), error
    print(f"bufgym {bufgym.__version__} on Python {sys.version.split()[0]}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--oldest"]:
        print("\n".join(oldest(sys.argv[2])))
    else:
        check()
