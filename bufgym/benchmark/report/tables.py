"""Tables of the report: the ranking, and every policy in every cell."""

from collections.abc import Callable, Sequence
from html import escape as escape
from typing import NamedTuple

from bufgym.benchmark.folder import SuiteRun
from bufgym.benchmark.score import CellScore, Scores, Standing
from bufgym.benchmark.summary import Summary, places, table_of, title
from bufgym.benchmark.table import SCORE, UPPER_BOUND, score
from bufgym.utils.tables import Table

NOTHING_SCORED = (
    "Nothing is scored here: on these episodes Drop Oldest's regret is under 1 % in every cell, so there is nothing to"
    " be gained. More --seeds or another --capacity may have some."
)


class HeatMap(NamedTuple):
    """Scores of every policy in every cell."""

    columns: list[tuple[str, list[int]]]  # (scenario, its capacities)
    lines: list[tuple[str, list[CellScore]]]  # (policy, one cell for each column), ranked policies first
    inexact: set[tuple[str, int]]  # cells where the clairvoyant is an upper bound only
    flat: set[tuple[str, int]]  # cells that are not discriminative


def heat_map(scores: Scores) -> HeatMap:
    by_policy: dict[str, list[CellScore]] = {}
    for cell in scores.cells:
        by_policy.setdefault(cell.policy, []).append(cell)
    columns: dict[str, list[int]] = {}
    for cell in next(iter(by_policy.values())):
        columns.setdefault(cell.scenario, []).append(cell.capacity)
    return HeatMap(
        columns=list(columns.items()),
        lines=[(standing.policy, by_policy[standing.policy]) for standing in scores.standings],
        inexact={(cell.scenario, cell.capacity) for cell in scores.cells if not cell.exact},
        flat={(cell.scenario, cell.capacity) for cell in scores.cells if not cell.discriminative},
    )


def plain(run: SuiteRun, summary: Summary) -> str:
    """Write aligned text: the ranking, or a block for each cell if there are no scores, then the notes."""
    notes = run.task.notes(run.rows, summary)
    if summary.scores is None:
        return "\n".join([*intro(run), "", table_of(summary, run.abouts, ["", *notes]).plain()])
    if not any(cell.discriminative for cell in summary.scores.cells):
        notes.append(NOTHING_SCORED)
    bound = [] if summary.scores.exact else [f"{UPPER_BOUND[0].upper()}{UPPER_BOUND[1:]}."]
    lines = [[place.policy, place.place, *place.texts] for place in places(summary)]
    head = ["policy", "rank", *(quantity.title for quantity in summary.quantities)]
    return Table(head, [("", lines)], [f"{SCORE}.", *bound, *notes]).plain()


def html(summary: Summary) -> str:
    return _ranking(summary, summary.overall, str).html()


def latex(summary: Summary) -> str:
    return _ranking(summary, summary.overall, str).latex()


def intro(run: SuiteRun) -> list[str]:
    manifest = run.manifest
    lines = [f"Suite {manifest['suite']}, {manifest['split']}: {manifest['about']}.", manifest["episodes"]]
    if manifest["changes"]:
        changes = " and ".join(f"{name} = {value}" for name, value in manifest["changes"].items())
        lines.append(f"Not the suite as it is: {changes}.")
    return lines


def markdown(run: SuiteRun, summary: Summary) -> str:
    """The command, the ranking, then a table for each scenario or cell."""
    out = ["```", run.manifest["command"], "```", "", _ranking(summary, summary.overall).markdown()]
    if summary.notes:
        out += ["", *(f"* {_plain(note)}" for note in summary.notes)]
    for cell, standings in summary.cells.items():
        out += ["", f"{_plain(title(cell, run.abouts))}:", "", _ranking(summary, standings).markdown()]
    return "\n".join([*out, *(_score_tables(summary.scores) if summary.scores else [])]) + "\n"


def _ranking(summary: Summary, standings: Sequence[Standing], escaped: Callable[[str], str] | None = None) -> Table:
    names = ["#", "policy", *(quantity.title for quantity in summary.quantities)]
    lines = []
    for place in places(summary, standings):
        policy = (escaped or _plain)(place.policy) + (f" ({place.reason})" if place.reason else "")
        lines.append([place.place, policy, *place.texts])
    return Table(names, [("", lines)], left=2)


def _score_tables(scores: Scores) -> list[str]:
    heat = heat_map(scores)
    out = []
    for scenario, sizes in heat.columns:
        head = ["policy", *(f"L = {size}{_marks(heat, scenario, size)}" for size in sizes)]
        lines = [
            [_plain(policy), *(score(cell.score.value) for cell in cells if cell.scenario == scenario)]
            for policy, cells in heat.lines
        ]
        out += ["", f"Score, {_plain(scenario)}:", "", Table(head, [("", lines)]).markdown()]
    if heat.flat:
        out += ["", "\\* Drop Oldest loses under 1 % there: nothing to be gained, not counted in the ranking."]
    if heat.inexact:
        out += ["", "† The clairvoyant is an upper bound there: the true scores lie further from 0, regrets are lower."]
    return out


def _marks(heat: HeatMap, scenario: str, capacity: int) -> str:
    cell = (scenario, capacity)
    return ("\\*" if cell in heat.flat else "") + ("†" if cell in heat.inexact else "")


def _plain(name: str) -> str:
    """Escape a name so that Markdown shows it as written."""
    return escape(name, quote=False).replace("|", "\\|").replace("*", "\\*")
