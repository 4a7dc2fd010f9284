"""The public data sets that `bufgym trace fetch` knows: where they are, whose they are, what they hold.

A fact that could not be found is None and shown as "not known"; no address and no checksum is a guess. Addresses in
GitHub repositories name a commit, so that what is fetched does not change. `SHA256SUMS`, in the format of the program
`sha256sum`, holds the checksums (path = data set / file): each was computed from a copy of the published file, for the
publishers of none of these data sets state one. A file that is listed here and not there has no known checksum.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SUMS: Final = Path(__file__).with_name("SHA256SUMS")
_GITHUB: Final = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class Remote:
    """A file to fetch: its path in the data set's folder, its address, its SHA-256 in hexadecimal digits."""

    path: str
    address: str
    sha256: str | None = None


@dataclass(frozen=True)
class Dataset:
    """A public data set. `page` is for people, `files` are for the machine; without files, it is fetched by hand."""

    name: str
    title: str
    holds: str
    format: str
    page: str
    licence: str | None
    citation: str
    files: tuple[Remote, ...] = ()


@functools.cache
def _sums() -> dict[str, str]:
    lines = SUMS.read_text(encoding="ascii").splitlines()
    return {path: sha256 for sha256, path in (line.split("  ", 1) for line in lines)}


def _files(name: str, base: str, *unsummed: str) -> tuple[Remote, ...]:
    """The files of `SHA256SUMS` under that name and those without a checksum, all below one address."""
    paths = {path.removeprefix(f"{name}/"): sha256 for path, sha256 in _sums().items() if path.startswith(f"{name}/")}
    summed = [Remote(path, f"{base}/{path}", sha256) for path, sha256 in paths.items()]
    return (*summed, *(Remote(path, f"{base}/{path}") for path in unsummed))


_NYU_METS: Final = {
    "d1ea684df29a4381d34e92e0d8df2d14588bebd0": ("7Train1.csv", "7Train2.csv"),
    "0589237a1efc12217727795c79bb014d3a10f454": ("QTrain.csv",),
    "022ff9774983d3a0583b350420a9ba61e5ff0346": ("Long_Island_Rail_Road.csv",),
    "0ebd8901737bd8fba92ef6d953f9820f3b18ee49": ("bus57.csv",),
    "7a8d20f15e02ed98b9577eb5bc35754e42cd6ebc": ("bus62.csv",),
    "1f5776d3404393734ebd299b8e07f2b40c135bd0": ("bus62_2.csv",),
}
"""Commit -> files; they came into the repository one by one."""

_TUM: Final = "https://cvg.cit.tum.de/rgbd/dataset"
_TUM_SEQUENCES: Final = (
    "freiburg1_desk",
    "freiburg1_desk2",
    "freiburg1_rpy",
    "freiburg1_xyz",
    "freiburg2_desk",
    "freiburg2_pioneer_360",
)


def _tum() -> tuple[Remote, ...]:
    paths = {f"rgbd_dataset_{each}-groundtruth.txt": each.split("_")[0] for each in _TUM_SEQUENCES}
    return tuple(
        Remote(path, f"{_TUM}/{camera}/{path}", _sums().get(f"tum-rgbd/{path}")) for path, camera in paths.items()
    )


