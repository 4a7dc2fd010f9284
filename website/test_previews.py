"""Every environment has a preview on the front page."""

import pytest

from bufgym.cli.listing import environments
from website.environments import FLEET, HISTORY
from website.previews import FOLDER, MAX_BYTES, PREVIEWS, path_of


def test_the_list_has_each_registered_environment() -> None:
    assert {*environments(), FLEET} == set(HISTORY) == set(PREVIEWS)


@pytest.mark.parametrize("id", HISTORY)
def test_the_front_page_shows_it(id: str) -> None:
    path = path_of(id)
    assert f"(gallery/{path.name})" in (FOLDER.parent / "index.md").read_text(encoding="utf-8"), (
        f"{id} is missing in docs/index.md: run python -m website.previews and add a row to its table"
    )
    assert path.stat().st_size <= MAX_BYTES
