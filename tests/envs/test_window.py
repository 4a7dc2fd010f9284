"""``render_mode="human"``: a window with the image of "rgb_array" at each reset and step, on SDL's dummy screen."""

import pickle
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from cli_cases import Patch
from needs import needs
from numpy.typing import NDArray

import bufgym.envs
from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.scenario import Interruption

ON: dict[str, Any] = {"scenario": Interruption(law="fixed", t_max=6), "capacity": 2}


@pytest.fixture
def waits(monkeypatch: Patch) -> Iterator[list[float]]:
    """The rates of the clock that paces the window; it does not wait."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    pygame = pytest.importorskip("pygame", reason=needs("extras", "pygame"))
    rates: list[float] = []

    class Clock:
        def tick(self, rate: float) -> None:
            rates.append(rate)

    monkeypatch.setattr(pygame.time, "Clock", Clock)
    yield rates
    pygame.display.quit()


def screen() -> NDArray[np.uint8] | None:
    """What the screen shows, uint8[height, width, 3]; None if there is no window."""
    import pygame

    if not pygame.display.get_init():
        return None
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_each_reset_and_step_shows_the_image(waits: list[float]) -> None:
    """A reset, five steps and a call of ``render`` are seven pictures, at ten a second."""
    seen = gym.make("bufgym/Interruption-v1", render_mode="human", law="fixed", t_max=6, capacity=2, actions="slots")
    drawn = gym.make(
        "bufgym/Interruption-v1", render_mode="rgb_array", law="fixed", t_max=6, capacity=2, actions="slots"
    )
    assert screen() is None and "human" in seen.metadata["render_modes"]
    seen.reset(seed=0), drawn.reset(seed=0)
    np.testing.assert_array_equal(screen(), drawn.render())
    for action in (3, 3, 0, 2, 1):
        seen.step(action), drawn.step(action)
        np.testing.assert_array_equal(screen(), drawn.render())
    assert seen.render() is None
    assert waits == [10] * 7
    seen.close(), seen.close()
    assert screen() is None
    seen.reset(seed=0)  # a closed environment that goes on opens another window
    assert screen() is not None
    seen.close()


def test_a_batch_shows_its_rows_side_by_side(waits: list[float]) -> None:
    """Three rows of 800 x 400: two above, the third below on the left, white beside it."""
    seen = gym.make_vec(
        "bufgym/Interruption-v1", num_envs=3, render_mode="human", law="fixed", t_max=6, capacity=2, actions="slots"
    )
    drawn = SenderVectorEnv(3, **ON, render_mode="rgb_array", actions="slots")
    for envs in (seen, drawn):
        envs.reset(seed=0)
        envs.step(np.array([3, 2, 2]))
    shown, images = screen(), drawn.render()
    assert shown is not None and shown.shape == (800, 1600, 3) and waits == [10] * 2
    np.testing.assert_array_equal(shown[:400, :800], images[0])
    np.testing.assert_array_equal(shown[:400, 800:], images[1])
    np.testing.assert_array_equal(shown[400:, :800], images[2])
    assert (shown[400:, 800:] == 255).all()
    seen.close()
    assert screen() is None


def test_of_many_rows_the_first_sixteen_are_shown(waits: list[float]) -> None:
    envs = SenderVectorEnv(40, **ON, render_mode="human", actions="slots")
    envs.reset(seed=0)
    shown = screen()
    assert shown is not None and shown.shape == (800, 1600, 3)  # 4 x 4 of half the size
    envs.close()


def test_a_fleet_is_shown(waits: list[float]) -> None:
    pytest.importorskip("pettingzoo", reason=needs("extras", "pettingzoo"))
    seen, drawn = (bufgym.envs.FleetEnv(robots=2, duration_s=2.0, render_mode=m) for m in ("human", "rgb_array"))
    for env in (seen, drawn):
        env.reset(seed=1)
        env.step(dict.fromkeys(env.agents, 0))
    np.testing.assert_array_equal(screen(), drawn.render())
    assert seen.render() is None and waits == [10] * 3
    seen.close()
    assert screen() is None


def test_a_copy_draws_on_its_own(waits: list[float]) -> None:
    env = SenderEnv(**ON, render_mode="human", actions="slots")
    env.reset(seed=0)
    copied = pickle.loads(pickle.dumps(env))
    env.close()
    copied.step(3)
    assert screen() is not None
    copied.close()


@pytest.mark.parametrize("library", ["pygame", "matplotlib"])
def test_without_its_libraries_one_sentence_names_the_extra(library: str, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", sys)  # stands for it, should it not be installed
    monkeypatch.setitem(sys.modules, library, None)
    for make in (SenderEnv, SenderVectorEnv):
        with pytest.raises(gym.error.DependencyNotInstalled, match=rf"'human' needs {library}: .*\[human\]"):
            make(**ON, render_mode="human")
