"""The folder of cached code."""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

from bufgym.utils.files import PACKAGE

VARIABLE = "BUFGYM_CACHE"
"""Environment variable of the folder."""


def _is_writable(folder: Path) -> bool:
    """Whether files can be written in ``folder``, which is made if missing."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def _cache_folder() -> str:
    """Choose the folder: ``BUFGYM_CACHE``, beside the package, or in the user's cache.

    If none can be written, this process and its children share a new one, whose name nobody can foresee.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    places = PACKAGE / "__pycache__", Path(home) / "bufgym"
    parent = os.environ.get(VARIABLE) or next(filter(_is_writable, places), None)
    if parent is None:
        parent = os.environ[VARIABLE] = tempfile.mkdtemp(prefix="bufgym-")
        atexit.register(shutil.rmtree, parent, ignore_errors=True)
        print(
            "bufgym: compiled code cannot be kept, as neither the package nor the cache folder can be written; "
            f"set {VARIABLE} to a folder that can",
            file=sys.stderr,
        )
    return str(Path(parent, "kernels"))


FOLDER = _cache_folder()
"""Folder for compiled code."""
