"""Base of all reproductions: options, three steps, a text and a picture.

A ``Figure`` is a figure, table or theorem of a paper. Its dataclass fields are its options. ``simulate`` returns the
numbers, ``claims`` tests the paper's sentences with them, and ``draw`` makes the picture. The sentences are in
``afr.toml`` and ``robofleet.toml``. Each figure has a section with its sentences and the text around them.
"""

import functools
import math
import sys
import textwrap
from abc import ABC, abstractmethod
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

from bufgym.benchmark.bootstrap import Interval
from bufgym.model import checks
from bufgym.model.checks import above_0
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_toml
from bufgym.utils.libraries import library
from bufgym_papers.figures.rows import FigureRows

COLOURS = {
    "afr": "#0072b2",
    "drop-oldest": "#d55e00",
    "random": "#009e73",
    "oracle": "#555555",
    "oracle-ideal": "#111111",
    "other": "#999999",
    "pink": "#cc79a7",
    "orange": "#e69f00",
    "sky": "#56b4e9",
}
"""Colour of each policy in every figure, from Okabe and Ito's palette for colour-blind readers."""

PAPERS = {"afr": "AFR [wang2022afr]", "robofleet": "Robofleet [sikand2021robofleet]"}
"""Prefix of a figure's name -> its paper with the key in references.bib; a TOML file of that name has the sentences."""

UNDECIDED = "undecided"
VERDICTS = {True: "holds", False: "DIFFERS", None: "not tested here", UNDECIDED: UNDECIDED}
WIDTH = 120  # Width of the printed text in letters


Rule = Callable[[str, Any], Any]
"""Checks an option, given its name and value; raises a BufgymError that names it."""


def whole(least: int = 1, most: int | None = None) -> Rule:
    """Rule for an integer from ``least`` to ``most``; None means no limit."""
    return functools.partial(checks.whole, least=least, most=most)


def at_least_0(name: str, number: Any) -> None:
    if isinstance(number, bool) or not isinstance(number, int | float) or not 0 <= number < math.inf:
        raise BufgymError(f"{name} = {number!r}: must be a number >= 0")


def several(rule: Rule) -> Rule:
    """Rule for a list of at least one number, each checked by ``rule``."""

    def check(name: str, numbers: Any) -> None:
        if isinstance(numbers, str) or not isinstance(numbers, Sequence) or not numbers:
            raise BufgymError(f"{name} = {numbers!r}: need at least one number")
        for number in numbers:
            rule(name, number)

    return check


RULES_BY_KIND: dict[Any, Rule] = {
    int: whole(),
    float: above_0,
    Sequence[int]: several(whole()),
    Sequence[float]: several(above_0),
}
"""Annotation of an option -> its rule."""


@dataclass(frozen=True)
class Figure(ABC):
    """A figure, table or theorem of a paper; the fields of a subclass are its options."""

    RULES: ClassVar[dict[str, Rule]] = {"seed": whole(0)}
    """Option -> its rule, where it is not that of ``RULES_BY_KIND``; a subclass adds its own."""
    SIZE_INCHES = (7.0, 4.5)

    def __post_init__(self) -> None:
        own = ChainMap(*(vars(kind).get("RULES", {}) for kind in type(self).__mro__))
        kinds = get_type_hints(type(self))
        for option in fields(self):
            if rule := own.get(option.name, RULES_BY_KIND.get(kinds[option.name])):
                rule(option.name, getattr(self, option.name))

    @abstractmethod
    def simulate(self) -> FigureRows:
        """The figure's numbers, written as CSV."""

    @abstractmethod
    def claims(self, rows: FigureRows) -> Mapping[str, Any]:
        """Map each claim to True, False or None if it was not tested; also give the numbers that the texts quote."""

    @abstractmethod
    def draw(self, rows: FigureRows, figure: Any) -> None:
        """Draw ``rows`` into an empty matplotlib figure."""

    def tables(self, rows: FigureRows) -> list[str]:
        """Lines of text between the heading and the claims."""
        return []

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        """(width, height) of the picture."""
        return self.SIZE_INCHES


@functools.cache
def statements() -> dict[str, dict[str, Any]]:
    """Map each figure's name to its texts: title, setup, notes, and the paper's sentences under claims.

    ``package`` says where the figure's module is: a checkout has more of them in its folder ``studies``.
    """
    here, texts = Path(__file__).parent, dict[str, dict[str, Any]]()
    for file in (folder / f"{paper}.toml" for paper in PAPERS for folder in (here, here.parents[3] / "studies")):
        if file.exists():
            package = __package__ if file.parent == here else file.parent.name
            texts |= {name: {"package": package, **entries} for name, entries in read_toml(file).items()}
    return texts


