"""``bufgym export``: a trained agent as a file of weights that any bufgym can run, or a policy as a header in C."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command, count, refuse
from bufgym.ground.errors import BufgymError

_FOR_C = ("capacity", "max_bytes", "value")
_FOR_WEIGHTS = ("name", "about")


def add(commands: Commands) -> None:
    parser = command(
        commands, "export", _export, "a trained agent as a file of weights, read without torch; or a policy in C"
    )
    parser.epilog = "A model.zip holds pickles, so reading it can run any code: export models of your own alone."
    option = parser.add_argument
    option("model", metavar="MODEL", help="of a run of train.py: model.safetensors, or model.zip (--network slots)")
    option("out", metavar="OUT", nargs="?", help="file to write")
    option("--out", metavar="OUT", dest="into", help="the same")
    option("--to", choices=("safetensors", "c"), default="safetensors", help="kind of file (%(default)s)")
    weights = parser.add_argument_group("weights (--to safetensors)")
    weights.add_argument("--name", metavar="N", help="the policy's name; must be given")
    weights.add_argument("--about", metavar="TEXT", help="a sentence on the purpose of its training")
    c = parser.add_argument_group(
        "C (--to c)",
        "One C99 header that decides as Python does. MODEL is a policy's name, as afr, or a .safetensors of weights.",
    )
    c.add_argument("--capacity", type=count, metavar="L", help="L, messages (16)")
    c.add_argument("--max-bytes", type=count, metavar="B", help="B, bytes queued at most (no limit)")
    c.add_argument("--value", metavar="V", help="V as in saturating:4 (exponential:0.618)")


def _export(options: argparse.Namespace) -> None:
    if (options.out is None) == (options.into is None):
        raise BufgymError("the file to write must be given once: OUT or --out OUT")
    out = options.into or options.out
    print(f"wrote {_as_c(options, out) if options.to == 'c' else _as_weights(options, out)}")


def _as_weights(options: argparse.Namespace, out: str) -> object:
    from bufgym.sb3 import export

    refuse(options, _FOR_C, "belongs to --to c")
    if options.name is None:
        raise BufgymError("--name must be given: the policy's name")
    return export(options.model, out, name=options.name, about=options.about or "")


def _as_c(options: argparse.Namespace, out: str) -> object:
    from bufgym import policies
    from bufgym.model import qoi
    from bufgym.robot import c

    refuse(options, _FOR_WEIGHTS, "belongs to --to safetensors")
    is_file = options.model.endswith(".safetensors")
    policy = policies.load(options.model) if is_file else policies.get(options.model)
    value = qoi.load(options.value or "exponential:0.618")
    return c.write(policy, out, options.capacity or 16, value, options.max_bytes)
