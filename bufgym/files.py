"""Files: written whole or not at all, and the folders of those that come with bufgym."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


@contextmanager
def replaced(target: Path) -> Iterator[Path]:
    """A temporary file beside ``target`` to write to; it replaces the target if the block ends without an error."""
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes a file that only its owner may read; a result should be as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def shipped(inside: str, checkout: str, pattern: str) -> dict[str, Path]:
    """Stem -> path of the files that come with bufgym; empty where there are none.

    A wheel carries them inside the package, in ``bufgym/data/<inside>``; a checkout has them in its ``<checkout>``.
    """
    for folder in (PACKAGE / "data" / inside, PACKAGE.parent / checkout):
        # A folder with an __init__.py is another package of that name, next to an installed bufgym.
        if folder.is_dir() and not (folder / "__init__.py").exists():
            files = sorted(folder.glob(pattern))
            if files:
                return {path.stem: path for path in files}
    return {}
