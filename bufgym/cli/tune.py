"""``bufgym tune``: parameters of the fixed policies, chosen on validation episodes."""

from __future__ import annotations

import argparse
import shlex

from bufgym.cli.options import Commands, command, episodes, policies_option, policy_specs


def add(commands: Commands) -> None:
    parser = command(commands, "tune", _tune, "choose the policies' parameters on a suite's validation episodes")
    option = parser.add_argument
    option("suite", metavar="SUITE", help="which ('bufgym list suites')")
    policies_option(parser, "all that have a grid of settings, by their plain names")
    option("--split", default="validation", metavar="S", help="validation (default) or train; test is refused")
    option("--data", metavar="DIR", help="folder of recordings, for suites over real links")
    option("--seeds", type=episodes, metavar="N", help="episodes on each trace (default: the suite's)")
    option("--jobs", type=int, metavar="N", help="processes side by side (default: one a core)")
    option("--write", action="store_true", help="keep the choices for bufgym bench --suite")


def _tune(options: argparse.Namespace) -> None:
    from bufgym.benchmark import tune

    names = policy_specs(options.policies)
    choices = tune.tune(
        options.suite, names, split=options.split, data=options.data, seeds=options.seeds, jobs=options.jobs
    )
    print(tune.plain(choices))
    if options.write:
        print(f"\nwrote {tune.write(options.suite, choices, split=options.split, command=_command(options))}")


def _command(options: argparse.Namespace) -> str:
    """Write the command that repeats this; another machine has its own folder of recordings."""
    words = ["bufgym tune", options.suite]
    for name, default in (("policies", None), ("split", "validation"), ("seeds", None)):
        value = getattr(options, name)
        if value != default:
            text = ",".join(value) if isinstance(value, list) else str(value)
            words.append(f"--{name} {shlex.quote(text)}")
    return " ".join([*words, *(["--data DIR"] if options.data is not None else []), "--write"])