def _table() -> tuple[Dataset, ...]:
    evo = f"{_GITHUB}/MichaelGrupp/evo/26d0953d4da0f0cb56f90ba6269a15e72f69d3ad/test/data"
    ghent = (
        'J. van der Hooft et al., "HTTP/2-Based Adaptive Streaming of HEVC Video over 4G/LTE Networks", '
        "IEEE Communications Letters 20(11), 2016"
    )
    kitti = (
        'A. Geiger, P. Lenz, R. Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", '
        "CVPR 2012"
    )
    return (
        Dataset(
            name="belgium-4g",
            title="Belgium 4G/LTE bandwidth logs (Ghent University)",
            holds="40 downlink logs of 1 s: foot, bicycle, bus, tram, train, car",
            format="belgium",
            page="https://users.ugent.be/~jvdrhoof/dataset-4g/",
            licence=None,
            citation=ghent,
            files=_files("belgium-4g", "https://users.ugent.be/~jvdrhoof/dataset-4g/logs", "logs_all.zip"),
        ),
        Dataset(
            name="belgium-4g-sabre",
            title="Belgium 4G/LTE bandwidth logs as converted for Sabre",
            holds="30 of the 40 downlink logs",
            format="sabre JSON",
            page="https://github.com/UMass-LIDS/sabre",
            licence="BSD-2-Clause (the repository)",
            citation=ghent,
            files=_files(
                "belgium-4g-sabre",
                f"{_GITHUB}/UMass-LIDS/sabre/09b03bb0f4f90660a2504a6b2fb48d2f06333706/example/mmsys18/4Glogs",
            ),
        ),
        Dataset(
            name="ucc-5g",
            title="UCC Irish 5G production data set",
            holds="5G, static and driving; only Download/ measures capacity",
            format="UCC CSV (DL_bitrate, UL_bitrate)",
            page="https://github.com/uccmisl/5Gdataset",
            licence="GPL-3.0",
            citation=(
                'D. Raca, D. Leahy, C. J. Sreenan, J. J. Quinlan, "Beyond Throughput, The Next Generation: '
                'a 5G Dataset with Channel and Context Metrics", MMSys 2020'
            ),
            files=_files("ucc-5g", f"{_GITHUB}/uccmisl/5Gdataset/306d92eba81cb4f1195d8b8eba625666a02a10ec"),
        ),
        Dataset(
            name="ucc-4g",
            title="UCC 4G LTE data set",
            holds="LTE with channel and context metrics",
            format="UCC CSV (DL_bitrate, UL_bitrate)",
            page="https://www.ucc.ie/en/misl/research/datasets/ivid_4g_lte_dataset/",
            licence=None,
            citation=(
                'D. Raca, J. J. Quinlan, A. H. Zahran, C. J. Sreenan, "Beyond Throughput: a 4G LTE Dataset with '
                'Channel and Context Metrics", MMSys 2018'
            ),
        ),
        Dataset(
            name="norway-hsdpa",
            title="Norway 3G/HSDPA commute traces, cooked for Pensieve",
            holds="80 downlink traces: bus, car, ferry, metro, train, tram",
            format="mbit",
            page="https://github.com/confiwent/Real-world-bandwidth-traces",
            licence="MIT (the repository)",
            citation=(
                'H. Riiser, P. Vigmostad, C. Griwodz, P. Halvorsen, "Commute Path Bandwidth Traces from 3G '
                'Networks", MMSys 2013'
            ),
            files=_files(
                "norway-hsdpa",
                f"{_GITHUB}/confiwent/Real-world-bandwidth-traces/d28c4fd48d0e358db024cc0217b111c070815fa7/cooked_3gp",
            ),
        ),
        Dataset(
            name="lumos5g",
            title="Lumos5G, Verizon 4G throughput traces of the SIGCOMM 2021 artifact",
            holds="175 downlink traces of 1 s: walking, driving",
            format="mbit",
            page="https://github.com/SIGCOMM21-5G/artifact",
            licence=None,
            citation=(
                'A. Narayanan et al., "A Variegated Look at 5G in the Wild", SIGCOMM 2021; '
                'A. Narayanan et al., "Lumos5G", IMC 2020'
            ),
            files=_files(
                "lumos5g",
                f"{_GITHUB}/SIGCOMM21-5G/artifact/35aaf2857550c7f4c736fe9b01e894253a777e4e/"
                "Video-Streaming/Network-Traces/Lumous5G/4G",
            ),
        ),
        Dataset(
            name="solis-wifi",
            title="Solis WiFi bandwidth traces",
            holds="80 traces of 200 s, indoor and static: cafe, campus, office, restaurant",
            format="mbit",
            page="https://github.com/GreenLv/Solis-WiFi-Trace",
            licence="MIT",
            citation="the repository, https://github.com/GreenLv/Solis-WiFi-Trace",
            files=_files(
                "solis-wifi", f"{_GITHUB}/GreenLv/Solis-WiFi-Trace/1f5ec3b61633cb5679f43ae90327ac48e829001c/traces"
            ),
        ),
        Dataset(
            name="mahimahi",
            title="Mahimahi cellular packet-delivery traces",
            holds="16 traces, downlink and uplink: LTE, UMTS, EV-DO",
            format="mahimahi",
            page="https://github.com/ravinet/mahimahi",
            licence="GPL-3.0-or-later",
            citation=(
                'K. Winstein, A. Sivaraman, H. Balakrishnan, "Stochastic Forecasts Achieve High Throughput and Low '
                'Delay over Cellular Networks", NSDI 2013; R. Netravali et al., "Mahimahi", USENIX ATC 2015'
            ),
            files=_files(
                "mahimahi",
                f"{_GITHUB}/ravinet/mahimahi/ae477d437615b972217498ba52be07db17a15618/traces",
                "TMobile-LTE-driving.up",
                "Verizon-LTE-driving.down",
                "Verizon-LTE-driving.up",
            ),
        ),
        Dataset(
            name="nyu-mets",
            title="NYU Metropolitan Mobile Bandwidth Trace, sample traces",
            holds="7 LTE traces of 1 s: subway, bus, railway",
            format="NYU-METS (value,unit a line)",
            page="https://github.com/NYU-METS/Main",
            licence="ODbL-1.0; contents DbCL-1.0",
            citation=(
                'L. Mei et al., "Realtime Mobile Bandwidth Prediction Using LSTM Neural Network and Bayesian '
                'Fusion", Computer Networks 182, 2020'
            ),
            files=tuple(
                Remote(path, f"{_GITHUB}/NYU-METS/Main/{commit}/Sample_Traces/{path}")
                for commit, paths in _NYU_METS.items()
                for path in paths
            ),
        ),
        Dataset(
            name="tum-rgbd",
            title="TUM RGB-D benchmark, ground-truth trajectories",
            holds="6 trajectories of a hand-held camera and a robot",
            format="TUM trajectory",
            page="https://cvg.cit.tum.de/data/datasets/rgbd-dataset",
            licence="CC BY 4.0",
            citation=(
                'J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers, "A Benchmark for the Evaluation of '
                'RGB-D SLAM Systems", IROS 2012'
            ),
            files=_tum(),
        ),
        Dataset(
            name="euroc",
            title="EuRoC MAV ground truth at the 20 Hz of its camera",
            holds="8 trajectories of a drone",
            format="EuRoC trajectory",
            page="https://github.com/princeton-vl/DPVO",
            licence=None,
            citation='M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016',
            files=_files(
                "euroc",
                f"{_GITHUB}/princeton-vl/DPVO/859bbbfdac6c6185f345003b3c473901fcd13ace/datasets/euroc_groundtruth",
            ),
        ),
        Dataset(
            name="kitti-poses",
            title="KITTI odometry, ground-truth poses",
            holds="poses of the driven sequences; no times, which are in data_odometry_calib.zip",
            format="KITTI poses",
            page="https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
            licence="CC BY-NC-SA 3.0 (non-commercial)",
            citation=kitti,
            files=_files("kitti-poses", "https://s3.eu-central-1.amazonaws.com/avg-kitti", "data_odometry_poses.zip"),
        ),
        Dataset(
            name="kitti-00",
            title="KITTI odometry, sequence 00, poses and times",
            holds="1 trajectory of a car, 4541 poses at 10 Hz, with its times",
            format="KITTI poses",
            page="https://github.com/MichaelGrupp/evo",
            licence="CC BY-NC-SA 3.0 (non-commercial)",
            citation=kitti,
            files=_files("kitti-00", evo),
        ),
        Dataset(
            name="evo-bags",
            title="Small robot recordings from the tests of evo",
            holds="a ROS 2 MCAP with odometry (97 s), a ROS 1 bag and a rosbag2 with transforms (52 s)",
            format="MCAP, ROS 1 bag, rosbag2",
            page="https://github.com/MichaelGrupp/evo",
            licence="GPL-3.0 (the repository)",
            citation='M. Grupp, "evo: Python package for the evaluation of odometry and SLAM", 2017',
            files=_files("evo-bags", evo),
        ),
    )


@functools.cache
def datasets() -> dict[str, Dataset]:
    """Name -> data set, in the order in which they are shown."""
    return {dataset.name: dataset for dataset in _table()}
