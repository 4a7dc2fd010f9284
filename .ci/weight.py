"""How heavy the project is: lines of Python in the package, its core, its tests; files that are too long.

Fails where one grew beyond its limit. Limits only ever fall: lower them when something was taken out.
"""

from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
WINGS = ("papers", "relay", "robot")
"""Rooms that the core does not import (see ``[tool.importlinter]`` in pyproject.toml)."""
LIMITS = {"package": 42_800, "core": 27_250, "tests": 25_350}
"""The aim is 40,000 and 25,000 lines of package and core."""
LONGEST = 350
"""Lines of a file."""


def lines(folder: str) -> dict[Path, int]:
    """Lines of each Python file under a folder."""
    files = sorted((REPO / folder).rglob("*.py"))
    return {file.relative_to(REPO): len(file.read_text(encoding="utf-8").splitlines()) for file in files}


def main() -> int:
    """Print the weights; the exit status."""
    package, tests = lines("bufgym"), lines("tests")
    core = {path: count for path, count in package.items() if path.parts[1] not in WINGS}
    weights = {"package": sum(package.values()), "core": sum(core.values()), "tests": sum(tests.values())}
    long = [f"{path}: {count} lines" for path, count in {**package, **tests}.items() if count > LONGEST]
    print(*long, ", ".join(f"{name} {weight:,} lines" for name, weight in weights.items()), sep="\n")
    heavy = [name for name, weight in weights.items() if weight > LIMITS[name]]
    if heavy:
        print(f"over the limit: {', '.join(f'{name} ({LIMITS[name]:,})' for name in heavy)}")
    return bool(heavy or long)


if __name__ == "__main__":
    raise SystemExit(main())
