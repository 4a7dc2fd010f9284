"""Whatever comes in, it ends in a result or in one line: files of every kind, command lines.

A failure names the seed and the number of its input. Each night has 10,000 files of each kind and 1,000 command lines.
"""

import bz2
import gzip
import io
import lzma
import os
import random
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from link_files import SAMPLES
from mutations import COUNT, SEED, limited, mutated
from needs import needs
from recording_cases import RECORDINGS, recorded_data

from bufgym import policies
from bufgym.benchmark import leaderboard, report
from bufgym.policies import weights as weight_files
from bufgym.scenario import read_client
from bufgym.traces import FORMATS, Trace, load_motion, read_motion, read_trace, read_workload
from bufgym.traces.datasets.unpack import unpack
from bufgym.utils.errors import BufgymError, TraceError

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(not hasattr(__import__("signal"), "SIGALRM"), reason=needs("system", "alarms"))

Kind = tuple[list[tuple[str, bytes]], Callable[[Path, random.Random], object]]
"""Sound files, by their names, and what reads them."""


def weights(folder: Path) -> Kind:
    from weight_cases import ABOUT, KINDS, made

    files = []
    for kind in KINDS:
        for layers in ((), (1,), (3,)):
            weight_files.save(folder / "sound", made(*layers, kind=kind), ABOUT)
            files.append(("w.safetensors", (folder / "sound").read_bytes()))
    return files, lambda path, uniform: policies.load(path)


def poses(folder: Path) -> Kind:
    tum = "".join(f"{k / 10} {k} 0 0 0 0 0 1\n" for k in range(30))
    euroc = "#timestamp [ns],x\n" + "".join(f"{k * 10**8},{k},0,0,1,0,0,0\n" for k in range(30))
    motion = "t_s,motion\n" + "".join(f"{k / 10},{k / 7}\n" for k in range(30))
    kitti = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(3))
    (folder / "k_times.txt").write_text("0\n0.1\n0.2\n")
    names = "stamp [ms],id,px,py,qx,qy,qz,qw\n" + "".join(f"{k * 100},7,{k},0,0,0,0,1\n" for k in range(30))
    fixes = "".join(f"$GPGGA,1200{k:02},4500.{k:04},N,00700.0,W,1,08,1,100.0,M,0,M,,*47\n" for k in range(30))
    gpsd = '{"class":"TPV","mode":3,"time":"2024-01-31T12:00:01Z","lat":45.0,"lon":-7.0,"alt":1.5}\n'
    texts = {"p.txt": tum, "e.csv": euroc, "m.csv": motion, "k.txt": kitti, "n.csv": names, "g.nmea": fixes}
    texts["g.json"] = gpsd + gpsd.replace("00:01Z", "00:02Z")
    return [(name, text.encode()) for name, text in texts.items()], lambda path, uniform: read_motion(path)


def bags(folder: Path) -> Kind:
    import bag_cases as cases
    from mcap.writer import CompressionType
    from rosbags.rosbag1 import Writer
    from rosbags.rosbag2 import CompressionMode, StoragePlugin

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

    sound = files[0].read_bytes()
    for name, packed in (
        ("h.gz", gzip.compress(sound)),
        ("i.xz", lzma.compress(sound)),
        ("j.bz2", bz2.compress(sound)),
    ):
        files.append(folder / name)
        files[-1].write_bytes(packed)
    files.append(folder / "joined.mcap")
    files[-1].write_bytes(sound + sound)

    def read(path: Path, uniform: random.Random) -> object:
        return read_workload(path.parent if path.parent.name in "fg" else path, odom="/odom", bridge_gaps=True)

    return [(str(file.relative_to(folder)), file.read_bytes()) for file in files], read


def toml(folder: Path) -> Kind:
    links, motion = (Trace.constant(1e6, 1),), (load_motion("drive-0"),)
    file = "client.toml", (HERE.parents[1] / "examples" / "client.toml").read_bytes()
    return [file], lambda path, uniform: read_client(path, traces=links, motion=motion)


