"""ROS 1 in C++: the source of a library that puts roscpp's queues under policies, by LD_PRELOAD, nodes unchanged.

The AFR paper's own program is a changed roscpp, and leaves an interface to choose the algorithm for future work
[wang2022afr, Sec. IV-C]. Here the choice is an environment variable or a private parameter of the node.
"""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from bufgym import policies
from bufgym.model import qoi
from bufgym.policies import Policy
from bufgym.traces.formats.text import write_text
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError
from bufgym_robot.c.header import header, supported

_SOURCE: Final = Path(__file__).with_name("source")
SHARED: Final = {name: _SOURCE / name for name in ("link.h", "log.h", "motion.h", "policy.cpp", "policy.h")}
"""Files without ROS 1."""
_CAPACITY: Final = 64  # ``MOST`` of policy.h

_QUEUE: Final = """
#define {macro}_V bufgym::v.numbers
#define {macro}_V_SIZE 2
#include "{prefix}.h"
BUFGYM_QUEUE({prefix})
"""
"""A policy's header, with V of the library."""


def find(text: str) -> list[Policy]:
    """The policies of ``all``, or of names and files of weights with commas between."""
    names = [*supported()] if text == "all" else text.split(",")
    found = [policies.load(name) if name.endswith(".safetensors") else policies.get(name) for name in names]
    late = [policy.name for policy in found if policy.drops_at_dequeue]
    if late and text != "all":
        raise BufgymError(f"policy {late[0]}: drops when the socket is free, which the libraries in C++ do not do")
    return [policy for policy in found if policy.name not in late]


def write(folder: str | Path, chosen: Sequence[Policy], files: Mapping[str, Path] | None = None) -> Path:
    """Write the library's source with these policies to a folder: C++, CMakeLists.txt, package.xml.

    ``files`` are those of another package by their names in the folder, in place of this library's.

    Raises:
        BufgymError: a policy has no C, or the folder cannot be written.
    """
    folder = Path(folder)
    files = {file.name: file for file in _SOURCE.iterdir()} if files is None else files
    try:
        for name in files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BufgymError(f"{folder}: {error.strerror or error}") from None
    texts = {name: file.read_text(encoding="utf-8") for name, file in sorted(files.items())}
    texts["package.xml"] = texts["package.xml"].replace("@VERSION@", __version__)
    queues, table = "", ""
    for policy in chosen:
        prefix = "p_" + re.sub("[^a-z0-9]", "_", policy.name.lower())
        texts[f"{prefix}.h"] = header(policy, _CAPACITY, qoi.exponential(), prefix=prefix, parity=False)
        queues += _QUEUE.format(prefix=prefix, macro=prefix.upper())
        facts = json.dumps(policy.name), json.dumps(json.dumps(dict(policy.parameters))), f"{prefix}_class::make"
        table += f"    {{{', '.join(facts)}}},\n"
    table = f"const bufgym::Policy bufgym::policies[] = {{\n{table}    {{nullptr, nullptr, nullptr}}}};\n"
    texts["policies.cpp"] = f'// The policies of this library.\n#include "policy.h"\n{queues}\n{table}'
    for name, text in texts.items():
        write_text(folder / name, [text])
    return folder
