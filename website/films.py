"""The site's films, by name, and how they are written: animated WebP of at most 300 kB each.

``python -m website.films NAME... --out DIR`` writes films, ``--interactive FILE`` the interactive page. Every film
shows a fixed episode, so the command draws the same film again.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bufgym import policies
from bufgym.envs import SenderEnv
from bufgym.envs.expert import Player
from bufgym.envs.render.image import COLOURS, canvas_of, pixels
from bufgym.scenario import Episode, Interruption, Scenario, get, suites
from bufgym.scenario.numbered import draw, numbered
from bufgym.utils.errors import BufgymError
from website import interactive, picture
from website.picture import fading, play

Frames = Iterator[NDArray[np.uint8]]

FRAME_MS, WHOLE_MS = 140, 2500
"""How long each image is shown, and the one with the whole story."""
MAX_BYTES = 300_000
"""Of a film."""
_COLOURS = 48
"""The films are line art: so many colours are enough."""
_COUNT = 24
"""Images of a film that an environment renders."""
QUEUE = ("drop-oldest", "afr", "min-motion-gap", "learned")
"""The policies that are shown on one queue."""


class Film(NamedTuple):
    """One film."""

    environment: str
    """The environment whose episode it shows."""
    about: str
    """What there is to see."""
    frames: Callable[[], Frames]
    """Makes its images."""


def write_film(name: str, folder: Path) -> Path:
    """Write the film to ``folder/name.webp`` and return that path; BufgymError for an unknown name.

    It begins with the end, which tells the whole story where a film does not move, as in print.
    """
    if name not in FILMS:
        raise BufgymError(f"unknown film {name!r}; known: {', '.join(FILMS)}")
    pictures = [Image.fromarray(frame) for frame in FILMS[name].frames()]
    palette = _palette(pictures)
    pictures.insert(0, pictures.pop())
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE).convert("RGB") for picture in pictures]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.webp"
    durations = [WHOLE_MS] + [FRAME_MS] * (len(pictures) - 1)
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=durations, loop=0, lossless=True, method=4
    )
    return path


def _palette(pictures: Sequence[Image.Image]) -> Image.Image:
    """One palette for all images, so that nothing flickers: of the middle and the last one, and of each state."""
    width, height = pictures[-1].size
    sample = Image.new("RGB", (width, 2 * height + 40 * len(COLOURS)), "white")
    sample.paste(pictures[len(pictures) // 2], (0, 0))
    sample.paste(pictures[-1], (0, height))
    for k, colour in enumerate(COLOURS):
        sample.paste(Image.new("RGB", (width, 40), colour), (0, 2 * height + 40 * k))
    return sample.quantize(_COLOURS, method=Image.Quantize.MEDIANCUT)


def _compared(names: Sequence[str], episode: Episode, scenario: Scenario, title: str) -> Frames:
    return picture.frames(play(names, episode, 8, scenario), episode, title)


def _readme() -> Frames:
    scenario = fading()
    title = "The link fades; the send buffer holds 8 messages. What does the server see?"
    return _compared(("drop-oldest", "learned"), draw(scenario, 0), scenario, title)


def _uplink() -> Frames:
    scenario = get("lte", duration_s=20.0, scale=(0.7,))
    episode = numbered(scenario, seed=1, trace="lte-synthetic-5")
    return _compared(QUEUE, episode, scenario, "A camera on a driving robot over LTE, L = 8")


def _interruption() -> Frames:
    scenario = Interruption(law="fixed", t_max=60)
    title = "One interruption of 60 messages, L = 8: nobody knows how long it will last"
    return _compared(QUEUE, draw(scenario, 0), scenario, title)


def _suite() -> Frames:
    scenario = suites.get("outage-v1").settings("test")["outage-10s"].scenario
    return _compared(QUEUE, draw(scenario, 0), scenario, "An episode of the suite outage-v1, L = 8")


def _topics() -> Frames:
    scenario = get("topics", duration_s=20.0)
    episode = draw(scenario, 0)
    films = [_rendered_topics(name, episode) for name in ("robofleet", "gap-priority")]
    return _stacked(("robofleet", "gap-priority"), films)


def _rendered_topics(name: str, episode: Episode) -> list[NDArray[np.uint8]]:
    """Images of ``bufgym/Topics-v0`` at even times while this policy plays."""
    env = SenderEnv("topics", 32, duration_s=20.0, render_mode="rgb_array", info="mask")
    senders, player = env.sub_envs.senders, Player(policies.get(name))
    env.reset(options={"episode": episode})
    times_us = np.linspace(0, int(episode.arrivals["arrival_us"][-1]), _COUNT + 1)[1:].tolist()
    pictures: list[NDArray[np.uint8]] = []
    ended = False
    while not ended:
        ended = env.step(player.action(senders))[2]
        while len(pictures) < _COUNT and (ended or senders.batch.senders[0]["now_us"] >= times_us[len(pictures)]):
            pictures.append(env.render())
    return pictures


def _mapping() -> Frames:
    scenario = get("bufgym_papers.perception.worth:mapping")
    return _compared(QUEUE, draw(scenario, 2), scenario, "A made-up room is filmed over LTE, L = 8")


def _fleet() -> Frames:
    titles, films = zip(*map(_rendered_cell, ("drop-oldest", "learned")), strict=True)
    return _stacked(titles, films)


def _rendered_cell(name: str) -> tuple[str, list[NDArray[np.uint8]]]:
    """A title with how it ends, and images of ``FleetEnv`` while every robot plays this policy."""
    from bufgym.envs import FleetEnv

    env = FleetEnv(robots=8, capacity=8, duration_s=12.0, scale=(0.7,), info="mask", render_mode="rgb_array")
    env.reset(seed=1)
    player, senders, ticks = Player(policies.get(name), 8), env.sub_envs.senders, 12 * 30
    shown = set(np.linspace(ticks / _COUNT, ticks, _COUNT).astype(int).tolist())
    pictures = []
    for tick in range(1, ticks + 1):
        env.step({agent: player.action(senders, i) for i, agent in enumerate(env.agents)})
        if tick in shown:
            pictures.append(env.render())
    h = float(env.sub_envs.summary(slice(None))["qoi"].mean())
    return f"{name}: H = {h:.2f} in the end, mean over the robots", pictures


def _stacked(names: Sequence[str], films: Sequence[Sequence[NDArray[np.uint8]]]) -> Frames:
    """The films one below the other, each with its policy's name."""
    for pictures in zip(*films, strict=True):
        yield np.concatenate([_titled(name, picture) for name, picture in zip(names, pictures, strict=True)])


