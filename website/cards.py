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


CARDS = {
    "learned-motion": Card(
        results="agents.md",
        decides="what to drop from one queue, of any L",
        sees="the queue, the clock, the socket, odometry, V and the link's rate",
        limits="trained on camera streams of one topic, with V exponential or saturating",
        fails="Where V saturates, with queues of one to three messages and on a steady link of a tenth of the demand it"
        " may have more regret than AFR, 5.5 times at worst ([stress-v1](stress.md)). On fading and steady links the"
        " rule `target-gap` is better.",
    ),
    "learned-time": Card(
        results="agents-time.md",
        decides="what to drop from one queue, of any L",
        sees="the queue, the clock and the socket",
        limits="trained on the same episodes as learned-motion",
        fails="In blackouts it has nearly twice the regret of `min-motion-gap`, which sees motion. Where V saturates it"
        " has up to ten times that of AFR or Drop Oldest ([stress-v1](stress.md)).",
    ),
    "learned-scheduler": Card(
        results="topics.md",
        decides="what to drop and what to send next, of many topics",
        sees="the link, and each queued message and its topic: priority, gain, age, size, window",
        limits="trained on the topics of Robofleet's example client",
        fails="Where n_T is 1 the first topics are older than under `strict-priority`, which loses messages.",
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
                "one small network that scores each message at every decision, evolved; the best seed on validation",
            ),
            ("Trained by", f"`{trained_by(card)}`"),
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
    found = re.search(r"`(python train\.py [^`]*)`", _text(card))
    assert found is not None
    return found[1]


def scores(card: Card) -> list[tuple[str, str, str, str]]:
    """(suite, regret over AFR's, score of the agents, AFR's score), each with its interval over all training seeds."""
    rows = []
    for part in re.split(r"^## ", _text(card), flags=re.MULTILINE)[1:]:
        regret = re.search(r"^\| all[^|]* \| ([^|]+) \|", part, re.MULTILINE)
        score = re.search(r"^The scores are: agents ([\d.]+ \[[^\]]+\]).* afr ([\d.]+ \[[^\]]+\])", part, re.MULTILINE)
        if regret and score:
            rows.append((part.split("\n")[0], regret[1], score[1], score[2]))
    return rows


def board(name: str) -> list[tuple[str, str, str]]:
    """(suite, share of AFR's regret, score) of the agent as it comes with bufgym, from the leaderboard."""
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
        [
            "As it comes, over the discriminative cells ([leaderboard](leaderboard.md)):",
            table(("suite", "regret / AFR's", "score"), rows),
        ]
        if rows
        else []
    )


def _scores(card: Card) -> list[str]:
    rows = scores(card)
    if not rows:
        return []
    return [
        "All training seeds, over the cells that their page counts:",
        table(("suite", "regret / AFR's", "score", "AFR's score"), rows),
    ]


def _text(card: Card) -> str:
    return (DOCS / card.results).read_text(encoding="utf-8")
