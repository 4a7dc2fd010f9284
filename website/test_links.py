"""A page's links lead to pages, wherever its file lies."""

import pytest

from website.links import on_site


@pytest.mark.parametrize(
    ("page", "link", "becomes"),
    [
        ("guide/suites.md", "../../results/stress.md", "../results/stress.md"),
        ("results/stress.md", "../docs/guide/training.md", "../guide/training.md"),
        ("results/stress.md", "leaderboard.md", "leaderboard.md"),
        ("results.md", "../results/leaderboard.csv", "results/leaderboard.csv"),
        ("guide/environments.md", "../../packages/papers/PERCEPTION.md#mapping-v0", "../perception.md#mapping-v0"),
        ("perception.md", "../../docs/figures/afr-fig8.webp", "figures/afr-fig8.webp"),
        ("contributing.md", "docs/where-to-add.md", "where-to-add.md"),
        ("tutorials/index.md", "own-task.py", "own-task.md"),
        ("guide/experts.md", "../../examples/offline.py", "../examples/offline.py"),
        ("cards.md", "results/agents.md", "results/agents.md"),
        ("guide/relay.md", "../../packages/relay/README.md", "../../packages/relay/README.md"),  # on no page
        ("index.md", "#start", "#start"),
        ("index.md", "https://example.org/a.md", "https://example.org/a.md"),
    ],
)
def test_a_link_between_files_becomes_one_between_pages(page: str, link: str, becomes: str) -> None:
    assert on_site(f"see [it]({link}).", page) == f"see [it]({becomes})."
