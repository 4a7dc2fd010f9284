"""One kind of broken files after the other, in a process of its own with little memory: `inputs.py KIND FIRST LAST`.

Ends with code 0 if reading each of them ended in a result or in bufgym's own error; else it prints which did not.
"""

from __future__ import annotations

import io
import json
import random
import signal
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
MOST_BYTES = 2 * 10**9
MOST_S = 10
"""An input."""


def weights(folder: Path) -> tuple[list[tuple[str, bytes]], Callable[[Path], object]]:
    from weight_cases import ABOUT, KINDS, made

    from bufgym import policies
    from bufgym.policies import weights

    files = []
    for kind in KINDS:
        for layers in ((), (1,), (3,)):
            weights.save(folder / "sound", made(*layers, kind=kind), ABOUT)
            files.append(("w.safetensors", (folder / "sound").read_bytes()))
    return files, policies.load


def poses(folder: Path) -> tuple[list[tuple[str, bytes]], Callable[[Path], object]]:
    from bufgym.traces import read_motion

    tum = "".join(f"{k / 10} {k} 0 0 0 0 0 1\n" for k in range(30))
    euroc = "#timestamp [ns],x\n" + "".join(f"{k * 10**8},{k},0,0,1,0,0,0\n" for k in range(30))
    motion = "t_s,motion\n" + "".join(f"{k / 10},{k / 7}\n" for k in range(30))
    kitti = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3))
    (folder / "k_times.txt").write_text("0\n0.1\n0.2\n")
    texts = {"p.txt": tum, "e.csv": euroc, "m.csv": motion, "k.txt": kitti}
    return [(name, text.encode()) for name, text in texts.items()], read_motion


def bags(folder: Path) -> tuple[list[tuple[str, bytes]], Callable[[Path], object]]:
    import bag_cases as cases
    from mcap.writer import CompressionType
    from rosbags.rosbag1 import Writer
    from rosbags.rosbag2 import CompressionMode, StoragePlugin

    from bufgym.traces import read_workload

    drive, drive1 = cases.drive()[:6], cases.drive(cases.ROS1)[:6]
    files = [
        cases.write_mcap(folder / "a.mcap", drive),
        cases.write_mcap(folder / "b.mcap", drive, CompressionType.NONE),
        cases.write_ros1(folder / "c.bag", drive1),
        cases.write_ros1(folder / "d.bag", drive1, Writer.CompressionFormat.BZ2),
        cases.write_rosbag2(folder / "e", drive, StoragePlugin.SQLITE3) / "e.db3",
        cases.write_rosbag2(folder / "f", drive, StoragePlugin.SQLITE3, CompressionMode.MESSAGE) / "metadata.yaml",
        cases.write_rosbag2(folder / "g", drive, StoragePlugin.SQLITE3, CompressionMode.FILE) / "g.db3.zstd",
    ]

    def read(path: Path) -> object:
        inside = path.parent if path.parent.name in "fg" else path
        return read_workload(inside, odom="/odom", bridge_gaps=True)

    return [(str(file.relative_to(folder)), file.read_bytes()) for file in files], read


def toml(folder: Path) -> tuple[list[tuple[str, bytes]], Callable[[Path], object]]:
    from bufgym.scenario import read_client
    from bufgym.traces import Trace, load_motion

    links, motion = (Trace.constant(1e6, 1),), (load_motion("drive-0"),)
    file = "client.toml", (REPO / "examples" / "client.toml").read_bytes()
    return [file], lambda path: read_client(path, traces=links, motion=motion)


def results(folder: Path) -> tuple[list[tuple[str, bytes]], Callable[[Path], object]]:
    from test_report import make

    from bufgym.benchmark import leaderboard, report

    make(folder / "run")
    board = (
        ",".join(leaderboard.COLUMNS) + "\nlte-v1,afr,1,3,score,0.5,0.4,0.6,0.1,x\nlte-v1,afr,1,3,regret,0,0,0,0.1,x\n"
    )
    files = [
        (f"run/{name}", (folder / "run" / name).read_bytes()) for name in ("manifest.json", "rows.csv", "timeline.json")
    ]

    def read(path: Path) -> object:
        return (
            leaderboard.read(path) if path.suffix == ".csv" and path.parent == folder else report.markdown(path.parent)
        )

    return [*files, ("board.csv", board.encode())], read


KINDS = {kind.__name__: kind for kind in (weights, poses, bags, toml, results)}


def bounded() -> None:
    """No more than MOST_BYTES for this process."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))


def late(*_: object) -> None:
    raise TimeoutError(f"more than {MOST_S} s")


def read_all(kind: str, first: int, last: int) -> int:
    """How many were read; exits at the first that ended otherwise than it should."""
    from mutations import SEED, mutated

    from bufgym.errors import BufgymError

    signal.signal(signal.SIGALRM, late)
    sound = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        files, read = KINDS[kind](folder)
        others = [data for _, data in files]
        for k in range(first, last):
            uniform = random.Random(f"{SEED}-{kind}-{k}")
            name, data = uniform.choice(files)
            path = folder / name
            path.write_bytes(mutated(uniform, data, others))
            signal.alarm(MOST_S)
            try:
                with redirect_stdout(io.StringIO()):
                    read(path)
                sound += 1
            except BufgymError as error:
                message = str(error)
                assert message.isprintable() and len(message) < 3000, message
            except BaseException as error:
                kept = Path(tempfile.gettempdir()) / f"fuzz-{kind}-{SEED}-{k}"
                kept.write_bytes(path.read_bytes())
                raise AssertionError(f"{kind} {k} of seed {SEED} ({name}, kept as {kept}): {error!r}") from error
            finally:
                signal.alarm(0)
                path.write_bytes(data)
    assert sound > (last - first) // 20 or last - first < 50, f"{kind}: {sound} sound: mutations are meant to be mild"
    return sound


if __name__ == "__main__":
    sys.path[:0] = [str(REPO), *(str(REPO / "tests" / room) for room in ("fuzz", "traces", "core", "benchmark"))]
    bounded()
    print(json.dumps(read_all(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
