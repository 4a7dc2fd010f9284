"""``bufgym play``: a policy decides, in the terminal or in a film."""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bufgym.cli.listing import environments
from bufgym.cli.options import Commands, command, count, least_0, load_policies, loaded, natural, policy_file
from bufgym.ground.errors import BufgymError, install
from bufgym.ground.files import replaced

FILMS = {".gif": "GIF", ".webp": "WEBP", ".png": "PNG"}
"""Suffix of a film -> Pillow's name of the format."""


def add(commands: Commands) -> None:
    play = command(commands, "play", _play, "watch a policy decide, in the terminal")
    play.add_argument("--policies", default="afr", metavar="NAME", help="the policy, as in bench (%(default)s)")
    play.add_argument("--env", default="Uplink-v0", help="environment (%(default)s)")
    play.add_argument("--capacity", type=count, default=8, metavar="L", help="L, messages (%(default)s)")
    play.add_argument("--seed", type=natural, default=0, help="the episode of this seed in bench (%(default)s)")
    play.add_argument("--speed", type=least_0, default=5.0, help="decisions a second; 0: no pause (%(default)s)")
    play.add_argument("--steps", type=count, default=200, help="stop after so many decisions (%(default)s)")
    play.add_argument("--out", type=Path, metavar="FILE", help=f"write a film in place ({', '.join(FILMS)})")
    policy_file(play)


def _play(options: argparse.Namespace) -> None:
    import time

    import gymnasium

    from bufgym import policies
    from bufgym.benchmark.run import draw
    from bufgym.envs.expert import Player

    load_policies(options.policy_file)
    (name,) = loaded([options.policies])[0]
    policy = policies.get(name)
    known = environments()
    id = options.env if "/" in options.env else f"bufgym/{options.env}"
    if id not in known:
        raise BufgymError(f"unknown environment {options.env!r}; known: {', '.join(sorted(known))}")
    if options.out is not None and (options.out.suffix not in FILMS or not options.out.parent.is_dir()):
        raise BufgymError(f"--out {options.out}: must end in {' or '.join(FILMS)}, in a folder that exists")
    if options.out is not None and importlib.util.find_spec("PIL") is None:
        raise BufgymError(f"--out needs matplotlib and Pillow: {install('plot')}")
    mode = "ansi" if options.out is None else "rgb_array"
    env: Any = gymnasium.make(id, capacity=options.capacity, render_mode=mode).unwrapped
    player = Player(policy)
    env.reset(options={"episode": draw(env.rows.scenario, options.seed)})
    # On a terminal each picture replaces the one before, unless the user wants no escape codes (no-color.org).
    plain = not sys.stdout.isatty() or bool(os.environ.get("NO_COLOR"))
    clear = "" if plain else "\x1b[H\x1b[J"
    film: list[Any] | None = None if options.out is None else []

    def show(title: str) -> None:
        image = env.render()
        if film is not None:
            film.append(image)
        else:
            print(title + (re.sub(r"\x1b\[[\d;]*m", "", image) if plain else image), flush=True)

    end = f"stopped after {options.steps} decisions (--steps)"
    for step in range(options.steps):
        show(f"{clear}{policy.name}, decision {step + 1}\n")
        if options.speed and film is None:
            time.sleep(1 / options.speed)
        # An episode that asks for no decision ends with its first step, whatever the action.
        due = env.rows.senders.batch.senders[0]["waiting"] != 0
        _, _, ended, _, info = env.step(player.action(env.rows.senders, 0) if due else options.capacity)
        if ended:
            show("")
            end = f"over: QoI {info['qoi']:.3f}, {info['delivered']} of {info['arrived']} delivered,"
            end += f" {info['dropped']} dropped"
            break
    print(end)
    if film is not None:
        _write(film, options.out, options.speed)
        print(f"wrote {options.out} ({len(film)} pictures)")


def _write(film: Sequence[Any], path: Path, speed: float) -> None:
    """Write the images uint8[height, width, 3] as an animation of ``speed`` images a second, 10 where it is 0."""
    from PIL import Image  # comes with matplotlib, which drew them

    first, *others = map(Image.fromarray, film)
    with replaced(path) as temporary:
        first.save(temporary, FILMS[path.suffix], save_all=True, append_images=others, duration=1000 / (speed or 10))
