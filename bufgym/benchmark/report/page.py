"""One page from a run and its scores: the template, the style sheet, the script, plotly and the charts' numbers."""

from __future__ import annotations

import json
import math
from importlib.resources import files
from typing import Any

from bufgym.benchmark.folder import Run
from bufgym.benchmark.report import charts, costs, style, tables
from bufgym.benchmark.report.charts import Chart, Context
from bufgym.benchmark.report.timeline import timeline
from bufgym.benchmark.score import DISCRIMINATIVE, CellScore, Scores, Standing
from bufgym.errors import BufgymError


def html(run: Run, scores: Scores) -> str:
    """The whole page, in one file that asks for no other."""
    jinja2, graphs, plotly_js = _libraries()
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"score": style.score, "percent": style.percent}
    context = Context.of(run, scores)
    made = {
        chart.id: chart
        for chart in (
            charts.ranking(context),
            charts.capacities(context),
            charts.outages(context),
            costs.delays(context),
            timeline(context),
            costs.memory(context),
        )
        if chart is not None
    }
    return str(
        environment.from_string(_asset("page.html.jinja")).render(
            manifest=run.manifest,
            scores=scores,
            rows=len(run.rows),
            episodes=len({(row["scenario"], row["trace"], row["seed"]) for row in run.rows}),
            places=tables.ranking(run, scores),
            headings=tables.headings(scores),
            best=_best(scores),
            reference=next((s for s in scores.standings if s.policy == scores.reference), None),
            heat=tables.heat_map(scores),
            shade=_shade,
            threshold=f"{DISCRIMINATIVE:.0%}".replace("%", " %"),
            colour=context.colour,
            charts=made,
            episode=run.timeline,
            css=jinja2.utils.markupsafe.Markup(_asset("page.css")),
            js=jinja2.utils.markupsafe.Markup(_asset("page.js")),
            plotly=jinja2.utils.markupsafe.Markup(plotly_js),
            figures=jinja2.utils.markupsafe.Markup(_figures(made, graphs)),
        )
    )


def _libraries() -> tuple[Any, Any, str]:
    """Jinja, plotly's figures, and plotly's script."""
    try:
        import jinja2
        import plotly.graph_objects as graphs
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise BufgymError('the report needs plotly and Jinja: pip install "bufgym[report]"') from None
    return jinja2, graphs, get_plotlyjs()


def _asset(name: str) -> str:
    return (files("bufgym.benchmark.report") / name).read_text(encoding="utf-8")


def _figures(made: dict[str, Chart], graphs: Any) -> str:
    """All charts as JSON that may stand in a script element; plotly checks every name and value on the way."""
    found = {
        id: {
            "\n".join(options): [graphs.Figure(figure).to_plotly_json() for figure in figures]
            for options, figures in chart.panels.items()
        }
        for id, chart in made.items()
    }
    return json.dumps(found, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _best(scores: Scores) -> Standing | None:
    """The policy in the first place."""
    first = scores.standings[0]
    return first if first.ranked and not math.isnan(first.score.value) else None


def _shade(cell: CellScore) -> str:
    """How strongly a cell of the heat map is coloured, and with what: one CSS declaration."""
    value = cell.score.value
    if math.isnan(value) or not cell.discriminative:
        return ""
    hue = "better" if value >= 0 else "worse"
    return f"--hue: var(--{hue}); --strength: {min(abs(value), 1) * 80:.0f}%"
