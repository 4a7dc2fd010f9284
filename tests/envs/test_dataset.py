"""Data sets: what is recorded, written by Minari, and read again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import oracle
from bufgym.cli import main
from bufgym.envs import SenderEnv, SenderVectorEnv, expert
from bufgym.envs.expert.dataset import KINDS, record
from bufgym.ground.errors import BufgymError

SHORT = {"duration_s": 2.0, "size_bytes": 500_000}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_recorded_can_be_played_again(kind: str) -> None:
    """Row 0's episodes, in the single environment with its seed: the same observations, rewards and masks."""
    episodes = list(record(SenderVectorEnv(2, "lte", 4, observation="flat", **SHORT), kind, 6, seed=3))
    assert len(episodes) == 6
    turns = ("expert", "medium", "random") if kind == "mixed" else (kind,) * 3
    env = SenderEnv("lte", 4, observation="flat", **SHORT)
    for k, played in enumerate(episodes[::2]):
        assert played.player == turns[k]
        seen, info = env.reset(seed=3 if k == 0 else None)
        know = expert.clairvoyant(env)
        for t, action in enumerate(played.actions):
            assert np.array_equal(seen, played.observations[t])
            assert np.array_equal(info["action_mask"], played.action_mask[t]) and played.action_mask[t, action]
            assert played.regret is not None and played.regret[t] == know.regrets()[0, action]
            seen, reward, ended, _, info = env.step(action)
            assert reward == played.rewards[t]
        assert ended and np.array_equal(seen, played.observations[-1]) and info["qoi"] == played.qoi[-1]
        episode = env.rows.senders.episodes[0]
        assert episode is not None and played.regret is not None
        # What its decisions gave away one by one is what it lacks in the end.
        most = oracle.clairvoyant(episode, 4, env.rows.senders.value).qoi
        assert info["qoi"] + played.regret.sum() == pytest.approx(most, abs=1e-9)


def test_a_data_set_recovers_its_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    minari = pytest.importorskip("minari")
    command = ["dataset", "make", "--env", "Interruption-v0", "--kind", "mixed", "--episodes", "7", "--capacity", "3"]
    command += ["--option", "t_max=20", "--option", "value=saturating:0.5", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "bufgym/interruption/mixed-v0: 7 episodes" in capsys.readouterr().out
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    made = minari.load_dataset("bufgym/interruption/mixed-v0")
    assert made.total_episodes == 7
    env = made.recover_environment()
    assert env.unwrapped.rows.capacity == 3 and env.unwrapped.rows.scenario.t_max == 20
    for episode in made:
        assert len(episode.infos["regret"]) == len(episode.actions) + 1 == len(episode.infos["action_mask"])
        assert episode.terminations[-1] and not episode.truncations.any()
        assert all(mask[action] for mask, action in zip(episode.infos["action_mask"], episode.actions, strict=False))
        assert all(part.shape[0] == len(episode.actions) + 1 for part in episode.observations.values())
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".bufgym")]


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    from bufgym.envs.expert import dataset

    refuse("for equal sizes only", dataset.make, "Uplink-v0", "random", 2, out=tmp_path, size_cv=0.5, **SHORT)
    with pytest.raises(BufgymError, match="must be of the form"):
        dataset.make("Uplink-v0", "random", 2, out=tmp_path, name="no version!", regret=False, **SHORT)
    assert not [path for path in tmp_path.iterdir() if path.is_dir() and path.name != "bufgym"]


def test_infos_have_the_same_entries_in_every_step() -> None:
    """As recorders that stack them step by step want it."""
    for options in ({}, {"bound": True}):
        env = SenderEnv("lte", 4, info="steady", **SHORT, **options)
        _, info = env.reset(seed=0)
        ended = False
        while not ended:
            _, _, ended, _, after = env.step(4)
            assert after.keys() == info.keys()
