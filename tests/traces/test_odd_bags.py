"""Recordings as recorders, their crashes and their owners leave them: the right numbers, or the file and what it lacks.

The small recordings made here are twelve messages of /t, the k-th of 100 + k letters after k ms: 1,266 letters and 9
bytes of CDR around each.
"""

import asyncio
import shutil
import sqlite3
import tarfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest
from cli_cases import fails, shown
from needs import needs
from refusal_cases import refuse

pytest.importorskip("mcap", reason=needs("extras", "mcap"))
pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))

import bag_cases as cases
import zstandard
from mcap.writer import CompressionType
from recording_cases import ODD_FILES

from bufgym.traces import read_bag, read_motion, read_trace, read_workload
from bufgym.traces.formats.bags import messages
from bufgym.utils.errors import TraceWarning

STRING = "std_msgs/msg/String"
SIZES = [109 + k for k in range(12)]
STORAGES = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
ENDING = {"mcap": "mcap", "sqlite3": "db3"}

Rows = list[tuple[int, bytes]]
"""Milliseconds and serialised message."""


def rows(*numbers: int) -> Rows:
    return [(k, cases.text("x" * (100 + k))) for k in numbers]


def insert(base: sqlite3.Connection, rows: Rows) -> None:
    values = [(cases.START_NS + ms * cases.MS, data) for ms, data in rows]
    base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", values)


def tables(path: Path) -> sqlite3.Connection:
    """A database with rosbag2's tables and the topic /t."""
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    base.execute("INSERT INTO topics VALUES (1, '/t', ?, 'cdr')", (STRING,))
    base.commit()
    return base


def write(path: Path, rows: Rows) -> Path:
    """One file, of the storage that its ending says."""
    if path.suffix == ".mcap":
        return cases.write_mcap(path, [(ms, "/t", STRING, data) for ms, data in rows])
    with tables(path) as base:
        insert(base, rows)
    base.close()
    return path


def describe(folder: Path, storage: str, names: Sequence[str], mode: str = "") -> None:
    form = "zstd" if mode else ""
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: {storage}\n"
        f'  compression_format: "{form}"\n  compression_mode: "{mode}"\n  relative_file_paths:\n'
        + "".join(f"    - {name}\n" for name in names)
    )


def split_bag(folder: Path, storage: str) -> list[Path]:
    """A folder of four files with three messages each, and its metadata."""
    folder.mkdir()
    files = [write(folder / f"d_{k}.{ENDING[storage]}", rows(*range(3 * k, 3 * k + 3))) for k in range(4)]
    describe(folder, storage, [file.name for file in files])
    return files


def pack(file: Path, keep: bool = False) -> Path:
    """Pack a file in zstd, as ``ros2 bag record --compression-mode file`` does when it is full."""
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstandard.compress(file.read_bytes()))
    if not keep:
        file.unlink()
    return packed


