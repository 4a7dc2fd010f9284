"""ROS 1 in C++: the source of a library that puts roscpp's queues under policies, by LD_PRELOAD, nodes unchanged.

The AFR paper's own program is a changed roscpp, and leaves an interface to choose the algorithm for future work
[wang2022afr, Sec. IV-C]. Here the choice is an environment variable or a private parameter of the node.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bufgym import policies
from bufgym.ground import __version__
from bufgym.ground.errors import BufgymError
from bufgym.model import qoi
from bufgym.policies import Policy
from bufgym.traces.formats.text import write_text
from bufgym_live.robot.c import SUPPORTED
from bufgym_live.robot.c.header import header

_SOURCE: Final = Path(__file__).with_name("source")
_CAPACITY: Final = 64  # ``MOST`` of policy.h

ALL: Final = (*SUPPORTED, "learned")


def write(folder: str | Path, chosen: Sequence[Policy]) -> Path:
    """Write the library's source with these policies to a folder: C++, CMakeLists.txt, package.xml.

    Raises:
        BufgymError: a policy has no C, or the folder cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BufgymError(f"{folder}: {error.strerror or error}") from None
    names = {policy.name: _identifier(policy.name) for policy in chosen}
    texts = {file.name: file.read_text(encoding="utf-8") for file in sorted(_SOURCE.iterdir())}
    texts["package.xml"] = texts["package.xml"].replace("@VERSION@", __version__)
    texts["policies.cpp"] = _table(chosen, names)
    for policy in chosen:
        prefix = names[policy.name]
        texts[f"{prefix}.h"] = header(policy, _CAPACITY, qoi.exponential(), prefix=prefix)
    for name, text in texts.items():
        write_text(folder / name, [text])
    return folder


def find(text: str) -> list[Policy]:
    """The policies of ``all``, or of names and files with commas between."""
    names = ALL if text == "all" else text.split(",")
    return [policies.load(name) if name.endswith(".safetensors") else policies.get(name) for name in names]


def _identifier(name: str) -> str:
    return "p_" + "".join(c if c.isalnum() else "_" for c in name.lower())


def _table(chosen: Sequence[Policy], names: dict[str, str]) -> str:
    """policies.cpp: a class for each policy, and the table in which they are found by name."""
    lines = ["// The policies of this library.", '#include "policy.h"', ""]
    for prefix in names.values():
        lines += [
            f"#define {prefix.upper()}_OWN_VALUE",
            f"#define {prefix.upper()}_STRAIGHT bufgym::straight()",
            f"#define {prefix}_value bufgym::value",
            f"#define {prefix}_merging_loss bufgym::merging_loss",
            f'#include "{prefix}.h"',
            f"BUFGYM_QUEUE({prefix})",
            "",
        ]
    lines += ["namespace bufgym", "{", "static const Policy policies[] = {"]
    for policy in chosen:
        name, parameters = json.dumps(policy.name), json.dumps(json.dumps(dict(policy.parameters)))
        lines.append(f"  {{{name}, {parameters}, {names[policy.name]}_class::make}},")
    lines += [
        "};",
        "",
        "const Policy *find(const std::string &name)",
        "{",
        "  for (const Policy &policy : policies)",
        "    if (name == policy.name)",
        "      return &policy;",
        "  return nullptr;",
        "}",
        "",
        "std::string known()",
        "{",
        "  std::string names;",
        "  for (const Policy &policy : policies)",
        '    names += (names.empty() ? "" : ", ") + std::string(policy.name);',
        "  return names;",
        "}",
        "}",
        "",
    ]
    return "\n".join(lines)
