"""Minari data sets of bufgym's environments (extra ``dataset``), recorded from the native batch."""

import os
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.envs.expert.hindsight import Clairvoyant
from bufgym.envs.expert.player import Player
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.libraries import needs

VARIABLE = "MINARI_DATASETS_PATH"
"""Environment variable for the folder of Minari's data sets; unset, ``~/.minari/datasets``."""

KINDS = ("expert", "medium", "mixed", "random")
"""Who plays: the clairvoyant, a fixed policy, a mixture of all (an episode each in turn), or random valid actions."""

ROWS = 256  # Most episodes played side by side


class Recorded(NamedTuple):
    """One episode of T decisions.

    Fields:
        player: "expert", "medium" or "random".
        observations: in the environment's form, T + 1 along the first axis; the last is taken at the end.
        actions: int64[T].
        rewards: float64[T].
        action_mask: int8[T + 1, actions], which actions were valid.
        qoi: float64[T + 1], H of the messages at the server.
        regret: float64[T + 1], the best H still attainable that each action gave up, the last 0; None if not asked for.
    """

    player: str
    observations: Any
    actions: NDArray[np.int64]
    rewards: NDArray[np.float64]
    action_mask: NDArray[np.int8]
    qoi: NDArray[np.float64]
    regret: NDArray[np.float64] | None


