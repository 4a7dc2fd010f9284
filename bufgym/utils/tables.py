"""The one writer of tables, as text, Markdown and HTML."""

import html
from collections.abc import Sequence
from typing import NamedTuple

from bufgym.utils.errors import printable


class Table(NamedTuple):
    """A table that is written as aligned text, Markdown or HTML. Names in it may be untrusted."""

    head: Sequence[str]
    blocks: Sequence[tuple[str, Sequence[Sequence[str]]]]  # (title or nothing, lines of cells)
    notes: Sequence[str] = ()
    left: int = 1  # so many columns stand to the left, the others to the right

    @property
    def lines(self) -> list[Sequence[str]]:
        return [line for _, block in self.blocks for line in block]

    def plain(self) -> str:
        """Aligned text: an empty line and the title before each block, all blocks in the same columns."""
        lines = aligned([self.head, *self.lines])
        out, at = lines[:1], 1
        for k, (title, block) in enumerate(self.blocks):
            out += [*([""] if k or title else []), *([printable(title)] if title else []), *lines[at : at + len(block)]]
            at += len(block)
        return "\n".join([*out, *self.notes])

    def markdown(self) -> str:
        """One Markdown table of all blocks, without their titles."""
        lines = [[printable(cell).replace("|", "\\|") for cell in line] for line in self.lines]
        rule = "|" + "---|" * self.left + "---:|" * (len(self.head) - self.left)
        out = ["| " + " | ".join(self.head) + " |", rule, *("| " + " | ".join(line) + " |" for line in lines)]
        return "\n".join([*out, *(["", *self.notes] if self.notes else [])])

    def html(self) -> str:
        """One HTML table of all blocks, without their titles."""
        body = [self._row("td", line) for line in self.lines]
        notes = [f"<p>{html.escape(note)}</p>" for note in self.notes if note]
        return "\n".join(["<table>", self._row("th", self.head), *body, "</table>", *notes])

    def latex(self) -> str:
        """A ``tabular`` of all blocks for LaTeX's package booktabs; the notes are comments behind it."""
        lines = [" & ".join(map(_latex, line)) + r" \\" for line in (self.head, *self.lines)]
        sides = "l" * self.left + "r" * (len(self.head) - self.left)
        out = [rf"\begin{{tabular}}{{{sides}}}", r"\toprule", lines[0], r"\midrule", *lines[1:]]
        notes = [f"% {printable(note)}" for note in self.notes if note]
        return "\n".join([*out, r"\bottomrule", r"\end{tabular}", *notes])

    def forms(self) -> dict[str, str]:
        """The table in each form, by name."""
        return {"plain": self.plain(), "markdown": self.markdown(), "html": self.html(), "latex": self.latex()}

    def _row(self, tag: str, line: Sequence[str]) -> str:
        sides = ["left" if k < self.left else "right" for k in range(len(line))]
        cells = zip(sides, map(html.escape, map(printable, line)), strict=True)
        return "<tr>" + "".join(f'<{tag} style="text-align: {side}">{cell}</{tag}>' for side, cell in cells) + "</tr>"


_LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"<": "$<$", ">": "$>$", "\N{MINUS SIGN}": "$-$", "\N{EN DASH}": "--"},
}


def _latex(cell: str) -> str:
    """A cell as LaTeX shows it; a bracket at its beginning would be read as an argument of the line before."""
    text = "".join(_LATEX.get(c, c) for c in printable(cell))
    return f"{{}}{text}" if text.startswith("[") else text


def aligned(lines: Sequence[Sequence[object]], left: int = 1) -> list[str]:
    """Align rows of cells as lines of text: the first ``left`` columns to the left, the others to the right."""
    texts = [list(map(printable, line)) for line in lines]
    sides = [(max(map(len, column)), "<" if k < left else ">") for k, column in enumerate(zip(*texts, strict=True))]
    return [
        "  ".join(f"{cell:{side}{n}}" for cell, (n, side) in zip(line, sides, strict=True)).rstrip() for line in texts
    ]
