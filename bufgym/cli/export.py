"""``bufgym export``: a trained agent as a file of weights that any bufgym can run."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import Any

from bufgym.cli.options import Commands, command
from bufgym.errors import BufgymError


def add(commands: Commands) -> None:
    made = command(commands, "export", _export, "a trained agent as a file of weights: small, and read without torch")
    made.epilog = "A model.zip holds pickles, so reading it can run any code: export models of your own alone."
    option = made.add_argument
    option("model", metavar="MODEL", help="of a run of train.py: model.safetensors, or model.zip (--network slots)")
    option("out", metavar="OUT", help="file to write, .safetensors")
    option("--name", required=True, metavar="N", help="the policy's name")
    option("--about", default="", metavar="TEXT", help="a sentence: what it was trained for")


def _export(options: argparse.Namespace) -> None:
    print(f"wrote {_agents().export(options.model, options.out, name=options.name, about=options.about)}")


def _agents() -> Any:
    """The module ``agents.export`` of this checkout.

    By name, not by ``import``: bufgym works without ``agents``, which is no part of the wheel, and nothing but this
    command, which is about agents, ever looks for it.
    """
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "agents" / "export.py").is_file():
        raise BufgymError("export needs a checkout of bufgym: the package that trains agents is not in the wheel")
    try:
        module = importlib.import_module("agents.export")
    except ImportError as error:
        raise BufgymError(f'export needs what trains agents: pip install -e ".[train]" ({error})') from None
    if not Path(str(module.__file__)).resolve().is_relative_to(checkout):
        raise BufgymError(f"export: {module.__file__} is another package called agents")
    return module
