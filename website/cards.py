"""Cards of the agents that come with bufgym, with numbers read from the pages of their results."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bufgym.benchmark import leaderboard
from website.markdown import table

DOCS = Path(__file__).resolve().parent.parent / "docs"


@dataclass(frozen=True)
class Card:
    """Facts about an agent that its results do not contain."""

    results: str
    """The page of its results."""
    decides: str
    sees: str
    limits: str
    fails: str
    rest: str = ""
    """Rule that decides where the trained network does not."""


CARDS = {
    "learned-motion": Card(
        results="agents.md",
        decides="what to drop from one queue, of any L",
        sees="the queue, the clock, the socket, odometry and V",
        limits="trained on camera streams of one topic, with V exponential or saturating",
        fails="With queues of one to three messages, frames of 20 MB and on a steady link of a tenth of the demand it"
        " may have more regret than AFR, 2.2 times at worst ([stress-v1](stress.md)).",
        rest="Once something was sent the rule `target-gap` decides, where V is straight and then flat `greedy-qoi`.",
    ),
    "learned-time": Card(
        results="agents-time.md",
        decides="what to drop from one queue, of any L",
        sees="the queue, the clock and the socket; x and V only where each message moves the scene equally far",
        limits="trained on the same episodes as learned-motion",
        fails="In blackouts it has nearly twice the regret of `min-motion-gap`, which sees motion; with queues of one"
        " message up to four times that of AFR or Drop Oldest ([stress-v1](stress.md)).",
        rest="As for `learned-motion`, gaps counted in messages.",
    ),
    "learned-scheduler": Card(
        results="topics.md",
        decides="what to drop and what to send next, of many topics",
        sees="each queued message and its topic: priority, age, limits, size, window",
        limits="trained on the topics of Robofleet's example client",
        fails="Where the link is ample it is only level with Robofleet's published client.",
    ),
}


def page() -> str:
    """The whole page."""
    lines = [
        "# Agent cards",
        "These agents come with bufgym. Use them as any other policy: `bufgym bench --policies learned-motion,afr`."
        " The [guide](guide/training.md) says how to train your own.",
    ]
    for name, card in CARDS.items():
        facts = [
            ("Decides", card.decides),
            ("Sees", card.sees),
            (
                "Is",
                "one small network that scores each message, evolved; the best of five seeds on validation",
            ),
            ("Trained by", f"`{trained_by(card)}`"),
            *([("Leaves to others", f"{card.rest} [Who decides where](guide/training.md)")] if card.rest else []),
            ("Limits", card.limits),
            ("Where it fails", card.fails),
        ]
        lines += [
            f"## {name}",
            table(("", ""), facts),
            *_board(name),
            *_scores(card),
            f"[All training seeds, cell by cell]({card.results})",
        ]
    return "\n\n".join(lines)


def trained_by(card: Card) -> str:
    """Find the command that made it, on the page of its results."""
    found = re.search(r"`((?:v0\.2: )?python train\.py [^`]*)`", _text(card))
    assert found is not None
    return found[1]


def scores(card: Card) -> list[tuple[str, str, str, str]]:
    """(suite, regret over AFR's, score of the agents, AFR's score), each with its interval over all training seeds."""
    rows = []
    for part in re.split(r"^## ", _text(card), flags=re.MULTILINE)[1:]:
        regret = re.search(r"^\| all \| ([^|]+) \|", part, re.MULTILINE)
        score = re.search(r"^Scores .*: agents ([\d.]+ \[[^\]]+\]).* afr ([\d.]+ \[[^\]]+\])", part, re.MULTILINE)
        if regret and score:
            rows.append((part.split("\n")[0], regret[1], score[1], score[2]))
    return rows


def board(name: str) -> list[tuple[str, str, str]]:
    """(suite, regret over AFR's, score) of the agent as it comes with bufgym, from the leaderboard."""
    entries = leaderboard.read(DOCS / "leaderboard.csv")
    rows = []
    for entry in entries.values():
        rival = entries.get(f"{entry.suite}/afr")
        if entry.policy == name and rival and "regret" in entry.values:
            regret, afr = (each.values["regret"].value for each in (entry, rival))
            rows.append((entry.suite, f"{regret / afr:.2f}", f"{entry.values['score'].value:.3f}"))
    return rows


def _board(name: str) -> list[str]:
    rows = board(name)
    return (
        ["As it comes ([leaderboard](leaderboard.md)):", table(("suite", "regret / AFR's", "score"), rows)]
        if rows
        else []
    )


def _scores(card: Card) -> list[str]:
    rows = scores(card)
    if not rows:
        return []
    alone = ["The trained network alone, five seeds:"] if card.rest else []
    return [*alone, table(("suite", "regret / AFR's", "score", "AFR's score"), rows)]


def _text(card: Card) -> str:
    return (DOCS / card.results).read_text(encoding="utf-8")
