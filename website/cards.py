"""Cards of the agents that come with bufgym, with numbers read from the pages of their results."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bufgym.benchmark import leaderboard
from website.markdown import table

REPO = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Card:
    """Facts about an agent that its results do not contain."""

    results: str
    """The page of its results."""
    decides: str
    sees: str
    kind: str
    limits: str
    fails: str


CARDS = {
    "learned": Card(
        results="results/agents.md",
        decides="what to drop from one queue, of any L",
        sees="the queue, the clock, the socket, V, sizes, the link's rate, and odometry where there is any",
        kind="a network among ordered candidates and the decision of the rule `gap-price`",
        limits="trained on camera streams of one topic",
        fails="On LTE links, generated links, recorded uplinks and in outages it cannot be told from the rule"
        " `target-gap`; in interruptions, for unequal sizes and on a link that has not varied for three seconds it is"
        " the rule `gap-price`.",
    )
}


def page() -> str:
    """The whole page."""
    lines = [
        "# Agent cards",
        "These agents come with bufgym. Use them as any other policy: `bufgym bench --policies learned,afr`."
        " The [guide](guide/training.md) says how to train your own.",
    ]
    for name, card in CARDS.items():
        facts = [
            ("Decides", card.decides),
            ("Sees", card.sees),
            ("Is", card.kind),
            ("Trained by", f"`{trained_by(card)}`"),
            ("Limits", card.limits),
            ("Where it fails", card.fails),
        ]
        lines += [
            f"## {name}",
            table(("", ""), facts),
            *_board(name),
            f"[All training seeds, cell by cell]({card.results})",
        ]
    return "\n\n".join(lines)


def trained_by(card: Card) -> str:
    """Find the command that made it, on the page of its results."""
    found = re.search(r"`(python train\.py [^`]*)`", _text(card))
    assert found is not None
    return found[1]


def board(name: str) -> list[tuple[str, str, str]]:
    """(suite, share of AFR's regret, score) of the agent as it comes with bufgym, from the leaderboard."""
    entries = leaderboard.read(REPO / "results/leaderboard.csv")
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
        [
            "As it comes, over the discriminative cells ([leaderboard](results/leaderboard.md)):",
            table(("suite", "regret / AFR's", "score"), rows),
        ]
        if rows
        else []
    )


def _text(card: Card) -> str:
    return (REPO / card.results).read_text(encoding="utf-8")
