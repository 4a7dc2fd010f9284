"""``bufgym dataset``: episodes of an expert, a fixed policy or random actions as a Minari data set."""

from __future__ import annotations

import argparse
import json
from typing import Any

from bufgym.cli.options import Commands, Parser, count, episodes, natural
from bufgym.ground.errors import BufgymError


def add(commands: Commands) -> None:
    about = "record data sets for imitation and offline learning"
    dataset = commands.add_parser("dataset", help=about, description=about[0].upper() + about[1:] + ".")
    verbs: Commands = dataset.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=Parser)
    about = "record episodes and write them as a Minari data set"
    make = verbs.add_parser("make", help=about, description=about[0].upper() + about[1:] + ".")
    make.set_defaults(command=_make)
    option = make.add_argument
    option("--env", metavar="ID", help="environment of one queue (default: Uplink-v0)")
    option("--suite", metavar="SUITE", help="instead: the episodes of this suite")
    option("--split", default="train", metavar="S", help="of the suite (%(default)s)")
    option("--kind", default="expert", metavar="K", help="expert (default), medium, mixed or random")
    option("--policy", default="afr", metavar="P", help="the policy of medium and mixed (%(default)s)")
    option("--episodes", type=episodes, default=100, metavar="N", help="how many (%(default)s)")
    option("--capacity", type=count, default=8, metavar="L", help="L, messages (%(default)s)")
    option("--seed", type=natural, default=0, help="of the batch (%(default)s)")
    option("--option", action="append", default=[], metavar="NAME=VALUE", help="a further argument of the environment")
    option("--no-regret", action="store_true", help="leave out each decision's regret: faster, and for any sizes")
    option("--name", metavar="ID", help="id of the data set (default: bufgym/ENVIRONMENT/KIND-v0)")
    option("--out", metavar="DIR", help="folder of data sets (default: Minari's own)")


def _make(options: argparse.Namespace) -> None:
    from bufgym.envs.expert import dataset

    if options.suite is not None and options.env is not None:
        raise BufgymError("--suite and --env: give one of them")
    further = dict(_setting(text) for text in options.option)
    if options.suite is not None:
        further |= {"suite": options.suite, "split": options.split}
    env = "bufgym/Suite-v0" if options.suite is not None else options.env or "bufgym/Uplink-v0"
    name = dataset.make(
        env,
        options.kind,
        options.episodes,
        name=options.name,
        out=options.out,
        medium=options.policy,
        seed=options.seed,
        regret=not options.no_regret,
        capacity=options.capacity,
        **further,
    )
    print(f"wrote {name}: {options.episodes} episodes; minari.load_dataset({name!r})")


def _setting(text: str) -> tuple[str, Any]:
    """Parse ``"t_max=60"`` to ("t_max", 60); a value that is not JSON stays text."""
    name, sign, value = text.partition("=")
    if not (name.isidentifier() and sign):
        raise BufgymError(f"--option {text}: must be NAME=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value