def facts_of(figure: Figure, rows: FigureRows) -> dict[str, Any]:
    """Collect what the texts may quote: its module's constants, ``figure``, its options, the results of its claims."""
    constants = {name: value for name, value in vars(sys.modules[type(figure).__module__]).items() if name.isupper()}
    options = {option.name: getattr(figure, option.name) for option in fields(figure)}
    return {**constants, "figure": figure, **options, **figure.claims(rows)}


def within(found: Interval, low: float, high: float) -> bool | str:
    """Whether a number lies from ``low`` to ``high``, which its interval must do; UNDECIDED where a part of it does."""
    if low <= found.low and found.high <= high:
        return True
    return False if found.high < low or found.low > high else UNDECIDED


def of_all(verdicts: Iterable[bool | str | None]) -> bool | str | None:
    """The verdict of a claim about several cases: one that differs makes it differ, one undecided leaves it open."""
    found = list(verdicts)
    return next((verdict for verdict in (False, UNDECIDED, None) if verdict in found), True)


def either(cases: Sequence[bool]) -> bool | str:
    """The verdict of a claim about a parameter that the paper leaves open: UNDECIDED if it depends on it."""
    return all(cases) if len(set(cases)) == 1 else UNDECIDED


def about(number: float) -> tuple[float, float]:
    """What a paper's "about" means on the page of claims: up to a quarter less, up to a quarter more."""
    low, high = sorted((0.75 * number, 1.25 * number))
    return low, high


def report(name: str, figure: Figure, rows: FigureRows) -> list[str]:
    """Lines of text: our numbers beside the paper's, and which of its claims hold."""
    facts, texts = facts_of(figure, rows), statements()[name]
    lines = [*_filled(f"{texts['title']}. {texts.get('setup', '')}", facts), "", *figure.tables(rows), ""]
    for claim, text in texts.get("claims", {}).items():
        finding = f"{VERDICTS[facts.get(claim)]}. " if claim in facts else ""
        lines += [*_filled(f"{source(text)}: {text['says']}", facts), *_filled(f"  {finding}{text['ours']}", facts)]
    if "notes" in texts:
        lines += ["", *_filled(texts["notes"], facts)]
    return lines


def source(text: Mapping[str, Any]) -> str:
    """Name the claim's place in the paper, or say that the claim is ours."""
    return "Our addition" if text.get("own") else str(text["place"])


def _filled(text: str, facts: Mapping[str, Any]) -> list[str]:
    """Fill in the facts and wrap each paragraph; what begins with spaces stays indented."""
    indent = " " * (len(text) - len(text.lstrip(" ")))
    wrapper = textwrap.TextWrapper(WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
    paragraphs = text.format(**facts).split("\n\n")
    return [line for paragraph in paragraphs for line in wrapper.wrap(" ".join(paragraph.split()))]


def save_picture(reproduction: Figure, rows: FigureRows, path: Path) -> Path:
    """Draw and write the PNG; return its path. An error that names the extra where matplotlib is absent."""
    # Avoids pyplot, which opens windows and keeps global state; a figure of its own draws with Agg.
    figures = library("matplotlib.figure", "plot", "drawing")
    picture = figures.Figure(figsize=reproduction.size_inches(rows), layout="constrained")
    reproduction.draw(rows, picture)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(path, dpi=150)
    return path


def finish(axes: Any, title: str = "", **settings: Any) -> None:
    """Title, limits and labels as ``Axes.set`` takes them, and the grid that every panel has."""
    axes.set(**settings)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)


def heat_table(
    axes: Any, numbers: Any, spec: str, lines: Sequence[str], columns: Sequence[str], **limits: float
) -> None:
    """Draw a table of numbers on coloured fields, from white at ``vmin`` to darkest at ``vmax``."""
    axes.imshow(numbers, cmap="OrRd", aspect="auto", **limits)
    for n, line in enumerate(numbers):
        for k, number in enumerate(line):
            axes.text(k, n, format(number, spec), ha="center", va="center", fontsize=9)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(lines)), lines)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def legend_below(figure: Any, columns: int, axes: Any = None) -> None:
    """Put one legend below all panels; it describes all panels, or ``axes`` alone."""
    entries = () if axes is None else axes.get_legend_handles_labels()
    figure.legend(*entries, loc="outside lower center", ncols=columns, frameon=False)
