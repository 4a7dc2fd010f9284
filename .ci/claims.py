"""Which claims have another verdict now: ``claims.py results/claims.md build/claims.md``.

Times and random draws differ from run to run, so numbers are not compared. A claim that was not checked, as its
recordings are not here, is left out. Exit status 1 if a verdict changed, or a claim is on one page alone.
"""

import sys
from pathlib import Path

NOT_CHECKED = "not checked"


def verdicts(page: str) -> dict[tuple[str, ...], str]:
    """(claim, figure) -> verdict, of the page's tables."""
    lines = [line for line in Path(page).read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {(row[1], row[2]): row[4].strip("*") for row in rows if len(row) >= 5 and row[2].startswith("`")}


def main() -> int:
    """Print what changed; the exit status."""
    before, now = (verdicts(page) for page in sys.argv[1:])
    missing = {figure for (_, figure), verdict in now.items() if verdict == NOT_CHECKED}
    before = {claim: verdict for claim, verdict in before.items() if claim[1] not in missing}
    now = {claim: verdict for claim, verdict in now.items() if claim[1] not in missing}
    changed = sorted(claim for claim in before.keys() | now.keys() if before.get(claim) != now.get(claim))
    for claim in changed:
        print(f"{claim[1]} {claim[0]}: {before.get(claim, 'no claim')} -> {now.get(claim, 'no claim')}")
    print(f"{len(now)} claims checked, {len(changed)} changed, {len(missing)} figures without their recordings")
    return bool(changed)


if __name__ == "__main__":
    raise SystemExit(main())
