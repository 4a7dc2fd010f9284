"""Recordings of the tests: those beside them in ``tests/data``, and public ones that ``bufgym trace fetch`` brings."""

import os
from pathlib import Path

import pytest
from needs import needs

from bufgym.traces.datasets.fetch import cache_folder

DATA = Path(__file__).resolve().parent / "data"
ODD_FILES = DATA / "odd_files"
RECORDINGS = DATA / "recordings"
FOLDERS = {
    "belgium-4g-sabre": "belgium_4g/sabre_json",
    "evo-bags": "rosbags",
    "kitti-00": "kitti",
    "lumos5g": "lumos5g/4G",
    "mahimahi": "mahimahi",
    "mmwave-uplink": "uplink_mmwave",
    "norway-hsdpa": "norway_hsdpa/cooked",
    "perama-wifi": "uplink_wifi",
    "solis-wifi": "solis_wifi",
    "ucc-5g": "ucc_5g",
}
"""Data set -> its folder in the recorded data."""


def recorded_data() -> Path:
    """The folder of recorded data: ``$BUFGYM_SHARED_DATA``, else ``shared/data`` beside the checkout."""
    named = os.environ.get("BUFGYM_SHARED_DATA")
    return Path(named) if named else DATA.parents[2] / "shared" / "data"


def fetched(name: str) -> Path:
    """The folder of a public data set, in the recorded data or as fetched; skips where it is in neither."""
    for folder in (recorded_data() / FOLDERS[name], cache_folder() / name):
        if folder.is_dir():
            return folder
    pytest.skip(needs("data", f"`bufgym trace fetch {name}` brings it"))
