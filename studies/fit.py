"""The page that compares recordings with generated links, mode by mode, and its pictures.

``python -m studies.fit LINKS.json PAGE.md FILE ...`` or ``... --suite A,B --data DIR``, with what `bufgym trace fit`
fitted to these recordings.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from bufgym.cli.options import Count
from bufgym.cli.trace_fit import recordings_of
from bufgym.traces.fit import Rates, autocorrelation, outage_gaps, outage_lengths
from bufgym.traces.formats.text import write_text
from bufgym.traces.generate.parameters import SHOULDER_S, LinkParameters, read_links
from bufgym.traces.trace import Float64Array
from studies.compare_links import KS_DISTANCE, SETS, HeldOut, Row, compare, generated_sets, held_out
from studies.page import command

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Below this p-value a statistic does not match.
_LEVEL: Final = 0.05
# With so many modes or more, all on one side is more than chance.
_MANY_MODES: Final = 6
_DRAWN_SETS: Final = 40
_LAGS_DRAWN: Final = (1, 2, 3, 4, 5, 7, 10, 14, 20, 30, 45, 60)

_INTRODUCTION: Final = """\
# Generated links against recordings

Made by `{command}`; do not edit.

The generator is `bufgym/traces/generate/markov.py`. Its parameters are in `{file}` beside it, and
`bufgym/traces/fit.py` fits them.

