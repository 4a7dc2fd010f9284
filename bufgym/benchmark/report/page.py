"""Page of a run and its summary, made of templates, style sheet and charts."""

import math
from importlib.resources import files

from bufgym.benchmark import table
from bufgym.benchmark.bootstrap import CONFIDENCE, RESAMPLES
from bufgym.benchmark.folder import SuiteRun
from bufgym.benchmark.report import charts, tables, timeline
from bufgym.benchmark.report.charts import Context
from bufgym.benchmark.score import DISCRIMINATIVE, REFERENCE, CellScore
from bufgym.benchmark.summary import Summary, places, title
from bufgym.utils.libraries import library

CHARTS = (charts.ranking, charts.capacities, charts.outages, charts.delays, timeline.timeline)
"""Functions that make the charts; each returns None if the run has nothing to show."""


def html(run: SuiteRun, summary: Summary) -> str:
    """Render the whole page in one self-contained file."""
    jinja2 = library("jinja2", "report", "the report")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_asset),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"score": table.score, "percent": table.percent}
    context = Context.of(run, summary)
    drawn = [chart for chart in (draw(context) for draw in CHARTS) if chart is not None]
    cells = list(dict.fromkeys((row["scenario"], row["capacity"]) for row in run.rows))
    template = "summary" if summary.scores is None else "scores"
    rendered: str = environment.get_template(f"{template}.html.jinja").render(
        charts={chart.id: chart for chart in drawn},
        css=_asset("page.css"),
        manifest=run.manifest,
        summary=summary,
        intro=[run.manifest["about"], *tables.intro(run)[1:]],
        rows=len(run.rows),
        episodes=len({(row["scenario"], row["trace"], row["seed"]) for row in run.rows}),
        scenarios=len({scenario for scenario, _ in cells}),
        sizes=sorted({capacity for _, capacity in cells}),
        confidence=f"{CONFIDENCE:.0%}".replace("%", " %"),
        resamples=RESAMPLES,
        versus=REFERENCE,
        threshold=f"{DISCRIMINATIVE:.0%}".replace("%", " %"),
        places=places(summary),
        cells=[(title(cell, run.abouts), places(summary, found)) for cell, found in summary.cells.items()],
        best=next((s for s in summary.overall[:1] if s.ranked and not math.isnan(s[summary.rank_by].value)), None),
        reference=None if summary.scores is None else summary.standings.get(REFERENCE),
        heat=None if summary.scores is None else tables.heat_map(summary.scores),
        shade=_shade,
        colour=context.colour,
        episode=run.timeline,
    )
    return rendered


def _asset(name: str) -> str:
    return (files("bufgym.benchmark.report") / name).read_text(encoding="utf-8")


def _shade(cell: CellScore) -> str:
    """CSS declaration of a heat map cell's colour and strength."""
    value = cell.score.value
    if math.isnan(value) or not cell.discriminative:
        return ""
    hue = "better" if value >= 0 else "worse"
    return f"--hue: var(--{hue}); --strength: {min(abs(value), 1) * 80:.0f}%"
