"""The table of message sizes that bufgym ships, measured by encoding the frames of a recording.

``python -m studies.sizes FOLDER traces/sizes/7scenes.csv`` needs ``packages/papers[perception]`` and PyAV (``pip
install av``). A line of the table is a frame: ``motion``, x since the first frame in millionths of a view, by the true
poses; the bytes of its depth by RVL, of its grey picture by JPEG of quality 50 and 90, and by H.264 (x264, crf 23, no B
frames, no look-ahead, an I frame every 30), each at the size in which the recording is stored.
"""

from __future__ import annotations

import sys
from fractions import Fraction
from typing import Any

import numpy as np

from bufgym.traces.formats.text import write_text
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym_papers.perception import Sequence, open_sequence

GROUP = 30
"""Frames from one I frame to the next."""


def columns(frames: Sequence) -> dict[str, list[int]]:
    """Title -> a whole number for each frame."""
    x = frames.motion().at(frames.time_us)
    table: dict[str, list[int]] = {
        "motion": np.rint(1e6 * x).astype(int).tolist(),
        "rvl": [],
        "jpeg50": [],
        "jpeg90": [],
    }
    cv2, rvl = (library(name, "bufgym-papers[perception]") for name in ("cv2", "rvl"))
    for k in range(len(frames)):
        table["rvl"].append(len(rvl.compress(np.rint(frames.depth(k) * 1000).astype(np.uint16))))
        for quality in (50, 90):
            picture = cv2.imencode(".jpg", frames.grey(k), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            table[f"jpeg{quality}"].append(len(picture))
    table["h264"] = _h264(frames)
    return table


def _h264(frames: Sequence) -> list[int]:
    try:
        import av  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        raise BufgymError("H.264 needs PyAV: pip install av") from None
    height, width = frames.grey(0).shape
    encoder: Any = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate, encoder.time_base = Fraction(30), Fraction(1, 30)
    encoder.options = {
        "preset": "veryfast",
        "tune": "zerolatency",
        "crf": "23",
        "x264-params": f"keyint={GROUP}:min-keyint={GROUP}:scenecut=0",
    }
    sizes = []
    for k in range(len(frames)):
        frame = av.VideoFrame.from_ndarray(frames.grey(k), format="gray").reformat(format="yuv420p")
        frame.pts = k
        sizes += [packet.size for packet in encoder.encode(frame)]
    return sizes + [packet.size for packet in encoder.encode(None)]


def main(folder: str, path: str) -> None:
    """Encode the frames in a folder and write the table."""
    table = columns(open_sequence(folder))
    rows = zip(*table.values(), strict=True)
    write_text(path, [",".join(table) + "\n"], (",".join(map(str, row)) + "\n" for row in rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
