"""A bar on the terminal for work that takes longer than a second."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def bar(total: int | None, show: bool, unit: str = "run", done: int = 0) -> Iterator[Any]:
    """Yield a function to call with the number of units just finished; ``done`` units were finished before.

    ``total`` is None where it is not known.
    """
    if show and sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            pass
        else:
            # Work shorter than a second needs no bar.
            with tqdm(total=total, initial=done, unit=unit, delay=1.0, leave=False, file=sys.stderr) as progress:
                yield progress.update
                return
    yield lambda _: None
