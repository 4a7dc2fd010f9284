"""``metadata.yaml`` of a rosbag2 folder, in any form that YAML allows."""

from pathlib import Path

import pytest
from link_files import written
from needs import needs
from recording_cases import ODD_FILES
from refusal_cases import refuse

pytest.importorskip("yaml", reason=needs("extras", "yaml"))

from bufgym.traces.formats.bags import read_bag
from bufgym.utils.errors import TraceError

SOURCE = ODD_FILES / "meta_comment"


def folder(path: Path, metadata: str) -> Path:
    """The folder's recording under this metadata."""
    (path / "a_0.db3").write_bytes((SOURCE / "a_0.db3").read_bytes())
    written(path, metadata, "metadata.yaml")
    return path


@pytest.mark.parametrize(
    "metadata",
    [
        (SOURCE / "metadata.yaml").read_text(),
        "rosbag2_bagfile_information: {storage_identifier: sqlite3, relative_file_paths: [a_0.db3]}",
        '{"rosbag2_bagfile_information": {"storage_identifier": "sqlite3", "relative_file_paths": ["a_0.db3"]}}',
        "%YAML 1.1\n---\nrosbag2_bagfile_information:\n  compression_mode: ~\n  storage_identifier: >-\n    sqlite3\n"
        "  relative_file_paths:\n  - 'a_0.db3' # first\n  # none is second\n...\n",
        "name: &file a_0.db3\nrosbag2_bagfile_information:\n  relative_file_paths:\n    - *file\n"
        "  storage_identifier: 'sqlite3'\n",
    ],
    ids=["comments", "brackets", "json", "blocks", "alias"],
)
def test_the_metadata_may_be_any_yaml(tmp_path: Path, metadata: str) -> None:
    assert len(read_bag(folder(tmp_path, metadata)).time_ns) == 60


def test_what_is_no_metadata(tmp_path: Path) -> None:
    for metadata, says in (
        ("rosbag2_bagfile_information:\n  storage_identifier: [sqlite3\n", "yaml, line 3: must be YAML .*did not find"),
        (
            "rosbag2_bagfile_information:\n\tversion: 9\n",
            "yaml, line 2: must be YAML .found character that cannot start any token",
        ),
        ("- a_0.db3\n", "must hold rosbag2_bagfile_information"),
        ("", "must hold rosbag2_bagfile_information"),
        ("rosbag2_bagfile_information: {storage_identifier: sqlite3}", "names no file: must list them"),
        (
            "rosbag2_bagfile_information: {storage_identifier: sqlite3, relative_file_paths: {a: b}}",
            "relative_file_paths must be a list of names",
        ),
        ("? [a]\n: b\n", "must be YAML .found unhashable key"),
    ):
        refuse(says, read_bag, folder(tmp_path, metadata), kind=TraceError)
    # Ten to the power of nine letters, were its aliases written out.
    bomb = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    text = f"{bomb}rosbag2_bagfile_information: {{storage_identifier: sqlite3, relative_file_paths: [a_0.db3]}}\n"
    assert len(read_bag(folder(tmp_path, text)).time_ns) == 60
