"""Table I of the Robofleet paper: bytes of a message as ROS binary, Robofleet flatbuffer and rosbridge JSON.

The paper [sikand2021robofleet] names types and bytes, not contents. We build a message of each type that has the
paper's bytes as ROS binary, then encode the same message in the other ways. The text states our own choices of beams,
topics and content. PointCloud2 and PoseStamped are in the paper's experiments but not in its table.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bufgym.utils.errors import BufgymError
from bufgym.utils.tables import aligned
from bufgym_papers.figures.figure import COLOURS, Figure, finish, legend_below, whole
from bufgym_papers.figures.rows import FigureRows
from studies.encodings import ENCODINGS, KINDS, Content, content, encode

PAPER = {
    "LaserScan": (7_260, 7_328, 28_000),
    "NavSatFix": (127, 224, 251),
    "CompressedImage": (75_188, 75_224, 267_650),
}
"""Bytes as ROS binary, Robofleet flatbuffer and rosbridge JSON."""
COLUMN = {"ros1": 0, "robofleet": 1, "robofleet-bare": 1, "json": 2, "json-numbers": 2}
"""Encoding -> the column of ``PAPER`` to compare it with."""
SHOWN = {
    "cdr": ("ROS 2 CDR", COLOURS["other"]),
    "robofleet": ("Robofleet, type and topic inside", COLOURS["afr"]),
    "robofleet-bare": ("Robofleet, without them", COLOURS["sky"]),
    "json": ("JSON, bytes in base64", COLOURS["random"]),
    "json-numbers": ("JSON, bytes as numbers", COLOURS["orange"]),
}
"""Encoding -> label and colour of its bars."""
MAX_FRAME_ID = 64  # Longest frame_id, in letters, that we consider likely


@dataclass(frozen=True)
class Reproduction(Figure):
    """Table I for every kind of message in ``encodings``."""

    beams: int = 1800  # beams of the LaserScan; its frame_id is made as long as the paper's size needs
    points: int = 10_000  # points of the PointCloud2, which the paper's table leaves out

    RULES = {"points": whole(1, 10**6)}
    SIZE_INCHES = (9.0, 4.8)

    @cached_property
    def messages(self) -> dict[str, Content]:
        messages = fitted(self.beams)
        for kind in KINDS:
            parameters: dict[str, Any] = {"points": self.points} if kind == "PointCloud2" else {}
            messages.setdefault(kind, content(kind, **parameters))
        return messages

    def simulate(self) -> FigureRows:
        rows = FigureRows()
        for (kind, message), encoding in itertools.product(self.messages.items(), ENCODINGS):
            bytes_, paper = len(encode(kind, message, encoding)), of_paper(kind, encoding)
            ratio = None if paper is None else f"{bytes_ / paper:.4f}"
            rows.append(
                {"message": kind, "encoding": encoding, "bytes": bytes_, "paper_bytes": paper, "ours_to_paper": ratio}
            )
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        lines = [["", "", *ENCODINGS]]
        for kind in rows.distinct("message"):
            labels = {"ours": "bytes", "paper": "paper_bytes", "ratio": "ours_to_paper"}
            for label, name in labels.items() if kind in PAPER else [("ours", "bytes")]:
                numbers = [row[name] for row in rows.where(message=kind)]
                texts = ["-" if n is None else n if isinstance(n, str) else f"{n:,}" for n in numbers]
                lines.append([kind if label == "ours" else "", label, *texts])
        return aligned(lines, left=2)

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        sizes = sizes_of(rows)
        of = {"flat_bytes": "robofleet", "bare_bytes": "robofleet-bare", "json_bytes": "json-numbers"}
        listed = {name: ", ".join(f"{sizes[kind][encoding]:,}" for kind in PAPER) for name, encoding in of.items()}
        compared = {"flatbuffer": "robofleet", "json": "json-numbers"}
        equal = {
            claim: all(sizes[kind][encoding] == of_paper(kind, encoding) for kind in PAPER)
            for claim, encoding in compared.items()
        }
        scan, fix, image = (self.messages[kind] for kind in PAPER)
        contents = {
            "scan_letters": len(scan["header"]["frame_id"]),
            "fix_letters": len(fix["header"]["frame_id"]),
            "jpeg_bytes": len(image["data"]),
        }
        shorter: dict[str, Any] = {"kinds": ", ".join(sizes)}
        for name, encoding in (("json_ratio", "json-numbers"), ("base64_ratio", "json")):
            ratios = sorted(by[encoding] / by["robofleet"] for by in sizes.values())
            shorter[name] = f"{ratios[0]:.2f} to {ratios[-1]:.2f}"
        shorter["compact"] = all(by["robofleet"] < by["json-numbers"] for by in sizes.values())
        return equal | listed | contents | shorter | {"others": ", ".join(kind for kind in sizes if kind not in PAPER)}

    def draw(self, rows: FigureRows, figure: Any) -> None:
        sizes = sizes_of(rows)
        axes = figure.add_subplot()
        width, ticks = 0.8 / len(SHOWN), np.arange(len(sizes))
        for i, (encoding, (label, colour)) in enumerate(SHOWN.items()):
            at = ticks + (i - (len(SHOWN) - 1) / 2) * width
            axes.bar(at, [s[encoding] / s["ros1"] for s in sizes.values()], width, color=colour, label=label)
            for x, kind in zip(at, sizes, strict=True):
                if (paper := of_paper(kind, encoding)) is not None:
                    name = "paper" if (i, kind) == (1, "LaserScan") else None
                    line = {"color": COLOURS["oracle-ideal"], "linewidth": 2.2, "label": name}
                    axes.hlines(paper / PAPER[kind][0], x - width / 2, x + width / 2, **line)
        axes.axhline(1, color=COLOURS["oracle"], linewidth=1, linestyle=":")
        axes.set_xticks(ticks, [f"{kind}\n{s['ros1']:,} B" for kind, s in sizes.items()], fontsize=8)
        title = "Size of a message by its encoding; below each, its bytes as ROS 1 binary"
        finish(axes, title, ylabel="bytes / bytes as ROS 1 binary")
        axes.grid(False, axis="x")
        legend_below(figure, 3)


def sizes_of(rows: FigureRows) -> dict[str, dict[str, int]]:
    of = rows.where
    return {kind: {row["encoding"]: row["bytes"] for row in of(message=kind)} for kind in rows.distinct("message")}


def of_paper(kind: str, encoding: str) -> int | None:
    """Find the paper's bytes to compare with, or None where it gives none."""
    return PAPER[kind][COLUMN[encoding]] if kind in PAPER and encoding in COLUMN else None


def fitted(beams: int) -> dict[str, Content]:
    """Build a message of each of the paper's types whose ROS binary is as long as the paper's."""

    def lacks(kind: str, **parameters: Any) -> int:
        """Bytes that the paper's message has beyond this one."""
        return PAPER[kind][0] - len(encode(kind, content(kind, **parameters), "ros1"))

    letters = lacks("LaserScan", beams=beams, frame_id="")
    if not 0 <= letters <= MAX_FRAME_ID:
        rule = f"{PAPER['LaserScan'][0]} bytes would need a frame_id of {letters} letters, must be 0 to {MAX_FRAME_ID}"
        raise BufgymError(f"beams = {beams}: {rule}")
    return {
        "LaserScan": content("LaserScan", beams=beams, frame_id="l" * letters),
        "NavSatFix": content("NavSatFix", frame_id="g" * lacks("NavSatFix", frame_id="")),
        "CompressedImage": content("CompressedImage", data_bytes=4 + lacks("CompressedImage", data_bytes=4)),
    }
