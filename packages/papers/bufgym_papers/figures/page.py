"""Writer of results/claims.md, which lists every claim of the papers, the command that tests it, and the result.

``bufgym reproduce --claims results/claims.md --data DIR`` writes it. Figures that need recordings are marked as not
checked without them. ``bufgym reproduce afr-fig7 --claims results/claims.md`` renews the rows of one figure.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bufgym.utils.errors import BufgymError
from bufgym_papers.figures import FIGURES, TAKES_DATA, figure
from bufgym_papers.figures.figure import PAPERS, UNDECIDED, facts_of, source, statements

VERDICTS = {True: "holds", False: "**differs**", None: "not checked", UNDECIDED: UNDECIDED}

HEAD = """\
# The papers' claims

This page lists every sentence of the two papers that we know of and that can be checked. Each row has the command that
tests the sentence, our number, and the verdict. Keys in brackets are from [references.bib](../docs/references.bib).

The sentences are in our words, read at the place that is named: a section, an equation or a figure. "Our addition"
marks sentences that the papers do not have. Where a paper leaves a parameter open, ours is a stated default of the
command's figure.

A claim about a number *holds* where our interval lies within it, *differs* where the interval lies outside, and is
*undecided* where the interval is too wide to say. "About" is up to a quarter
less or more, wherever a paper says it: about 20 % is from 15 to 25 %, about 10 ms from 7.5 to 12.5 ms.

This page is made by

    bufgym reproduce --claims results/claims.md --data DIR

DIR is the folder of recordings. `make test` compares the rows marked † with the output of the code. `make claims`
compares all rows.
"""


def claim_rows(name: str, out: Path | None = None, **options: Any) -> list[str]:
    """Return the Markdown rows of one section of ``afr.toml`` or ``robofleet.toml``; ``out`` as in ``figure``."""
    texts = statements()[name]
    facts: dict[str, Any] = {}
    if name in FIGURES:
        reproduction = figure(name, out, **options)
        facts = facts_of(reproduction, reproduction.simulate())
    command = f"`{name}`{' †' if texts.get('fast') else ''}" if name in FIGURES else ""
    lines = []
    for claim, text in texts.get("claims", {}).items():
        ours = " ".join(text["ours"].format(**facts).split())
        cells = [source(text), text["says"].format(**facts), command, ours, VERDICTS[facts.get(claim)]]
        lines.append("| " + " | ".join([*cells, " ".join(text.get("why", "").format(**facts).split())]) + " |")
    return lines


def _rows(name: str, data: Path | None, out: Path | None) -> list[str]:
    return claim_rows(name, out, **({"data": data} if name in TAKES_DATA else {}))


def claims_page(data: Path | None = None, out: Path | None = None) -> str:
    lines = [HEAD]
    for paper, title in PAPERS.items():
        lines += [f"## {title}", ""]
        lines += ["| place | claim | `bufgym reproduce` | ours | verdict | why |", "|---|---|---|---|---|---|"]
        for name in statements():
            if name.startswith(f"{paper}-"):
                try:
                    lines += _rows(name, data, out)
                except BufgymError as error:
                    lines.append(f"| | {FIGURES[name]} | `{name}` | | not checked | {error} |")
        lines.append("")
    return "\n".join(lines)


def renewed(page: str, names: Iterable[str], data: Path | None = None, out: Path | None = None) -> str:
    """Run only these figures and return the page with their rows renewed."""
    lines = page.splitlines()
    for name in names:
        own = [n for n, line in enumerate(lines) if f"| `{name}` |" in line or f"| `{name}` † |" in line]
        if not own:
            raise BufgymError(
                f"figure {name}: no row of it in the page of claims; without names the page is written whole"
            )
        lines[own[0] : own[-1] + 1] = _rows(name, data, out)
    return "\n".join(lines) + "\n"
