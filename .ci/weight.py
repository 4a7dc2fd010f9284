"""How heavy the project is: lines of Python in the core, in each package and in their tests; files that are too long.

Fails where one grew beyond its limit. Limits only ever fall: lower them when something was taken out.
"""

from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
LIMITS = {
    "bufgym": 27_525,
    "tests": 18_405,
    "packages/live/bufgym_live": 12_517,
    "packages/live/tests": 10_144,
    "packages/papers/bufgym_papers": 5_185,
    "packages/papers/tests": 1_160,
}
LONGEST = 350
"""Lines of a file."""


def lines(folder: str) -> dict[Path, int]:
    """Lines of each Python file under a folder."""
    files = sorted((REPO / folder).rglob("*.py"))
    return {file.relative_to(REPO): len(file.read_text(encoding="utf-8").splitlines()) for file in files}


def main() -> int:
    """Print the weights; the exit status."""
    files = {folder: lines(folder) for folder in LIMITS}
    weights = {folder: sum(counts.values()) for folder, counts in files.items()}
    long = [f"{path}: {count} lines" for counts in files.values() for path, count in counts.items() if count > LONGEST]
    print(*long, ", ".join(f"{folder} {weight:,}" for folder, weight in weights.items()), sep="\n")
    heavy = [folder for folder, weight in weights.items() if weight > LIMITS[folder]]
    if heavy:
        print(f"over the limit: {', '.join(f'{folder} ({LIMITS[folder]:,})' for folder in heavy)}")
    return bool(heavy or long)


if __name__ == "__main__":
    raise SystemExit(main())
