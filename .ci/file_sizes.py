"""Lines of Python in the core, in each package and in their tests. Fails for a file that is too long."""

from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
FOLDERS = (
    "bufgym",
    "tests",
    *(f"packages/{name}/{part}" for name in ("robot", "relay", "papers") for part in (f"bufgym_{name}", "tests")),
)
LONGEST = 350
"""Lines of a file."""


def lines(folder: str) -> dict[Path, int]:
    """Lines of each Python file under a folder."""
    files = sorted((REPO / folder).rglob("*.py"))
    return {file.relative_to(REPO): len(file.read_text(encoding="utf-8").splitlines()) for file in files}


def main() -> int:
    """Print the sizes; the exit status."""
    files = {folder: lines(folder) for folder in FOLDERS}
    print(", ".join(f"{folder} {sum(counts.values()):,}" for folder, counts in files.items()))
    long = {path: count for counts in files.values() for path, count in counts.items() if count > LONGEST}
    for path, count in long.items():
        print(f"{path}: {count} lines: a file has at most {LONGEST}; split it")
    return bool(long)


if __name__ == "__main__":
    raise SystemExit(main())
