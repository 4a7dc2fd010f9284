"""Table I of the Robofleet paper: bytes of a message as ROS binary, as Robofleet's flatbuffer, as rosbridge's JSON.

The paper names types and bytes, not contents. We build a message of each type that has the paper's bytes as ROS binary,
then encode the same message in the other ways. What is ours alone to choose (beams, topics, content) is stated in the
text; PointCloud2, PoseStamped and Odometry are in the paper's experiments but not in its table.
"""

from __future__ import annotations

import itertools
import json
import textwrap
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.encodings import ENCODINGS, KINDS, Content, content, encode
from bufgym.reproduce.report import COLOURS, Report

PAPER = {
    "LaserScan": (7_260, 7_328, 28_000),
    "NavSatFix": (127, 224, 251),
    "CompressedImage": (75_188, 75_224, 267_650),
}
"""Bytes as ROS binary, Robofleet flatbuffer and rosbridge JSON."""
COLUMN = {"ros1": 0, "robofleet": 1, "robofleet-bare": 1, "json": 2, "json-numbers": 2}
"""Encoding -> the column of ``PAPER`` that it stands beside."""
MAX_FRAME_ID = 64
"""Longest frame_id, in letters, that we take for likely."""


def report(
    beams: int = 1800, points: int = 10_000, point_step: int = 16, topic: str = "/robot/topic", seed: int = 0
) -> Report:
    """Table I for every kind of message in ``encodings``.

    Args:
        beams: of the LaserScan; its frame_id is made as long as the paper's size needs.
        points: of the PointCloud2, which the paper's table leaves out.
        point_step: bytes of one of these points.
        topic: goes into the flatbuffer and the JSON.
        seed: of every message's content.
    """
    messages = fitted(beams, seed)
    for kind in KINDS:
        parameters = {"points": points, "point_step": point_step} if kind == "PointCloud2" else {}
        messages.setdefault(kind, content(kind, seed=seed, **parameters))
    ours = {
        kind: {encoding: len(encode(kind, message, encoding, topic)) for encoding in ENCODINGS}
        for kind, message in messages.items()
    }
    rows = [
        [kind, encoding, ours[kind][encoding], paper or "", f"{ours[kind][encoding] / paper:.4f}" if paper else ""]
        for kind in ours
        for encoding in ENCODINGS
        for paper in [of_paper(kind, encoding)]
    ]
    told = [_chosen(messages, topic), *_flatbuffer_told(messages, ours), *_json_told(messages, ours, topic)]
    text = [
        "Robofleet paper, Table I: bytes of one message, ours encoded here.",
        "",
        *_table(ours),
        *(f"\n{textwrap.fill(paragraph, 110)}" for paragraph in told),
    ]
    header = ["message", "encoding", "bytes", "paper_bytes", "ours_to_paper"]
    return Report("\n".join(text), header, rows, lambda figure: _draw(figure, ours), (9.0, 4.8))


def of_paper(kind: str, encoding: str) -> int | None:
    """The paper's bytes that this is to stand beside; None where it gives none."""
    return PAPER[kind][COLUMN[encoding]] if kind in PAPER and encoding in COLUMN else None


def fitted(beams: int, seed: int = 0) -> dict[str, Content]:
    """A message of each of the paper's types whose ROS binary is as long as the paper's."""

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


# --- the text --------------------------------------------------------------------------------------------------------


def _table(ours: dict[str, dict[str, int]]) -> list[str]:
    lines = [f"{'':24}" + "".join(f"{encoding:>15}" for encoding in ENCODINGS)]
    for kind, bytes_ in ours.items():
        lines.append(f"{kind:16} {'ours':7}" + "".join(f"{bytes_[encoding]:15,}" for encoding in ENCODINGS))
        if kind in PAPER:
            papers = [of_paper(kind, encoding) for encoding in ENCODINGS]
            ratios = [p and f"{bytes_[encoding] / p:.4f}" for p, encoding in zip(papers, ENCODINGS, strict=True)]
            lines.append(f"{'':16} {'paper':7}" + "".join(f"{(p and format(p, ',')) or '-':>15}" for p in papers))
            lines.append(f"{'':16} {'ratio':7}" + "".join(f"{r or '-':>15}" for r in ratios))
    others = ", ".join(kind for kind in ours if kind not in PAPER)
    return [*lines, f"Not in the paper's table: {others}."]


def _chosen(messages: dict[str, Content], topic: str) -> str:
    scan, fix, image = (messages[kind] for kind in PAPER)
    beams, letters = len(scan["ranges"]), len(scan["header"]["frame_id"])
    others = " or ".join(f"{beams + (letters - n) // 4:,} and {n}" for n in range(letters % 4, 17, 4) if n != letters)
    cloud = messages["PointCloud2"]
    return (
        f"Chosen for the paper's bytes as ROS binary: LaserScan of {beams:,} ranges, no intensities and a frame_id of "
        f"{letters} letters ({others} do as well, ranges and intensities together); NavSatFix with a frame_id of "
        f"{len(fix['header']['frame_id'])} letters; CompressedImage of {len(image['data']):,} JPEG bytes. "
        f"Chosen freely: PointCloud2 of {cloud['width']:,} points of {cloud['point_step']} bytes; topic {topic}."
    )


