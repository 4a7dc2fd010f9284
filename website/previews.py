"""A preview of each environment for the front page: one image that its own ``render_mode`` draws in mid-episode.

``python -m website.previews`` writes ``docs/gallery/preview-NAME.webp`` for every environment, at most 60 kB each.
Seeds and policies are fixed, so the command draws the same images again. It needs the extras ``plot`` and ``fleet``,
and ``packages/papers[perception]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bufgym import policies
from bufgym.envs import FleetEnv
from bufgym.envs.expert import Player
from bufgym.utils.errors import BufgymError
from website.environments import FLEET, HISTORY, slug

FOLDER = Path(__file__).parents[1] / "docs" / "gallery"
MAX_BYTES = 60_000
"""Of a preview."""
_COLOURS = 64
"""Line art needs no more colours."""


class Preview(NamedTuple):
    """The moment that a preview shows."""

    policy: str
    """Policy that plays."""
    at_s: float
    """The first decision at or after this time of the episode is shown, s."""
    options: Mapping[str, Any]
    """Arguments of the environment."""
    seed: int = 0
    """Seed of the episode."""


PREVIEWS = {
    "bufgym/Interruption-v1": Preview("afr", 8.0, {"capacity": 8, "t_max": 300, "law": "fixed"}),
    "bufgym/Uplink-v1": Preview("learned", 14.0, {"capacity": 8, "size_bytes": 460_800}),
    "bufgym/Suite-v1": Preview("learned", 10.0, {"capacity": 8, "suite": "outage-v1"}, seed=5),
    "bufgym/Topics-v0": Preview("gap-priority", 10.0, {}),
    "bufgym/Mapping-v0": Preview("learned", 3.0, {"capacity": 8}),
    FLEET: Preview("learned", 10.0, {"robots": 8, "capacity": 8, "scale": (0.7,)}),
}
"""Every environment's preview, by the environment's id."""


def image(id: str) -> NDArray[np.uint8]:
    """The preview as uint8[400, 800, 3]; BufgymError if the episode ends before its moment."""
    preview = PREVIEWS[id]
    options: dict[str, Any] = dict(preview.options) | {"render_mode": "rgb_array", "info": "mask"}
    if id == FLEET:
        env: Any = FleetEnv(**options)
    else:
        env = gym.make(id, actions="slots", **options).unwrapped  # so that any policy can act
    env.reset(seed=preview.seed)
    senders = env.sub_envs.senders
    player = Player(policies.get(preview.policy), len(senders.batch.senders))
    while senders.batch.senders["now_us"].max() < preview.at_s * 1e6:
        if id == FLEET:
            env.step({agent: player.action(senders, i) for i, agent in enumerate(env.agents)})
            ended = not env.agents
        else:
            ended = env.step(player.action(senders))[2]
        if ended:
            raise BufgymError(f"{id}: the episode of seed {preview.seed} ends before {preview.at_s} s")
    return np.asarray(env.render())


def path_of(id: str) -> Path:
    """The file of an environment's preview."""
    return FOLDER / f"preview-{slug(id)}.webp"


def main() -> None:
    """Write every preview."""
    for id in HISTORY:
        drawn = Image.fromarray(image(id)).quantize(_COLOURS, dither=Image.Dither.NONE).convert("RGB")
        path = path_of(id)
        drawn.save(path, lossless=True, method=6)
        print(f"wrote {path.relative_to(FOLDER.parents[1])} ({path.stat().st_size / 1000:.0f} kB)", flush=True)


if __name__ == "__main__":
    main()
