"""What Fig. 6, 7 and 8 of the AFR paper share: the camera stream, the link, the camera's motion, the policies.

The paper streams 794 RGB-D frames at 30 Hz, about 200 kB of depth and a low-quality JPEG each, over the Belgium 4G log
car_0002, ten times a policy and queue size, and looks at the map (Fig. 7) and at tracking (Fig. 8) that SLAM makes of
the frames received. Here no SLAM runs: what is counted is the Quantity of Information and the longest motion gap.

The ten runs differ by where on the camera's recording they begin, by when within a tenth of its period each frame
comes, and by the luck of Random. Every policy meets the same ten. The link begins at the trace's start in all of them.
Frames are of equal size unless asked otherwise: only then is the clairvoyant exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, traces
from bufgym.benchmark.run import draw, run
from bufgym.errors import BufgymError
from bufgym.reproduce.report import COLOURS
from bufgym.scenario import Uplink
from bufgym.scenario.suites import RATE_HZ, motion_value, time_value
from bufgym.traces import Motion, Trace

PAPER_FRAMES = 794
PAPER_RUNS = 10
PAPER_CEILING = 15e6
"""Where the paper's Fig. 6 has the link's best seconds, bytes/s (about)."""

LINK = "belgium_4g/csv/report_car_0002.csv"
CAMERA = "tum_rgbd/{}.groundtruth.txt.gz"
CAMERAS = ("freiburg1_desk", "freiburg2_desk")
"""A camera in the hand over a desk, brisk (0.8 fields of view a second) and slow (0.27)."""
JITTER = 0.1
"""Frames come late by up to so much of a period."""

STYLES = {
    "afr": ("AFR", COLOURS["afr"], "o"),
    "drop-oldest": ("Drop Oldest", COLOURS["drop-oldest"], "s"),
    "random": ("Random", COLOURS["random"], "^"),
    "orbbuf": ("ORBBuf", "#cc79a7", "D"),
    "min-motion-gap": ("min-motion-gap (not in the paper)", "#e69f00", "v"),
}
"""Policy -> label, colour, marker."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """One panel of a figure: a link and a camera, or a link and time-based QoI."""

    link: str
    """What the link is called."""
    scale: float
    camera: str
    """The recording; "time" where x is the frame index."""
    uplink: Uplink

    @property
    def label(self) -> str:
        return f"{self.camera}, link {self.link}"


def load_link(trace: str | None, data: Path | None) -> Trace:
    """``trace`` (a shipped name or a file), or car_0002 from the folder of recordings."""
    return traces.load(trace) if trace is not None else traces.read_trace(_recording(data, LINK))


def load_camera(name: str, data: Path | None) -> Motion:
    """A TUM RGB-D sequence from the folder of recordings; or a shipped motion or file, where one has that name."""
    if name in traces.shipped() or Path(name).is_file():
        return traces.load_motion(name)
    return replace(traces.read_motion(_recording(data, CAMERA.format(name))), name=name)


def load_cameras(names: str | Sequence[str], data: Path | None) -> list[Motion]:
    """One camera by its name, or several."""
    return [load_camera(name, data) for name in ([names] if isinstance(names, str) else names)]


def _recording(data: Path | None, name: str) -> Path:
    if data is None:
        raise BufgymError(f"the AFR paper's evaluation needs a folder of recordings (--data DIR) with {name}")
    if not (data / name).is_file():
        raise BufgymError(f"{data / name}: no such file; the AFR paper's evaluation needs it")
    return data / name


def streamed(trace: Trace, frames: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(lengths in us, bytes/s) of the trace's samples that begin while the frames come, from the trace's start."""
    if frames < 2:
        raise BufgymError(f"frames = {frames}: must be at least 2")
    lengths_us, rates = trace.samples()
    during = np.cumsum(lengths_us) - lengths_us < frames / RATE_HZ * 1e6
    return lengths_us[during], rates[during]


def share_carried(trace: Trace, frames: int, size_bytes: int, scale: float = 1.0) -> float:
    """Part of the demand that the link can carry while the frames come."""
    lengths_us, rates = streamed(trace, frames)
    return float(np.average(rates, weights=lengths_us)) * scale / (RATE_HZ * size_bytes)


def settings(
    link: Trace,
    cameras: Sequence[Motion],
    *,
    timed: bool,
    frames: int,
    size_bytes: int,
    size_cv: float,
    ceiling_bytes_per_s: float | None,
) -> list[Setting]:
    """Every link with every camera (and with time-based QoI, if ``timed``).

    The links: as recorded, and (unless None) scaled so that the best second of the stream has ``ceiling_bytes_per_s``.
    """
    links = {"as recorded": 1.0}
    if ceiling_bytes_per_s is not None:
        scale = float(ceiling_bytes_per_s / streamed(link, frames)[1].max())
        links[f"x {scale:.2f}"] = scale
    made = []
    for label, scale in links.items():
        uplink = Uplink(
            traces=(link,),
            rate_hz=RATE_HZ,
            jitter=JITTER,
            size_bytes=size_bytes,
            size_cv=size_cv,
            duration_s=frames / RATE_HZ,
            scale=(scale,),
            link_offset_s=(0.0, 0.0),
            value=time_value(),
        )
        made += [Setting(label, scale, c.name, replace(uplink, motion=(c,), value=motion_value())) for c in cameras]
        if timed:
            made.append(Setting(label, scale, "time", uplink))
    return made


def runs_of(setting: Setting, capacities: Sequence[int], runs: int, *, bound: bool) -> list[Row]:
    """The benchmark's rows for ``runs`` runs of every policy, with the H of all frames (``all_frames``) added.

    ``bound``: find the clairvoyant's H and every regret too.
    """
    if runs < 1:
        raise BufgymError(f"runs = {runs}: must be at least 1")
    chosen = [policies.get(name) for name in STYLES]
    rows = run(chosen, setting.uplink, capacities, runs, bound=bound)
    every = {s: setting.uplink.value.information(draw(setting.uplink, s).arrivals["x"]) for s in range(runs)}
    return [row | {"all_frames": every[row["seed"]], "loss": 1 - row["qoi"] / every[row["seed"]]} for row in rows]


def column(rows: Sequence[Row], name: str, policy: str, capacity: int | None = None) -> NDArray[np.float64]:
    """One column of the rows of a policy (at one L), float64[rows]."""
    return np.array([r[name] for r in rows if r["policy"] == policy and capacity in (None, r["capacity"])], np.float64)


def about(link: Trace, frames: int, size_bytes: int, size_cv: float, runs: int) -> list[str]:
    """What meets the policies, in sentences."""
    sizes = "equal in size" if size_cv == 0 else f"sizes with cv {size_cv:g} (regret is an upper bound)"
    return [
        f"{frames} frames of {size_bytes / 1000:g} kB at {RATE_HZ:g} Hz, {sizes}, over {link.name} from its start: it "
        f"carries {share_carried(link, frames, size_bytes):.0%} of the demand.",
        f"{runs} runs each, which differ by their start on the camera's recording, by arrival jitter (up to",
        f"{JITTER:.0%} of a period), and by Random's luck.",
    ]