def results(folder: Path) -> Kind:
    from report_cases import make

    make(folder / "run")
    rows = "\nlte-v1,afr,1,3,score,0.5,0.4,0.6,0.1,x\nlte-v1,afr,1,3,regret,0,0,0,0.1,x\n"
    names = ("manifest.json", "rows.csv", "timeline.json")
    files = [(f"run/{name}", (folder / "run" / name).read_bytes()) for name in names]

    def read(path: Path, uniform: random.Random) -> object:
        return leaderboard.read(path) if path.name == "board.csv" else report.markdown(path.parent)

    return [*files, ("board.csv", (",".join(leaderboard.COLUMNS) + rows).encode())], read


def archives(folder: Path) -> Kind:
    with zipfile.ZipFile(folder / "a.zip", "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("two/three.txt", random.Random(1).randbytes(500))
    with tarfile.open(folder / "a.tgz", "w:gz") as tar:
        tar.add(folder / "a.zip", "one.zip")

    def read(path: Path, uniform: random.Random) -> object:
        try:
            return unpack(path, folder / "out")
        except BufgymError:
            assert not (folder / "out").exists()  # all or nothing
            raise
        finally:
            shutil.rmtree(folder / "out", ignore_errors=True)

    return [(name, (folder / name).read_bytes()) for name in ("a.zip", "a.tgz")], read


def links(folder: Path) -> Kind:
    """A file of each format, and the beginnings of recorded ones; some packed, and some of these changed after that."""
    files = [("lte.csv", text.encode()) for text in SAMPLES.values()]
    globs = "mahimahi/*.gz belgium_4g/csv/*foot*.csv belgium_4g/raw/*.log belgium_4g/sabre_json/*foot*.json"
    globs += " norway_hsdpa/cooked/*bus* uplink_5g/*.gz uplink_wifi/*.gz uplink_mmwave/*.gz"
    recorded = [sorted(recorded_data().glob(pattern))[:3] for pattern in globs.split()]
    own = [path for path in RECORDINGS.glob("*/*") if path.name != "LICENSE"]
    for paths in (sorted(own), *recorded):
        for path in paths:
            raw = path.read_bytes()
            files.append(("lte.csv", (gzip.decompress(raw) if path.suffix == ".gz" else raw)[:3000]))
    others = [raw for _, raw in files]

    def read(path: Path, uniform: random.Random) -> object:
        if uniform.random() < 0.2:
            raw = gzip.compress(path.read_bytes(), 1)
            path.write_bytes(mutated(uniform, raw, others) if uniform.random() < 0.5 else raw)
        column = uniform.choice([None, None, None, "UL_bitrate"])
        try:
            trace = read_trace(path, uniform.choice([None, uniform.choice(list(FORMATS))]), column=column)
        except TraceError as error:
            assert path.name in str(error)
            raise
        assert trace.total_bytes > 0 and 0 < trace.duration_us <= 10**13
        return trace

    return files, read


@pytest.mark.filterwarnings("ignore::bufgym.utils.errors.TraceWarning")
@pytest.mark.parametrize("kind", [weights, poses, bags, toml, results, archives, links])
def test_broken_files(tmp_path: Path, kind: Callable[[Path], Kind]) -> None:
    files, read = kind(tmp_path)
    others, sound = [data for _, data in files], 0
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-{kind.__name__}-{k}")
        name, data = uniform.choice(files)
        path = tmp_path / name
        path.write_bytes(mutated(uniform, data, others))
        try:
            with limited(), redirect_stdout(io.StringIO()):
                read(path, uniform)
            sound += 1
        except BufgymError as error:
            assert str(error).isprintable() and len(str(error)) < 3000, error
        except BaseException as error:
            kept = Path(tempfile.gettempdir()) / f"fuzz-{kind.__name__}-{SEED}-{k}"
            kept.write_bytes(path.read_bytes())
            raise AssertionError(f"{kind.__name__} {k} of seed {SEED} ({name}, kept as {kept}): {error!r}") from error
        path.write_bytes(data)
    assert sound > COUNT // 20, "mutations are meant to be mild"


def test_command_lines() -> None:
    """In a process of its own: commands change the folder, the terminal and what is imported. Nothing is compiled."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "BUFGYM_KERNELS": "python", "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, str(HERE / "commands.py"), str(max(30, COUNT // 10)), SEED]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
