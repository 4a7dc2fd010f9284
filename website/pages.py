"""All pages made from the code, by name on the site."""

from __future__ import annotations

from website import cards, commands, environments, papers, policies, suites


def made() -> dict[str, str]:
    """Map each page's name to its Markdown."""
    return {
        **environments.made(),
        "policies.md": policies.page(),
        "cards.md": cards.page(),
        "suites.md": suites.page(),
        "commands.md": commands.page(),
        "papers.md": papers.page(),
    }