Medians and ranges are over {sets} sets; rows with p < {level} are in bold.
[How to read the tables](../docs/methods.md#how-links-are-fitted-to-recordings). Each mode begins with its parameters:
the shares of the variance of the rates' normal scores that stay for a whole trace (*place*), for a while (*level*), and
for a second (*fast*).
"""


def write_page(
    links: Mapping[str, LinkParameters],
    recordings: Mapping[str, Rates],
    page: Path,
    command: str,
    file: str,
    sets: int = SETS,
    most_held_out: int | None = None,
) -> None:
    """Write the page and, if matplotlib is installed, a picture of each mode into `figures/` beside it.

    Args:
        links: mode -> what was fitted.
        recordings: mode -> what it was fitted to.
        page: the file to write.
        command: what the page names as its origin.
        file: name of the file of the links.
        sets: generated sets for each comparison.
        most_held_out: recordings of a mode that are held out at most, a fit each; by default all.
    """
    compared = {mode: compare(links[mode], rows, sets) for mode, rows in recordings.items()}
    plain = {mode: compare(_without_memory(links[mode]), rows, sets) for mode, rows in recordings.items()}
    unseen = {mode: held_out(mode, rows, sets, most_held_out) for mode, rows in recordings.items()}
    (page.parent / "figures").mkdir(parents=True, exist_ok=True)
    pictures = {mode: _picture(mode, links[mode], rows, page.parent) for mode, rows in recordings.items()}
    introduction = _INTRODUCTION.format(command=command, file=file, sets=sets, level=_LEVEL)
    parts = [introduction, _summary(links, compared, plain, unseen)]
    parts += [_section(mode, links[mode], rows, pictures[mode]) for mode, rows in compared.items()]
    write_text(page, ["\n".join(parts)])


def _summary(
    links: Mapping[str, LinkParameters],
    compared: Mapping[str, Sequence[Row]],
    plain: Mapping[str, Sequence[Row]],
    unseen: Mapping[str, HeldOut],
) -> str:
    lines = [
        "## In one table\n",
        "| mode | recordings | seconds | outages | rows not matched | which | not matched by independent seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for mode, rows in compared.items():
        link, (names, tested), (plain_names, plain_tested) = links[mode], _unmatched(rows), _unmatched(plain[mode])
        outages = 0 if link.outages is None else link.outages.spells
        lines.append(
            f"| {mode} | {link.recordings} | {link.seconds} | {outages} | {len(names)} of {tested} "
            f"| {', '.join(names) or 'none'} | {len(plain_names)} of {plain_tested} |"
        )
    if len(compared) >= _MANY_MODES:
        lines.append("\n" + _leanings(compared))
    lines += [
        "\n## Recordings held out\n",
        "| mode | parts | median distance of a recording | of a generated trace "
        "| recordings beyond 95 % of generated traces |",
        "|---|---|---|---|---|",
    ]
    for mode, h in unseen.items():
        parts = f"{h.parts} halves" if links[mode].recordings == 1 else f"{h.parts}"
        lines.append(f"| {mode} | {parts} | {h.distance:.3f} | {h.usual:.3f} | {h.beyond} |")
    return "\n".join(lines) + "\n"


def _unmatched(rows: Sequence[Row]) -> tuple[list[str], int]:
    """Names of the rows that do not match, and how many rows were tested."""
    tested = [row for row in rows if not math.isnan(row.p)]
    return [row.name.split(",")[0] for row in tested if row.p < _LEVEL], len(tested)


def _leanings(compared: Mapping[str, Sequence[Row]]) -> str:
    """The statistics that lean to one side in every mode: a bias, even if it is within chance in each of them."""
    above: dict[str, list[bool]] = {}
    for row in itertools.chain.from_iterable(compared.values()):
        # Only one side of the distance means anything, and what is equal leans to neither side.
        if not math.isnan(row.p) and row.name != KS_DISTANCE and row.real != row.median:
            above.setdefault(row.name, []).append(row.real > row.median)
    leaning = {name: sides for name, sides in above.items() if len(sides) >= _MANY_MODES and len(set(sides)) == 1}
    sentences = []
    for too_low, side in ((True, "low"), (False, "high")):
        names = [name.split(",")[0] for name, sides in leaning.items() if sides[0] == too_low]
        if names:
            sentences.append(f"In every mode generated links have too {side} a value of: {', '.join(names)}.")
    return f"{' '.join(sentences) or 'No statistic leans to one side in every mode.'}\n"


def _without_memory(link: LinkParameters) -> LinkParameters:
    return replace(link, place_share=0.0, level_share=0.0, fast_memory=0.0, outages=None)


def _section(mode: str, link: LinkParameters, rows: Sequence[Row], picture: str | None) -> str:
    lines = [f"## {mode}\n", f"{_count(link.recordings, 'recording')}, {link.seconds} s. {_words(link)}\n"]
    lines += ["| statistic | recordings | generated | 95 % of sets | p |", "|---|---|---|---|---|"]
    for row in rows:
        mark = "**" if row.p < _LEVEL else ""
        between = f"{_short(row.low)} .. {_short(row.high)}"
        lines.append(
            f"| {mark}{row.name}{mark} | {_short(row.real)} | {_short(row.median)} | {between} "
            f"| {mark}{'-' if math.isnan(row.p) else f'{row.p:.2f}'}{mark} |"
        )
    if picture is not None:
        lines.append(f"\n![{mode}: recordings and generated links]({picture})")
    return "\n".join(lines) + "\n"


def _words(link: LinkParameters) -> str:
    fast = max(0.0, 1 - link.place_share - link.level_share)
    variance = (
        f"Variance of the scores: {link.place_share:.2f} place, {link.level_share:.2f} level, {fast:.2f} fast. "
        f"The level stays for {link.level_stay_s:g} s on average. "
        f"The fast part has a memory of {link.fast_memory:.2f} a second."
    )
    o = link.outages
    if o is None:
        return variance + " There are no outages."
    count = f"There {'is' if o.spells == 1 else 'are'} {_count(o.spells, 'outage')}."
    if o.short_gap_share:
        gaps = (
            f"A share of {o.short_gap_share:.2f} of the outages follows {o.short_gap_s:g} s after the one before on "
            f"average, the others {o.long_gap_s:g} s."
        )
    else:
        gaps = f"An outage follows {o.long_gap_s:g} s after the one before on average."
    lengths = f"An outage lasts longer than k s with chance (1 + k / {o.length_scale_s:g})^-{o.length_tail:g}."
    borrowed = (
        " Lengths and depths come from the outages of all modes, because this mode has too few." if o.borrowed else ""
    )
    shoulder = f"Rates within {SHOULDER_S} s of an outage are {100 * o.shoulder:.0f} % of the others."
    return f"{variance} {count} {gaps} {lengths}{borrowed} {shoulder}"


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _short(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


# --- pictures --------------------------------------------------------------------------------------------------------


def _picture(mode: str, link: LinkParameters, rows: Rates, folder: Path) -> str | None:
    """Draw one mode; the picture's path relative to the page, or None without matplotlib."""
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        return None
    generated = [trace for traces in generated_sets(link, rows, _DRAWN_SETS) for trace in traces]
    name = f"figures/link-{mode}.svg"
    # With a fixed salt and without a date, the same picture has the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "bufgym", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(9, 2.4), layout="constrained")
        axes = figure.subplots(1, 4)
        for label, drawn, colour in (("recordings", rows, "C0"), ("generated", generated, "C1")):
            rates = np.concatenate(drawn)
            shares = np.linspace(0, 1, 101)
            axes[0].plot(np.quantile(rates, shares) / 1e6, shares, colour, label=label)
            axes[1].plot(_LAGS_DRAWN, autocorrelation(drawn, _LAGS_DRAWN)[0], colour, marker=".")
            _survival(axes[2], outage_lengths(drawn), colour)
            _survival(axes[3], outage_gaps(drawn), colour)
        axes[0].legend(frameon=False)
        titles = ("rate (MB/s)", "lag (s)", "outage length (s)", "outage spacing (s)")
        for axis, x, y in zip(axes, titles, ("share below", "autocorrelation", "share at least", ""), strict=True):
            axis.set_xlabel(x)
            axis.set_ylabel(y)
            axis.minorticks_off()
        axes[1].axhline(0, color="0.7", linewidth=0.5)
        figure.savefig(folder / name, metadata={"Date": None})
    return name


def _survival(axis: Axes, values: Float64Array, colour: str) -> None:
    """Share of values that are at least x, both axes logarithmic, at no more than 60 points."""
    if not values.size:
        return
    distinct, counts = np.unique(values, return_counts=True)
    share = counts[::-1].cumsum()[::-1] / values.size
    drawn = np.unique(np.geomspace(1, distinct.size, 60).astype(int)) - 1
    axis.loglog(distinct[drawn], share[drawn], colour)


def main(
    links: Path,
    page: Path,
    /,
    *files: str,
    suite: str | None = None,
    data: str | None = None,
    sets: Count = SETS,
    held_out: Count | None = None,
) -> None:
    """Compare links with the recordings that they were fitted to.

    Args:
        links: The parameters of links (.json).
        page: The page to write (.md).
        files: Recordings that the links were fitted to.
        suite: Or the suites (A,B) whose training links they were fitted to.
        data: The folder of recordings that the suites need.
        sets: Generated sets for each comparison.
        held_out: Most recordings of a mode held out, a fit each.
    """
    rows, words = recordings_of(files, None, suite, data)
    again = f"python -m studies.fit {links.name} {page.name} {words}"
    if held_out is not None:
        again += f" --held-out {held_out}"
    write_page(read_links(links), rows, page, again, links.name, sets, held_out)
    print(f"wrote {page}")


if __name__ == "__main__":
    command(main)
