"""``bufgym play``: a policy decides, in the terminal or in a film."""

import os
import re
import sys
from pathlib import Path
from typing import Any

from bufgym.cli.listing import environments
from bufgym.cli.options import Count, Natural, PerSecond, one_policy
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.files import replaced
from bufgym.utils.libraries import library

FILMS = {".gif": "GIF", ".webp": "WEBP", ".png": "PNG"}  # Suffix of a film -> Pillow's name of the format


def play(
    *,
    policies: str = "afr",
    env: str = "Uplink-v1",
    capacity: Count = 8,
    seed: Natural = 0,
    speed: PerSecond = 5.0,
    steps: Count = 200,
    out: Path | None = None,
) -> None:
    """Watch a policy decide, in the terminal.

    Args:
        policies: The policy, as in bench.
        env: Environment.
        capacity: L, messages.
        seed: The episode of this seed in bench.
        speed: Decisions a second.
        steps: Stop after so many decisions.
        out: Write a film in place (.gif, .webp, .png).
    """
    import time

    import gymnasium

    from bufgym.envs.expert import Player
    from bufgym.scenario.numbered import draw

    policy = one_policy(policies)
    known = environments()
    id = env if "/" in env else f"bufgym/{env}"
    if id not in known:
        raise unknown("environment", env, sorted(known))
    if out is not None and (out.suffix not in FILMS or not out.parent.is_dir()):
        raise BufgymError(f"--out {out}: must end in {' or '.join(FILMS)}, in a folder that exists")
    if out is not None:
        library("PIL", "plot", "--out")
    mode = "ansi" if out is None else "rgb_array"
    world: Any = gymnasium.make(id, capacity=capacity, render_mode=mode, actions="slots").unwrapped
    player = Player(policy)
    world.reset(options={"episode": draw(world.sub_envs.scenario, seed)})
    # On a terminal each picture replaces the one before, unless the user wants no escape codes (no-color.org).
    plain = not sys.stdout.isatty() or bool(os.environ.get("NO_COLOR"))
    clear = "" if plain else "\x1b[H\x1b[J"
    film: list[Any] | None = None if out is None else []

    def show(title: str) -> None:
        image = world.render()
        if film is not None:
            film.append(image)
        else:
            print(title + (re.sub(r"\x1b\[[\d;]*m", "", image) if plain else image), flush=True)

    end = f"stopped after {steps} decisions (--steps)"
    for step in range(steps):
        show(f"{clear}{policy.name}, decision {step + 1}\n")
        if film is None:
            time.sleep(1 / speed)
        # An episode that asks for no decision ends with its first step, whatever the action.
        due = world.sub_envs.senders.batch.senders[0]["waiting"] != 0
        _, _, ended, _, info = world.step(player.action(world.sub_envs.senders, 0) if due else capacity)
        if ended:
            show("")
            end = f"over: QoI {info['qoi']:.3f}, {info['delivered']} of {info['arrived']} delivered,"
            end += f" {info['dropped']} dropped"
            break
    print(end)
    if film is not None and out is not None:
        from PIL import Image  # comes with matplotlib, which drew them

        first, *others = map(Image.fromarray, film)
        with replaced(out) as temporary:
            first.save(temporary, FILMS[out.suffix], save_all=True, append_images=others, duration=1000 / speed)
        print(f"wrote {out} ({len(film)} pictures)")
