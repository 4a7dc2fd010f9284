"""Meaning of a score: the time that the camera looked at something that the server never saw.

    python examples/view_missed.py

Plays policies on the episodes of ``bufgym bench`` (``bufgym/Uplink-v1`` by its defaults) and prints each one's score
beside the seconds of view that the server missed. A moment is missed where no image that arrived has ``--overlap`` of
the camera's image in it: three quarters are what matching two images for a map asks for.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, scenario, sim
from bufgym.oracle import clairvoyant, normalised_score
from bufgym.sim import outcome

BASELINE = "drop-oldest"


def missed(x: NDArray[np.float64], arrived: NDArray[np.bool_], overlap: float) -> float:
    """The share of frames, at these places in order (fields of view), that no arrived frame overlaps enough."""
    seen = np.concatenate([[-np.inf], x[arrived], [np.inf]])
    after = np.searchsorted(seen, x)
    nearest = np.minimum(x - seen[after - 1], seen[after] - x)
    return float(np.mean(nearest > 1 - overlap))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = "clairvoyant,learned,min-motion-gap,orbbuf,afr,keyframe,drop-oldest,random"
    parser.add_argument("--policies", default=known, help="(%(default)s)")
    parser.add_argument("--seeds", type=int, default=20, help="episodes on each trace (%(default)s)")
    parser.add_argument("--capacity", type=int, default=8, help="L (%(default)s)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of an episode (%(default)s)")
    parser.add_argument("--overlap", type=float, default=0.75, help="share of an image (%(default)s)")
    parser.add_argument("--score", type=float, default=0.7, help="what would this miss? (%(default)s)")
    options = parser.parse_args()
    uplink = scenario.get("lte", duration_s=options.seconds)
    parts = [replace(uplink, traces=(trace,)) for trace in uplink.traces]
    episodes = [scenario.draw(part, seed) for part in parts for seed in range(options.seeds)]
    best = sum(clairvoyant(episode, options.capacity, uplink.value).qoi for episode in episodes)
    h, missed_s = {}, {}
    for name in dict.fromkeys([BASELINE, *options.policies.split(",")]):
        senders = sim.run(policies.get(name), episodes, options.capacity, uplink.value)
        h[name] = sum(outcome(senders, i).qoi for i in range(len(episodes)))
        logs = [np.asarray(log)[: len(e.arrivals)] for log, e in zip(senders.batch.log, episodes, strict=True)]
        shares = [
            missed(e.arrivals["x"], log["dropped_us"] < 0, options.overlap)
            for e, log in zip(episodes, logs, strict=True)
        ]
        missed_s[name] = options.seconds * float(np.mean(shares))
    score = {name: float(normalised_score(h[name], h[BASELINE], best)) for name in h}
    print(f"{'policy':16} score  view missed (s)")
    for name in sorted(h, key=lambda name: -h[name]):
        print(f"{name:16} {score[name]:5.3f}  {missed_s[name]:15.2f}")
    print(f"means over {len(episodes)} episodes of {options.seconds:g} s, L = {options.capacity}")
    between = sorted(score, key=lambda name: score[name])
    about_s = np.interp(options.score, [score[name] for name in between], [missed_s[name] for name in between])
    print(f"a score of {options.score:g}: {about_s:.2f} s, interpolated")


if __name__ == "__main__":
    main()
