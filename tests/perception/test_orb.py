"""ORBBuf by images: what is similar, and that only the similarity is another than in the policy `orbbuf`."""

from __future__ import annotations

import numpy as np
import pytest

from bufgym import scenario, sim
from bufgym.perception.orb import OrbSimilarity, decision_ms, orbbuf_by
from bufgym.policies import get
from bufgym.scenario.numbered import draw


@pytest.mark.parametrize("L", [1, 2, 3, 8])
def test_with_motion_for_images_it_decides_as_orbbuf(L: int) -> None:
    uplink = scenario.get("lte", duration_s=4.0)
    episode = draw(uplink, 3)
    x = episode.arrivals["x"]
    similar = orbbuf_by(lambda i, j: 1 - uplink.value(float(x[j] - x[i])), episode)
    kept = [
        np.asarray(sim.run(policy, [episode], L, uplink.value).batch.log[0])["dropped_us"]
        for policy in (similar, get("orbbuf"))
    ]
    assert kept[0].tolist() == kept[1].tolist()
    assert (kept[0] >= 0).any()


def texture(seed: int) -> np.ndarray:
    """Squares of noise, which have corners."""
    return np.random.default_rng(seed).integers(0, 255, (30, 40), np.uint8).repeat(8, 0).repeat(8, 1)


def test_images_are_like_themselves_less_like_what_moved_and_hardly_like_others() -> None:
    pytest.importorskip("cv2")
    first = texture(0)
    images = [first, np.roll(first, 80, axis=1), texture(1), np.zeros_like(first), first]
    similar = OrbSimilarity(images.__getitem__)
    assert similar(0, 4) > 0.95
    assert 0.3 < similar(0, 1) < similar(0, 4)
    assert similar(0, 2) < 0.3
    assert similar(0, 3) == similar(3, 0) == 0  # no features, no likeness
    assert similar(1, 0) == similar(0, 1)


def test_a_decision_takes_time() -> None:
    pytest.importorskip("cv2")
    from bufgym.perception.room import room

    assert (decision_ms(room(0, frames=5).reduced(4), 2) > 0).all()
