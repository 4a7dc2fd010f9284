"""``bufgym export``: a trained agent as a file of weights that any bufgym can run."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command


def add(commands: Commands) -> None:
    parser = command(commands, "export", _export, "a trained agent as a file of weights: small, and read without torch")
    parser.epilog = "A model.zip holds pickles, so reading it can run any code: export models of your own alone."
    option = parser.add_argument
    option("model", metavar="MODEL", help="of a run of train.py: model.safetensors, or model.zip (--network slots)")
    option("out", metavar="OUT", help="file to write, .safetensors")
    option("--name", required=True, metavar="N", help="the policy's name")
    option("--about", default="", metavar="TEXT", help="a sentence: what it was trained for")


def _export(options: argparse.Namespace) -> None:
    from bufgym.sb3 import export

    print(f"wrote {export(options.model, options.out, name=options.name, about=options.about)}")
