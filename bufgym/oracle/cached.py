"""Plans of the clairvoyant that took long, cached on disk beside the compiled code: the next run reads them."""

import contextlib
import functools
import hashlib
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit.folder import FOLDER
from bufgym.utils.files import PACKAGE, replaced

SOURCES = (
    *(
        f"oracle/{name}.py"
        for name in ("beam", "clairvoyant", "interruption", "labels", "pieces", "programme", "unequal")
    ),
    *(f"model/{name}.py" for name in ("buffer", "link", "qoi")),
)
"""Files of the package that say what a plan is. Another text of theirs finds no plan that was cached before."""

_HEAD = "<d?"  # H, and whether it is certified; a bit for each message follows, then the digest of all before it
_OTHERS = 3  # Folders that stay of other texts of the sources

Found = tuple[float, NDArray[np.bool_], bool]
"""(H, the messages to keep, whether H is certified)."""


def cached(inputs: tuple[Any, ...], messages: int, find: Callable[[], Found]) -> Found:
    """Return what ``find`` gives for these ``inputs``, from disk if it was found before.

    A file that is missing or damaged is made anew. Where none can be written, nothing is cached.
    """
    bytes_of = [one.tobytes() if isinstance(one, np.ndarray) else repr(one).encode() for one in inputs]
    name = hashlib.sha256(b"".join(hashlib.sha256(one).digest() for one in bytes_of)).hexdigest()[:32]
    file = Path(FOLDER).parent / "plans" / sources() / name
    with contextlib.suppress(OSError):
        data = file.read_bytes()
        head, digest = struct.calcsize(_HEAD), hashlib.sha256(data[:-32]).digest()
        if len(data) == head + (messages + 7) // 8 + 32 and data[-32:] == digest:
            qoi, certified = struct.unpack_from(_HEAD, data)
            bits = np.frombuffer(data[head:-32], np.uint8)
            return qoi, np.unpackbits(bits, count=messages).astype(np.bool_), certified
    qoi, plan, certified = find()
    data = struct.pack(_HEAD, qoi, certified) + np.packbits(plan).tobytes()
    with contextlib.suppress(OSError):
        if not file.parent.exists():
            others = sorted(file.parent.parent.glob("*"), key=lambda folder: folder.stat().st_mtime)
            for old in others[:-_OTHERS]:
                shutil.rmtree(old, ignore_errors=True)
            file.parent.mkdir(parents=True, exist_ok=True)
        with replaced(file) as part:
            part.write_bytes(data + hashlib.sha256(data).digest())
    return qoi, plan, certified


@functools.cache
def sources() -> str:
    """Hash of all that says what a plan is."""
    texts = ((PACKAGE / file).read_bytes() for file in SOURCES)
    return hashlib.sha256(b"".join(hashlib.sha256(text).digest() for text in texts)).hexdigest()[:16]