def record(
    envs: SenderVectorEnv, kind: str, episodes: int, *, medium: str = "afr", seed: int = 0, regret: bool = True
) -> Iterator[Recorded]:
    """Yield the ``episodes`` that ``kind`` plays in the batch, as they end; ``seed`` seeds ``envs.reset``.

    The k-th episode of a row, and its player in "mixed", is always the same. Shorter episodes come earlier.
    """
    sub_envs, n = envs.sub_envs, envs.num_envs
    if sub_envs.senders.topics:
        raise BufgymError("data sets are made of one queue, not of several topics")
    roles = ("expert", "medium", "random") if kind == "mixed" else (kind,)
    known = {"expert": "clairvoyant", "medium": medium}
    # Among candidates the clairvoyant's plan may not be there: it judges those that are.
    judges = sub_envs.choices is not None and "expert" in roles
    players = {
        name: Player(policies.get(known[name]), n)
        for name in roles
        if name != "random" and not (judges and name == "expert")
    }
    judge = Clairvoyant(envs) if regret or judges else None
    envs.reset(seed=seed)
    rng = np.random.default_rng([seed, 1])
    # With a limit B an arrival may ask again after an eviction, at most once more for each message.
    steps = 2 * sub_envs.scenario.max_messages + 1
    seen = np.zeros((n, steps, sub_envs.form.numbers), np.float32)
    masks = np.zeros((n, steps, sub_envs.actions_count), np.int8)
    numbers = np.zeros((n, steps, 3))  # reward, H, regret
    taken = np.zeros((n, steps), np.int64)
    every, length = np.arange(n), np.zeros(n, np.int64)
    turns = every % len(roles)
    left = np.full(n, episodes // n) + (every < episodes % n)
    while (left > 0).any():
        output, senders = sub_envs.output, sub_envs.senders
        mask = output.action_mask
        actions = np.full(n, sub_envs.idle_action)
        for turn, name in enumerate(roles):
            mine = every[(turns == turn) & (left > 0)]
            if name in players:
                actions[mine] = sub_envs.of_slots(players[name].actions(senders, mine))[mine]
            elif name == "expert" and judge is not None:
                actions[mine] = judge.actions()[mine]
            elif len(mine):
                actions[mine] = np.argmax(rng.random((len(mine), mask.shape[1])) * mask[mine], axis=1)
        seen[every, length], masks[every, length], taken[every, length] = output.flat, mask, actions
        numbers[every, length, 1] = output.qoi
        if regret and judge is not None:
            numbers[every, length, 2] = np.nan_to_num(judge.regrets()[every, actions])
        sub_envs.step(actions)
        numbers[every, length, 0] = sub_envs.rewards()
        length[left > 0] += 1
        ended = every[sub_envs.output.terminated & (left > 0)]
        for i in ended.tolist():
            T = int(length[i])
            seen[i, T], masks[i, T] = sub_envs.output.flat[i], sub_envs.output.action_mask[i]
            numbers[i, T] = 0.0, sub_envs.output.qoi[i], 0.0
            yield Recorded(
                roles[turns[i]],
                sub_envs.form.of(seen[i, : T + 1].copy()),
                taken[i, :T].copy(),
                numbers[i, :T, 0].copy(),
                masks[i, : T + 1].copy(),
                numbers[i, : T + 1, 1].copy(),
                numbers[i, : T + 1, 2].copy() if regret else None,
            )
        length[ended], left[ended], turns[ended] = 0, left[ended] - 1, (turns[ended] + 1) % len(roles)
        sub_envs.reset(ended[left[ended] > 0])


def make(
    env: str = "bufgym/Uplink-v1",
    kind: str = "expert",
    episodes: int = 100,
    *,
    name: str | None = None,
    out: str | Path | None = None,
    medium: str = "afr",
    seed: int = 0,
    regret: bool = True,
    **options: Any,
) -> str:
    """Record ``episodes`` and write them as one Minari data set; return its id, for ``minari.load_dataset``.

    The data set appears whole or not at all. Infos hold ``action_mask``, ``qoi`` and ``regret``; entry t of ``regret``
    is about action t. ``options`` are the environment's, as text or numbers, since the data set stores them.

    Args:
        env: the environment's id.
        kind: who plays, one of ``KINDS``.
        episodes: number of episodes.
        name: the id; None for ``bufgym/<environment>/<kind>-v0``.
        out: folder of data sets; None for Minari's own (``VARIABLE``).
        medium: the policy of "medium", and of a third of the episodes of "mixed".
        seed: seed of the batch, as in ``reset``.
        regret: whether to compute each decision's regret, which takes most of the time; equal sizes only.
    """
    with needs(("minari", "pyarrow"), "dataset", "a data set"):
        import minari  # noqa: F401
        import pyarrow  # noqa: F401  (Minari's storage format here)
    env = env if "/" in env else f"bufgym/{env}"
    known = [id for id in gym.registry if id.startswith("bufgym/")]
    if env not in known:
        raise unknown("environment", env, known)
    if kind not in KINDS:
        raise BufgymError(f"kind = {kind!r}: must be one of {', '.join(KINDS)}")
    name = name or f"{env.lower().rsplit('-', 1)[0]}/{kind}-v0"
    root = _folder_for(name, out)
    single = _environment_of(env, options)
    batch = SenderVectorEnv(min(episodes, ROWS), **{**gym.spec(env).kwargs, **options, "info": "mask"})
    recorded = record(batch, kind, episodes, medium=medium, seed=seed, regret=regret)
    players = {"expert": "clairvoyant", "medium": medium, "random": "random", "mixed": f"clairvoyant, {medium}, random"}
    about = f"bufgym: {players[kind]} in {env}, {options or 'default settings'}, seed {seed}"
    with tempfile.TemporaryDirectory(prefix=".bufgym-", dir=root) as folder:
        with _minari_writes_to(folder):
            _write(name, recorded, single, players[kind], about)
        with _minari_writes_to(root):
            _register_namespace(name)
        os.replace(Path(folder) / name, root / name)
    return name


def _folder_for(name: str, out: str | Path | None) -> Path:
    """The folder of data sets, made if missing; an error if it holds this one. Absolute, as for a relative folder
    Minari writes Arrow files beside it."""
    root = Path(out or os.environ.get(VARIABLE) or Path.home() / ".minari" / "datasets").absolute()
    if (root / name).exists():
        raise BufgymError(f"{root / name}: exists already; remove it or give another --name")
    root.mkdir(parents=True, exist_ok=True)
    return root


def _environment_of(env: str, options: dict[str, Any]) -> Any:
    """Make the single environment that Minari stores with a data set, so that its readers can make it again.

    Raises:
        BufgymError: an option has no form in JSON.
    """
    single = gym.make(env, **options)
    try:
        cast(Any, single.spec).to_json()
    except (TypeError, ValueError):
        raise BufgymError("options: give them as text or numbers, so that the environment can be recovered") from None
    return single


@contextmanager
def _minari_writes_to(folder: str | Path) -> Iterator[None]:
    from unittest.mock import patch  # here, as it is slow to import

    with patch.dict(os.environ, {VARIABLE: str(folder)}):
        yield


def _write(name: str, recorded: Iterable[Recorded], single: Any, players: str, about: str) -> None:
    """Write the episodes as the data set ``name`` into Minari's folder."""
    import minari

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Minari asks for an author and the like
        try:
            minari.create_dataset_from_buffers(
                name,
                (_episode_buffer(number, episode) for number, episode in enumerate(recorded)),
                env=single,
                algorithm_name=players,
                description=about,
                data_format="arrow",
                requirements=["bufgym"],
            )
        except ValueError as error:
            if "dataset ID" not in str(error):
                raise
            raise BufgymError(f"--name {name}: must be of the form (namespace/)name-v0") from None


def _episode_buffer(number: int, episode: Recorded) -> Any:
    """An episode as Minari stores it."""
    from minari.data_collector import EpisodeBuffer

    infos: dict[str, Any] = {"action_mask": episode.action_mask, "qoi": episode.qoi.tolist()}
    if episode.regret is not None:
        infos["regret"] = episode.regret.tolist()
    T = len(episode.actions)
    return EpisodeBuffer(
        id=number,
        options={"player": episode.player},
        observations=episode.observations,
        actions=episode.actions,
        rewards=episode.rewards,
        terminations=[False] * (T - 1) + [True],
        truncations=[False] * T,
        infos=infos,
    )


def _register_namespace(name: str) -> None:
    """Make the data set's namespace in Minari's folder, if it has one that is new there."""
    from minari import namespace as namespaces

    namespace = name.rpartition("/")[0]
    if namespace and namespace not in namespaces.list_local_namespaces():
        namespaces.create_namespace(namespace)