def holds_all(path: Path) -> None:
    bag = read_bag(path)
    assert bag.size_bytes.tolist() == SIZES and ((bag.time_ns - cases.START_NS) // cases.MS).tolist() == [*range(12)]


@pytest.mark.parametrize("name", ["good.mcap", "msgzstd_mcap", "msgzstd_mcap/b_0.mcap", "split", "wal_half"])
def test_odd_recordings_have_their_right_numbers(name: str) -> None:
    workload = read_workload(ODD_FILES / name, odom="/odom")
    assert (len(workload), int(workload.size_bytes.sum()), workload.duration_us) == (90, 45_540, 2_950_000)
    assert workload.x is not None and workload.x[-1] == pytest.approx(1.475)


def test_other_odd_recordings() -> None:
    folder = ODD_FILES
    packed = read_workload(folder / "single.mcap.zstd", odom="/odom")
    assert (len(packed), int(packed.size_bytes.sum()), packed.name) == (100, 65_660, "single")
    with pytest.warns(
        TraceWarning, match=r"db3_nometa: has no metadata\.yaml, .* in order of time: db3_nometa_0\.db3$"
    ):
        assert len(read_bag(folder / "db3_nometa").time_ns) == 30
    refuse(r"missing_split/d_1\.mcap: no such file, which metadata", read_bag, folder / "mcap_missing_split")
    says = (
        r"trunc_half\.mcap: cut off .*; its first 52 messages \(1\.700 s\) are sound; `mcap recover trunc_half\.mcap -o"
    )
    refuse(says, read_bag, folder / "trunc_half.mcap")


@STORAGES
def test_twelve_files_are_read_and_played_in_the_order_of_the_metadata(tmp_path: Path, storage: str) -> None:
    """By name _10 and _11 come before _2. The robot's own order is that of every other reader."""
    BagSource = pytest.importorskip("bufgym_robot.fleet.bag", reason=needs("extras", "msgspec")).BagSource

    names = [f"d_{k}.{ENDING[storage]}" for k in range(12)]
    for k, name in enumerate(names):
        write(tmp_path / name, rows(k))
    describe(tmp_path, storage, names)
    holds_all(tmp_path)
    robot = Mock()
    robot.place.topic = ""
    asyncio.run(BagSource(tmp_path, loops=False).run(robot))
    assert [len(call.args[1]) for call in robot.publish.call_args_list] == SIZES


@pytest.mark.filterwarnings("ignore::bufgym.utils.errors.TraceWarning")
def test_messages_come_again_in_the_order_of_the_bag(tmp_path: Path) -> None:
    """Threads of a recorder log late: 2 before 1; and the second file begins before the first ends."""
    names = ["a.mcap", "b.mcap"]
    write(tmp_path / "a.mcap", rows(0, 2, 1, 3, 5, 7))
    write(tmp_path / "b.mcap", rows(4, 6, 8, 9, 11, 10))
    describe(tmp_path, "mcap", names)
    holds_all(tmp_path)
    again = [(logged_ns, len(data)) for _, logged_ns, data in messages(read_bag(tmp_path))]
    assert again == [(cases.START_NS + k * cases.MS, 109 + k) for k in range(12)]


@STORAGES
def test_files_packed_and_plain_in_one_folder(tmp_path: Path, storage: str) -> None:
    """Killed, a recorder leaves the last file plain; its owner has unpacked another, and a third to look into it."""
    files = split_bag(tmp_path / "bag", storage)
    packed = [pack(files[0]), files[1].with_name(f"{files[1].name}.zstd"), pack(files[2], keep=True), files[3]]
    describe(tmp_path / "bag", storage, [file.name for file in packed], "FILE")
    holds_all(tmp_path / "bag")
    assert read_bag(packed[0]).size_bytes.tolist() == SIZES[:3]  # alone
    shutil.copy(files[3], files[3].with_name(f"copy of {files[3].name}"))
    holds_all(tmp_path / "bag")  # the metadata does not name the copy


@STORAGES
def test_packed_messages(tmp_path: Path, storage: str) -> None:
    """The last message was written plain. A packed message is known in a file alone and in a folder."""
    packed = [(ms, data if ms == 11 else zstandard.compress(data)) for ms, data in rows(*range(12))]
    file = write(tmp_path / f"d_0.{ENDING[storage]}", packed)
    describe(tmp_path, storage, [file.name], "MESSAGE")
    holds_all(tmp_path)
    holds_all(file)
    cut = [(ms, data[:-4]) for ms, data in packed]
    file.unlink()
    write(file, cut)
    refuse(r"d_0\.\w+: cut off or damaged: EOFError: zstd data end \d+ bytes early", read_bag, tmp_path)


@STORAGES
def test_what_the_metadata_names_must_be_there(tmp_path: Path, storage: str) -> None:
    """Each fault names the file, not its folder."""
    other = "mcap" if storage == "sqlite3" else "sqlite3"
    faults: dict[str, Callable[[Path], object]] = {
        r"d_2\.\w+: no such file, which metadata\.yaml names": Path.unlink,
        rf"d_2\.\w+: must be a file of {storage}, as metadata\.yaml says": lambda file: file.write_bytes(b""),
        r"d_2\.\w+: must be a regular file": lambda file: (file.unlink(), file.mkdir()),
        r"metadata\.yaml: must hold rosbag2_bagfile_information": lambda file: (
            file.parent / "metadata.yaml"
        ).write_text(""),
        r"d_0\.\w+: must be a file of": lambda file: describe(file.parent, other, [f"d_0.{ENDING[storage]}"]),
        r"metadata\.yaml: names no file": lambda file: describe(file.parent, storage, []),
    }
    for k, (says, spoil) in enumerate(faults.items()):
        spoil(split_bag(tmp_path / f"bag{k}", storage)[2])
        refuse(says, read_bag, tmp_path / f"bag{k}")


@STORAGES
def test_without_metadata_files_come_in_order_of_time(tmp_path: Path, storage: str) -> None:
    files = split_bag(tmp_path / "bag", storage)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    (tmp_path / "bag" / f"._{files[0].name}").write_bytes(b"as macOS leaves it beside a file")
    renamed = [file.rename(file.with_name(f"{name}{file.suffix}")) for file, name in zip(files, "zcab", strict=True)]
    pack(renamed[1], keep=True)
    shutil.copy(renamed[2], renamed[2].with_name(f"d{renamed[2].suffix}"))
    e = ENDING[storage]
    says = rf"order of time: z\.{e}, c\.{e}, a\.{e}, b\.{e}, without copies of them \(d\.{e}\)$"
    with pytest.warns(TraceWarning, match=says):
        holds_all(tmp_path / "bag")
    more = tmp_path / "bag" / "more.mcap"
    more.write_bytes(b"")
    refuse(r"more\.mcap: holds no recording: must be fixed, or left out", read_bag, tmp_path / "bag")
    cases.write_ros1(tmp_path / "one.bag", [(0, "/t", STRING, cases.text("x", cases.ROS1))]).rename(more)
    refuse(r"more\.mcap: must be a recording of the same storage as", read_bag, tmp_path / "bag")
    write(tmp_path / ("one.db3" if storage == "mcap" else "one.mcap"), rows(0)).rename(more)
    refuse(r"\.\w+: must be a recording of the same storage as", read_bag, tmp_path / "bag")


@pytest.mark.parametrize("journal", ["wal", "journal"])
def test_a_sqlite_recorder_that_was_killed(tmp_path: Path, journal: str) -> None:
    """With a write-ahead log its messages 6 to 11 lie there. With a rollback journal 12 to 2,011 were half written."""
    base = tables(tmp_path / "live.db3")
    base.execute(f"PRAGMA journal_mode = {'WAL' if journal == 'wal' else 'DELETE'}")
    base.execute("PRAGMA wal_autocheckpoint = 0")
    base.execute("PRAGMA cache_size = 1")
    insert(base, rows(*range(6)))
    base.commit()
    insert(base, rows(*range(6, 12)))
    base.commit()
    if journal == "journal":
        insert(base, [(k, cases.text("x")) for k in range(12, 2_012)])
    (tmp_path / "bag").mkdir()
    for end in ("", f"-{journal}"):
        shutil.copy(tmp_path / f"live.db3{end}", tmp_path / "bag" / f"d_0.db3{end}")
    base.rollback()
    base.close()
    describe(tmp_path / "bag", "sqlite3", ["d_0.db3"])
    before = {file.name: file.read_bytes() for file in (tmp_path / "bag").iterdir()}
    assert len(before) == 3 and len(before[f"d_0.db3-{journal}"]) > 1_000
    holds_all(tmp_path / "bag")
    holds_all(tmp_path / "bag" / "d_0.db3")
    assert {file.name: file.read_bytes() for file in (tmp_path / "bag").iterdir()} == before


def test_damage_is_named_with_what_is_sound(tmp_path: Path) -> None:
    """A chunk ends beyond 2,048 bytes. 79 of schema and channel, then 140 + k for message k: 14 messages have 2,130."""
    long = cases.write_mcap(
        tmp_path / "l.mcap", [(ms, "/t", STRING, data) for ms, data in rows(*range(24))], CompressionType.NONE
    )
    long.write_bytes(long.read_bytes()[:3_000])
    sound = r"; its first 14 messages \(0\.013 s\) are sound; `mcap recover l\.mcap -o sound\.mcap` saves what is sound"
    refuse(rf"l\.mcap: cut off .*{sound}$", read_bag, long)
    refuse(rf"l\.mcap\.zstd: cut off .*{sound}, once `zstd -d` has unpacked it$", read_bag, pack(long))
    files = split_bag(tmp_path / "bag", "mcap")
    files[2].write_bytes(files[2].read_bytes()[:-40])
    refuse(r"bag/d_2\.mcap: cut off .* first 3 messages \(0\.002 s\)", read_bag, tmp_path / "bag")
    packed = pack(files[1])
    packed.write_bytes(packed.read_bytes()[:-40])
    refuse(r"bag/d_1\.mcap\.zstd: cut off .* zstd data end \d+ bytes early", read_bag, tmp_path / "bag")
    plain = cases.write_mcap(tmp_path / "p.mcap", [(0, "/t", STRING, b"\0\1\0\0abcd")] * 5, CompressionType.NONE)
    plain.write_bytes(plain.read_bytes().replace(b"abcd", b"abcD", 1))
    refuse(r"p\.mcap: cut off or damaged: ValueError: a chunk whose checksum is wrong", read_bag, plain)
    base = write(tmp_path / "b.db3", [(k, bytes(5_000)) for k in range(20)])
    base.write_bytes(base.read_bytes()[:60_000])
    refuse(r"b\.db3: cut off or damaged: DatabaseError: .* `sqlite3 b\.db3 \.recover \| sqlite3", read_bag, base)
    odometry = [(k, "/odom", "nav_msgs/msg/Odometry", cases.odometry(k, 0)[: 900 - 800 * (k == 2)]) for k in range(4)]
    refuse(
        r"o\.mcap: message 3 on /odom is cut off", read_bag, cases.write_mcap(tmp_path / "o.mcap", odometry), "/odom"
    )


def test_what_the_commands_say(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One topic with two types has both in the list; a recording where a link is wanted is told."""
    plain, odometry = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write(plain, rows(0, 1))
    cases.write_mcap(odometry, [(k, "/t", "nav_msgs/msg/Odometry", cases.odometry(k, 0)) for k in (2, 3)])
    describe(tmp_path, "mcap", [plain.name, odometry.name])
    listed = shown(["trace", "from-bag", tmp_path], capsys)
    assert "  yes  std_msgs/msg/String and nav_msgs/msg/Odometry" in listed
    for command in (["info", plain], ["info", tmp_path], ["from-poses", plain]):
        fails(["trace", *command], "is a recording of messages, whose topics `bufgym trace from-bag` lists", capsys)


def test_files_joined_are_read_as_one() -> None:
    """Two drives of 100 messages in one MCAP file, packed as it came; two ROS 1 bags of one drive, in either order."""
    folder = ODD_FILES / "turn7"
    with pytest.warns(TraceWarning, match=r"cat2\.mcap\.gz: holds 2 MCAP files, joined: all are read"):
        assert len(read_bag(folder / "cat2.mcap.gz").time_ns) == 200
    bags = [folder / "ros1_split" / f"d_{k}.bag.gz" for k in (1, 0)]
    assert [len(read_bag(bag).time_ns) for bag in bags] == [100, 100]
    assert len(read_bag(bags, "/odom").time_ns) == 200
    with pytest.warns(TraceWarning, match=r"its files are read in order of time: d_0\.bag\.gz, d_1\.bag\.gz$"):
        bag = read_bag(folder / "ros1_split", "/odom")
    assert (bag.kind, len(bag.time_ns)) == ("ros1", 200)


@pytest.mark.parametrize("suffix", ["mcap", "bag", "db3"])
def test_bytes_behind_the_end_of_a_file_are_said(tmp_path: Path, suffix: str) -> None:
    if suffix == "bag":
        entries = [(k, "/t", STRING, cases.text("x", cases.ROS1)) for k in range(12)]
        path = cases.write_ros1(tmp_path / "a.bag", entries)
    else:
        path = write(tmp_path / f"a.{suffix}", rows(*range(12)))
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.warns(TraceWarning, match=rf"a\.{suffix}: 4 bytes follow its end.*: they are not read"):
        assert len(read_bag(path).time_ns) == 12


def test_gaps_and_overlaps_between_files_are_said(tmp_path: Path) -> None:
    """The second file begins 2 s after the first has ended, and the third 1.5 s before that one ends."""
    write(tmp_path / "a.mcap", rows(0, 1))
    write(tmp_path / "b.mcap", rows(2001, 4001))
    cases.write_mcap(tmp_path / "c.mcap", [(ms, "/other", STRING, cases.text("x")) for ms in (2501, 5001)])
    says = (
        r"a\.mcap: b\.mcap begins 2\.000 s after the end of a\.mcap; c\.mcap begins 1\.500 s before the end of b\.mcap"
    )
    with pytest.warns(TraceWarning, match=says), pytest.warns(TraceWarning, match="1 of 6 messages logged before"):
        bag = read_bag([tmp_path / f"{name}.mcap" for name in "cab"])
    assert ((bag.time_ns - cases.START_NS) // cases.MS).tolist() == [0, 1, 2001, 2501, 4001, 5001]
    assert len(list(messages(bag))) == 6


@pytest.mark.parametrize("module", ["gzip", "bz2", "lzma", "zstandard"])
def test_packed_files_are_read(tmp_path: Path, module: str) -> None:
    """A recording and a text; cut in the middle, the text is refused."""
    compress = pytest.importorskip(module, reason=needs("extras", module)).compress
    packed = tmp_path / "packed"
    packed.write_bytes(compress(write(tmp_path / "a.mcap", rows(*range(12))).read_bytes()))
    holds_all(packed)
    text = b"".join(b"%d 8\n" % k for k in range(100_000))
    packed.write_bytes(compress(text))
    assert read_trace(packed).duration_us == 100_000 * 10**6
    packed.write_bytes(packed.read_bytes()[:-100])
    refuse(r"packed, line \d+: \w+ data damaged or cut off", read_trace, packed)


def test_archives_are_named(tmp_path: Path) -> None:
    plain = tmp_path / "a.csv"
    plain.write_text("time_s,bytes_per_s\n0,1\n1,1\n")
    for name, mode in (("a.tar", "w"), ("a.tgz", "w:gz"), ("a.txz", "w:xz")):
        with tarfile.open(tmp_path / name, mode) as archive:
            archive.add(plain, "a.csv")
        refuse(rf"{name}: is a tar archive: must be unpacked first", read_trace, tmp_path / name)
    for name, inside, says in (
        ("a.xlsx", "[Content_Types].xml", "spreadsheet: must be saved as CSV"),
        ("a.zip", "a.csv", "zip archive: must be unpacked"),
    ):
        with zipfile.ZipFile(tmp_path / name, "w") as packed:
            packed.writestr(inside, "x")
        for read in (read_trace, read_motion, read_workload):
            refuse(rf"{name}: is a {says} first", read, tmp_path / name)
