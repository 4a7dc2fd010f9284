"""``bufgym play``: shows a policy's decisions in the terminal."""

from __future__ import annotations

import argparse
import os
import re
import sys
from typing import Any

from bufgym.cli.listing import environments
from bufgym.cli.options import Commands, command, count, least_0, load_policies, loaded, natural, policy_file
from bufgym.errors import BufgymError


def add(commands: Commands) -> None:
    play = command(commands, "play", _play, "watch a policy decide, in the terminal")
    play.add_argument("--policies", default="afr", metavar="NAME", help="the policy, as in bench (%(default)s)")
    play.add_argument("--env", default="Uplink-v0", help="environment (%(default)s)")
    play.add_argument("--capacity", type=count, default=8, metavar="L", help="L, messages (%(default)s)")
    play.add_argument("--seed", type=natural, default=0, help="the episode of this seed in bench (%(default)s)")
    play.add_argument("--speed", type=least_0, default=5.0, help="decisions a second; 0: no pause (%(default)s)")
    play.add_argument("--steps", type=count, default=200, help="stop after so many decisions (%(default)s)")
    policy_file(play)


def _play(options: argparse.Namespace) -> None:
    import time

    import gymnasium

    from bufgym import policies
    from bufgym.benchmark.run import draw
    from bufgym.expert import Player

    load_policies(options.policy_file)
    (name,) = loaded([options.policies])[0]
    policy = policies.get(name)
    known = environments()
    id = options.env if "/" in options.env else f"bufgym/{options.env}"
    if id not in known:
        raise BufgymError(f"unknown environment {options.env!r}; known: {', '.join(sorted(known))}")
    env: Any = gymnasium.make(id, capacity=options.capacity, render_mode="ansi").unwrapped
    player = Player(policy)
    env.reset(options={"episode": draw(env.rows.scenario, options.seed)})
    # On a terminal each picture replaces the one before, unless NO_COLOR (no-color.org) forbids escape codes.
    plain = not sys.stdout.isatty() or bool(os.environ.get("NO_COLOR"))
    clear = "" if plain else "\x1b[H\x1b[J"

    def picture() -> str:
        return re.sub(r"\x1b\[[\d;]*m", "", env.render()) if plain else str(env.render())

    for step in range(options.steps):
        print(f"{clear}{policy.name}, decision {step + 1}\n{picture()}", flush=True)
        if options.speed:
            time.sleep(1 / options.speed)
        # An episode without decisions ends at its first step, whatever the action.
        due = env.rows.senders.batch.senders[0]["waiting"] != 0
        _, _, ended, _, info = env.step(player.action(env.rows.senders, 0) if due else options.capacity)
        if ended:
            print(
                f"{picture()}\nover: QoI {info['qoi']:.3f}, {info['delivered']} of {info['arrived']} delivered,"
                f" {info['dropped']} dropped"
            )
            return
    print(f"stopped after {options.steps} decisions (--steps)")
