"""How often does each rule on implausible recordings speak in real ones: `python -m studies.plausible DIR`.

DIR holds recordings of links, trajectories and robots in any folders (`bufgym trace fetch` brings them). What is no
recording, or is refused, is counted; odd files made on purpose (`odd_files`) are left out.
"""

import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from bufgym.traces import Motion, Trace, Workload, read_bag, read_motion, read_trace, read_workload
from bufgym.traces.formats.splits import is_recording
from bufgym.utils.errors import BufgymError

RULES = {
    "hole of a link": "where .* is usual: (?:the rate is held|nothing is sent)",
    "pause of messages": "no message for",
    "unit of a link": "are they in",
    "noise": "x of every .* pose",
    "stamps": "header stamps on",
    "bytes behind the end": "bytes follow its end|files, joined",
    "jumps": "no robot is faster",
    "samples of one time": "share a time",
    "slow samples": "in another unit",
    "unit of poses": "times are taken as|its header says",
}
"""Rule -> what its warning says."""

Recording = Trace | Motion | Workload


def recordings(folder: Path) -> Iterator[tuple[Path, Recording | BufgymError]]:
    """Every file below the folder as it is read, or why it is not."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "odd_files" not in path.parts and not path.name.endswith(("README.md", "_times.txt.gz")):
            try:
                yield path, read(path)
            except BufgymError as error:
                yield path, error


def read(path: Path) -> Recording:
    """A recording of a robot with all its odometry, a link, or a trajectory."""
    if is_recording(path):
        odometry = [name for name, type in read_bag(path).topics.items() if type == "nav_msgs/msg/Odometry"]
        return read_workload(path, odom=odometry[0] if odometry else None, bridge_gaps=bool(odometry))
    try:
        return read_trace(path)
    except BufgymError:
        return read_motion(path)


def main(folder: Path) -> None:
    """Print for each rule and kind of recording how many recordings it speaks of, and which are the first."""
    warnings.simplefilter("ignore")
    kinds: Counter[str] = Counter()
    spoke: dict[tuple[str, str], list[str]] = {}
    shares: list[float] = []
    for path, recording in recordings(folder):
        kind = "refused" if isinstance(recording, BufgymError) else type(recording).__name__
        kinds[kind] += 1
        if isinstance(recording, BufgymError):
            continue
        shares += [float(value.split()[0]) for name, value in recording.sheet.facts if name == "x of every second"]
        for doubt in recording.sheet.doubts:
            rule = next((rule for rule, says in RULES.items() if re.search(says, doubt)), doubt)
            spoke.setdefault((rule, kind), []).append(path.name)
    print("| rule | of | speaks in | first |\n|---|---|---:|---|")
    for (rule, kind), names in sorted(spoke.items()):
        print(f"| {rule} | {kind} | {len(names)} of {kinds[kind]} | {', '.join(names[:3])} |")
    print(f"\nfiles: {dict(kinds)}")
    if shares:
        print(f"x of every second pose over x: {min(shares):.2f} to {max(shares):.2f} in {len(shares)} trajectories")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
