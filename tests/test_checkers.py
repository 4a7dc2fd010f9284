"""The checkers of four libraries have nothing to say of any environment, in any form; a warning is an error here."""

import pickle
from contextlib import suppress
from functools import partial
from importlib.util import find_spec
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.utils import env_checker
from needs import needs

import bufgym.envs
from bufgym.cli.listing import environments

SMALL: dict[str, dict[str, Any]] = {
    "bufgym/Interruption-v1": {"t_max": 20},
    "bufgym/Uplink-v1": {"duration_s": 1.0, "size_bytes": 1_000_000},
    "bufgym/Suite-v1": {"suite": "interruption-v1"},
    "bufgym/Topics-v0": {"duration_s": 0.1},
    "bufgym/Mapping-v0": {},
}
"""Arguments that make episodes of every environment short."""
ROBOTS = {"capacity": 4, "duration_s": 2.0, "size_bytes": 600_000}  # an episode of a fleet has 60 ticks
FORMS = [{"observation": form} for form in ("dict", "flat")]
IDS = sorted(environments())

every_id = pytest.mark.parametrize("id", IDS)
every_form = pytest.mark.parametrize("form", FORMS, ids=str)


@pytest.fixture(autouse=True)
def screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """SDL's dummy, on which pictures do not wait for one another."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with suppress(ImportError):
        import pygame

        monkeypatch.setattr(pygame.time, "Clock", lambda: SimpleNamespace(tick=lambda rate: None))


def made(id: str, **options: Any) -> gym.Env[Any, Any]:
    """One of the environments, with short episodes."""
    if id not in bufgym.ENVIRONMENTS:
        pytest.importorskip("cv2", reason=needs("extras", "cv2"))
    return gym.make(id, capacity=3, **SMALL[id], **options)


@every_id
@every_form
def test_gymnasium_and_a_pickled_copy_is_equal(id: str, form: dict[str, Any]) -> None:
    env = made(id, **form)
    copied = pickle.loads(pickle.dumps(env))
    env_checker.check_env(env.unwrapped, skip_render_check=find_spec("pygame") is None)  # the extra [human]
    assert env_checker.data_equivalence(env.reset(seed=1), copied.reset(seed=1))


@every_id
@every_form
def test_stable_baselines3(id: str, form: dict[str, Any]) -> None:
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason=needs("extras", "stable_baselines3.common.env_checker")
    )
    checker.check_env(made(id, **form).unwrapped)


@every_id
@every_form
def test_torchrl(id: str, form: dict[str, Any]) -> None:
    envs = pytest.importorskip("torchrl.envs", reason=needs("torchrl", "torchrl.envs"))
    envs.check_env_specs(envs.GymWrapper(made(id, **form)))
    batch = gym.make_vec(id, num_envs=2, capacity=3, **SMALL[id], **form, autoreset_mode="Disabled")
    envs.check_env_specs(envs.GymWrapper(batch))


@pytest.mark.parametrize("robots", [1, 3])
@every_form
def test_pettingzoo(robots: int, form: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    zoo = pytest.importorskip("pettingzoo.test", reason=needs("extras", "pettingzoo.test"))
    make = partial(bufgym.envs.FleetEnv, robots=robots, **ROBOTS, **form)
    zoo.parallel_api_test(make(), num_cycles=70)
    zoo.parallel_seed_test(make, num_cycles=20)
    assert "Passed" in capsys.readouterr().out


# Remarks that are no rules: on observations that are dicts, and on zeros, which a robot sees at the end.
@pytest.mark.filterwarnings("ignore:Observation")
@every_form
def test_pettingzoo_turn_by_turn(form: dict[str, Any]) -> None:
    zoo = pytest.importorskip("pettingzoo.test", reason=needs("extras", "pettingzoo.test"))
    from pettingzoo.utils import parallel_to_aec

    def make() -> Any:
        return parallel_to_aec(bufgym.envs.FleetEnv(robots=3, **ROBOTS, **form))

    zoo.api_test(make(), num_cycles=70)
    zoo.seed_test(make, num_cycles=20)