def _titled(name: str, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    figure, canvas = canvas_of(picture.shape[1], 24)
    figure.text(0.012, 0.45, name, fontsize=10.5, weight="bold", va="center")
    return np.concatenate([pixels(canvas), picture])


FILMS: dict[str, Film] = {
    "fading-link": Film(
        "bufgym/Uplink-v1", "a link fades and comes back: Drop Oldest beside the learned agent", _readme
    ),
    "interruption": Film("bufgym/Interruption-v1", "one interruption: which messages stay queued", _interruption),
    "uplink": Film("bufgym/Uplink-v1", "a camera on a driving robot over LTE", _uplink),
    "suite": Film("bufgym/Suite-v1", "a blackout of ten seconds, from the suite outage-v1", _suite),
    "topics": Film("bufgym/Topics-v0", "eight topics over one uplink: Robofleet beside the rule gap-priority", _topics),
    "fleet": Film("bufgym_fleet_v0", "eight robots share one cell: Drop Oldest beside the learned agent", _fleet),
    "mapping": Film("bufgym/Mapping-v0", "a made-up room is filmed: four policies, one link", _mapping),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the films and the page that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m website.films", description="Draw the site's pictures.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"films: all, {', '.join(FILMS)}")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--interactive", type=Path, metavar="FILE", help="write the interactive page (HTML)")
    options = parser.parse_args(arguments)
    if options.interactive is not None:
        options.interactive.write_text(interactive.page(), encoding="utf-8")
        print(f"wrote {options.interactive}")
    for name in FILMS if "all" in options.names else options.names:
        path = write_film(name, options.out)
        print(f"wrote {path} ({path.stat().st_size / 1000:.0f} kB)", flush=True)


if __name__ == "__main__":
    main()
