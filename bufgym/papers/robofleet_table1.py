"""Table I of the Robofleet paper: bytes of a message as ROS binary, Robofleet flatbuffer and rosbridge JSON.

The paper [sikand2021robofleet] names types and bytes, not contents. We build a message of each type that has the
paper's bytes as ROS binary, then encode the same message in the other ways. The text states our own choices of beams,
topics and content. PointCloud2, PoseStamped and Odometry are in the paper's experiments but not in its table.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.papers.encodings import ENCODINGS, KINDS, Content, content, encode
from bufgym.papers.figure import COLOURS, Figure, finish, legend_below, whole
from bufgym.papers.rows import Rows, table

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
MAX_FRAME_ID = 64
"""Longest frame_id, in letters, that we consider likely."""


@dataclass(frozen=True)
class Reproduction(Figure):
    """Table I for every kind of message in ``encodings``."""

    beams: int = 1800
    """Beams of the LaserScan; its frame_id is made as long as the paper's size needs."""
    points: int = 10_000
    """Points of the PointCloud2, which the paper's table leaves out."""
    point_step: int = 16
    """Bytes per point."""
    topic: str = "/robot/topic"
    """Topic name written in the flatbuffer and the JSON."""
    seed: int = 0
    """Seed of every message's content."""

    RULES = {"points": whole(1, 10**6), "point_step": whole(16, 256)}
    SIZE_INCHES = (9.0, 4.8)

    @cached_property
    def messages(self) -> dict[str, Content]:
        """Map each kind to the message that is encoded."""
        messages = fitted(self.beams, self.seed)
        for kind in KINDS:
            cloud = {"points": self.points, "point_step": self.point_step}
            parameters: dict[str, Any] = cloud if kind == "PointCloud2" else {}
            messages.setdefault(kind, content(kind, seed=self.seed, **parameters))
        return messages

    def simulate(self) -> Rows:
        rows = Rows()
        for (kind, message), encoding in itertools.product(self.messages.items(), ENCODINGS):
            bytes_, paper = len(encode(kind, message, encoding, self.topic)), of_paper(kind, encoding)
            ratio = None if paper is None else f"{bytes_ / paper:.4f}"
            rows.append(
                {"message": kind, "encoding": encoding, "bytes": bytes_, "paper_bytes": paper, "ours_to_paper": ratio}
            )
        return rows

    def tables(self, rows: Rows) -> list[str]:
        lines = [["", "", *ENCODINGS]]
        for kind in rows.distinct("message"):
            labels = {"ours": "bytes", "paper": "paper_bytes", "ratio": "ours_to_paper"}
            for label, name in labels.items() if kind in PAPER else [("ours", "bytes")]:
                numbers = [row[name] for row in rows.where(message=kind)]
                texts = ["-" if n is None else n if isinstance(n, str) else f"{n:,}" for n in numbers]
                lines.append([kind if label == "ours" else "", label, *texts])
        return table(lines, left=2)

    def claims(self, rows: Rows) -> dict[str, Any]:
        sizes = sizes_of(rows)
        listed = {
            name: ", ".join(f"{sizes[kind][encoding]:,}" for kind in PAPER)
            for name, encoding in (
                ("flat_bytes", "robofleet"),
                ("bare_bytes", "robofleet-bare"),
                ("json_bytes", "json-numbers"),
            )
        }
        equal = {
            claim: all(sizes[kind][encoding] == PAPER[kind][k] for kind in PAPER)
            for k, (claim, encoding) in enumerate(
                (("ros", "ros1"), ("flatbuffer", "robofleet"), ("json", "json-numbers"))
            )
        }
        others = {"others": ", ".join(kind for kind in sizes if kind not in PAPER)}
        return equal | listed | others | self._contents() | self._flatbuffers(sizes) | self._json(sizes)

    def _contents(self) -> dict[str, Any]:
        """Give the choices with which the ROS binaries have the paper's bytes."""
        scan, fix, image = (self.messages[kind] for kind in PAPER)
        beams, letters = len(scan["ranges"]), len(scan["header"]["frame_id"])
        others = (f"{beams + (letters - n) // 4:,} and {n}" for n in range(letters % 4, 17, 4) if n != letters)
        return {
            "scan_letters": letters,
            "other_scans": " or ".join(others),
            "fix_letters": len(fix["header"]["frame_id"]),
            "jpeg_bytes": len(image["data"]),
        }

    def _flatbuffers(self, sizes: dict[str, dict[str, int]]) -> dict[str, Any]:
        """Compare flatbuffer sizes with the paper's, and find how much longer than ROS binary an image can be."""
        added = [sizes[kind]["robofleet"] - sizes[kind]["robofleet-bare"] for kind in PAPER]
        scan = self.messages["LaserScan"]
        zero = len(encode("LaserScan", {**scan, "header": {**scan["header"], "seq": 0}}, "robofleet-bare"))
        # Alignment in this table is at most 4 bytes, so these lengths cover all differences.
        longer = []
        for a, b, c, seq in itertools.product(*[range(4)] * 3, range(2)):
            image = content("CompressedImage", frame_id="c" * a, format="f" * b, data_bytes=100 + c)
            image["header"]["seq"] = seq
            flat, ros = (len(encode("CompressedImage", image, encoding)) for encoding in ("robofleet-bare", "ros1"))
            longer.append(flat - ros)
        gap = PAPER["CompressedImage"][1] - PAPER["CompressedImage"][0]
        return {
            "least_added": min(added),
            "most_added": max(added),
            "over": ", ".join(f"{k} {sizes[k]['robofleet-bare'] - PAPER[k][1]:+d} bytes" for k in PAPER),
            "zero_scan": zero,
            "zero_over": zero - PAPER["LaserScan"][1],
            "image_gap": gap,
            "least_longer": min(longer),
            "most_longer": max(longer),
            "possible": "They can" if min(longer) <= gap <= max(longer) else "So the paper's two numbers cannot",
        }

    def _json(self, sizes: dict[str, dict[str, int]]) -> dict[str, Any]:
        """Compare JSON sizes with the paper's, and find message content that would make them equal."""

        def bytes_(kind: str, **changed: Any) -> int:
            return len(encode(kind, self.messages[kind] | changed, "json-numbers", self.topic))

        image, (ros, _, paper) = sizes["CompressedImage"], PAPER["CompressedImage"]
        nearest = min(("json", "json-numbers"), key=lambda encoding: abs(image[encoding] - paper))
        full = sizes["LaserScan"]["json-numbers"]
        null = bytes_("LaserScan", ranges=np.full_like(self.messages["LaserScan"]["ranges"], np.inf))
        envelope = len(json.dumps({"op": "publish", "topic": self.topic, "msg": 0}, separators=(",", ":"))) - 1
        return {
            "paper_json": paper / ros,
            "base64_json": image["json"] / ros,
            "number_json": image["json-numbers"] / ros,
            "nearest": nearest,
            "nearest_ratio": image[nearest] / paper,
            "paper_scan_json": PAPER["LaserScan"][2],
            "no_return": (full - PAPER["LaserScan"][2]) / (full - null),
            "fix_json": sizes["NavSatFix"]["json-numbers"] - envelope,
            "zero_fix_json": bytes_("NavSatFix", position_covariance=np.zeros(9)) - envelope,
        }

    def draw(self, rows: Rows, figure: Any) -> None:
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