def _flatbuffer_told(messages: dict[str, Content], ours: dict[str, dict[str, int]]) -> list[str]:
    added = [ours[kind]["robofleet"] - ours[kind]["robofleet-bare"] for kind in PAPER]
    over = {kind: ours[kind]["robofleet-bare"] - PAPER[kind][1] for kind in PAPER}
    scan = messages["LaserScan"]
    zero = len(encode("LaserScan", {**scan, "header": {**scan["header"], "seq": 0}}, "robofleet-bare"))
    # Nothing in this table is aligned to more than 4 bytes: these are all the lengths that can differ.
    longer = []
    for a, b, c, seq in itertools.product(*[range(4)] * 3, range(2)):
        image = content("CompressedImage", frame_id="c" * a, format="f" * b, data_bytes=100 + c)
        image["header"]["seq"] = seq
        flat, ros = (len(encode("CompressedImage", image, encoding)) for encoding in ("robofleet-bare", "ros1"))
        longer.append(flat - ros)
    gap = PAPER["CompressedImage"][1] - PAPER["CompressedImage"][0]
    possible = "They can" if min(longer) <= gap <= max(longer) else "So the paper's two numbers cannot"
    return [
        f"Flatbuffer: the released client puts type and topic into every message (robofleet), {min(added)} to "
        f"{max(added)} bytes here. The paper's bytes are nearer to messages without them (robofleet-bare): "
        + ", ".join(f"{kind} {more:+d} bytes" for kind, more in over.items())
        + f". A number that is 0 is not written, and the paper does not give its numbers: the LaserScan with seq = 0 "
        f"has {zero:,} bytes, {zero - PAPER['LaserScan'][1]:+d}.",
        f"The paper's CompressedImage is {gap} bytes longer as a flatbuffer than as ROS binary, ours {min(longer)} to "
        f"{max(longer)}, whatever the lengths of its texts and data. {possible} be of one message in the released "
        "schema.",
    ]


def _json_told(messages: dict[str, Content], ours: dict[str, dict[str, int]], topic: str) -> list[str]:
    def bytes_(kind: str, **changed: Any) -> int:
        return len(encode(kind, messages[kind] | changed, "json-numbers", topic))

    image, (ros, _, paper) = ours["CompressedImage"], PAPER["CompressedImage"]
    nearer = min(("json", "json-numbers"), key=lambda encoding: abs(image[encoding] - paper))
    full = ours["LaserScan"]["json-numbers"]
    null = bytes_("LaserScan", ranges=np.full_like(messages["LaserScan"]["ranges"], np.inf))
    share = (full - PAPER["LaserScan"][2]) / (full - null)
    envelope = len(json.dumps({"op": "publish", "topic": topic, "msg": 0}, separators=(",", ":"))) - 1
    zeros = bytes_("NavSatFix", position_covariance=np.zeros(9))
    return [
        f"JSON: the paper's CompressedImage takes {paper / ros:.2f} times its ROS binary; ours "
        f"{image['json'] / ros:.2f} in base64, as rosbridge_suite sends uint8[] (json), and "
        f"{image['json-numbers'] / ros:.2f} as a list of decimal numbers without spaces (json-numbers). Nearest to "
        f"the paper's is {nearer}, {image[nearer] / paper:.4f} of it.",
        f"LaserScan: a float32 becomes up to 18 characters, as it is written as a double. The paper's "
        f"{PAPER['LaserScan'][2]:,} bytes would be json-numbers with {share:.0%} of the beams meeting nothing, as "
        "infinity becomes null; all of ours meet something. The paper does not say what its scan saw.",
        f"NavSatFix: {ours['NavSatFix']['json-numbers'] - envelope} bytes without op and topic, {zeros - envelope} "
        "with a covariance of zeros as well; the rest is digits of the fix, which the paper does not give.",
    ]


# --- the figure ------------------------------------------------------------------------------------------------------


def _draw(figure: Any, ours: dict[str, dict[str, int]]) -> None:
    shown = {
        "cdr": ("ROS 2 CDR", COLOURS["other"]),
        "robofleet": ("Robofleet, type and topic inside", COLOURS["afr"]),
        "robofleet-bare": ("Robofleet, without them", "#56b4e9"),
        "json": ("JSON, bytes in base64", COLOURS["random"]),
        "json-numbers": ("JSON, bytes as numbers", "#e69f00"),
    }
    axes = figure.add_subplot()
    width = 0.8 / len(shown)
    for i, (encoding, (label, colour)) in enumerate(shown.items()):
        at = np.arange(len(ours)) + (i - (len(shown) - 1) / 2) * width
        axes.bar(at, [bytes_[encoding] / bytes_["ros1"] for bytes_ in ours.values()], width, color=colour, label=label)
        for x, kind in zip(at, ours, strict=True):
            if (paper := of_paper(kind, encoding)) is not None:
                name = "paper" if (i, kind) == (1, "LaserScan") else None
                ends = (x - width / 2, x + width / 2)
                axes.hlines(paper / PAPER[kind][0], *ends, color=COLOURS["oracle-ideal"], linewidth=2.2, label=name)
    axes.axhline(1, color=COLOURS["oracle"], linewidth=1, linestyle=":")
    axes.set_xticks(
        np.arange(len(ours)), [f"{kind}\n{bytes_['ros1']:,} B" for kind, bytes_ in ours.items()], fontsize=8
    )
    axes.set(ylabel="bytes / bytes as ROS 1 binary")
    axes.grid(axis="y", alpha=0.25)
    axes.set_axisbelow(True)
    axes.set_title("Size of a message by its encoding; below each, its bytes as ROS 1 binary", loc="left")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