def sizes_of(rows: Rows) -> dict[str, dict[str, int]]:
    """Map kind and encoding to bytes."""
    sizes: dict[str, dict[str, int]] = {}
    for row in rows:
        sizes.setdefault(row["message"], {})[row["encoding"]] = row["bytes"]
    return sizes


def of_paper(kind: str, encoding: str) -> int | None:
    """Find the paper's bytes to compare with, or None where it gives none."""
    return PAPER[kind][COLUMN[encoding]] if kind in PAPER and encoding in COLUMN else None


def fitted(beams: int, seed: int = 0) -> dict[str, Content]:
    """Build a message of each of the paper's types whose ROS binary is as long as the paper's."""

    def bytes_(kind: str, **parameters: Any) -> int:
        return len(encode(kind, content(kind, **parameters), "ros1"))

    letters = PAPER["LaserScan"][0] - bytes_("LaserScan", beams=beams, frame_id="")
    if not 0 <= letters <= MAX_FRAME_ID:
        rule = f"{PAPER['LaserScan'][0]} bytes would need a frame_id of {letters} letters, must be 0 to {MAX_FRAME_ID}"
        raise BufgymError(f"beams = {beams}: {rule}")
    scan = content("LaserScan", beams=beams, frame_id="l" * letters, seed=seed)
    letters = PAPER["NavSatFix"][0] - bytes_("NavSatFix", frame_id="")
    fix = content("NavSatFix", frame_id="g" * letters, seed=seed)
    least = 4
    data_bytes = PAPER["CompressedImage"][0] - bytes_("CompressedImage", data_bytes=least) + least
    image = content("CompressedImage", data_bytes=data_bytes, seed=seed)
    return {"LaserScan": scan, "NavSatFix": fix, "CompressedImage": image}
