"""Episodes of a policy, recorded from the native batch for data sets."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.envs.expert.hindsight import Clairvoyant
from bufgym.envs.expert.player import Player
from bufgym.ground.errors import BufgymError

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
        action_mask: int8[T + 1, L + 2], which actions were valid.
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
    if kind not in KINDS:
        raise BufgymError(f"kind = {kind!r}: must be one of {', '.join(KINDS)}")
    rows, n = envs.rows, envs.num_envs
    if rows.senders.topics:
        raise BufgymError("data sets are made of one queue, not of several topics")
    cast = ("expert", "medium", "random") if kind == "mixed" else (kind,)
    known = {"expert": "clairvoyant", "medium": medium}
    players = {name: Player(policies.get(known[name]), n) for name in cast if name != "random"}
    judge = Clairvoyant(envs) if regret else None
    envs.reset(seed=seed)
    rng = np.random.default_rng([seed, 1])
    # With a limit B an arrival may ask again after an eviction, at most once more for each message.
    steps = 2 * rows.scenario.max_messages + 1
    seen = np.zeros((n, steps, rows.form.numbers), np.float32)
    masks = np.zeros((n, steps, rows.capacity + 2), np.int8)
    numbers = np.zeros((n, steps, 3))  # reward, H, regret
    taken = np.zeros((n, steps), np.int64)
    every, length = np.arange(n), np.zeros(n, np.int64)
    turns = every % len(cast)
    left = np.full(n, episodes // n) + (every < episodes % n)
    while (left > 0).any():
        output, senders = rows.output, rows.senders
        mask = output.action_mask
        actions = np.full(n, rows.capacity)
        for turn, name in enumerate(cast):
            mine = every[(turns == turn) & (left > 0)]
            if name in players:
                actions[mine] = players[name].actions(senders, mine)[mine]
            elif len(mine):
                actions[mine] = np.argmax(rng.random((len(mine), mask.shape[1])) * mask[mine], axis=1)
        seen[every, length], masks[every, length], taken[every, length] = output.flat, mask, actions
        numbers[every, length, 1] = output.qoi
        if judge is not None:
            numbers[every, length, 2] = np.nan_to_num(judge.regrets()[every, actions])
        rows.step(actions)
        numbers[every, length, 0] = rows.rewards()
        length[left > 0] += 1
        ended = every[rows.output.terminated & (left > 0)]
        for i in ended.tolist():
            T = int(length[i])
            seen[i, T], masks[i, T] = rows.output.flat[i], rows.output.action_mask[i]
            numbers[i, T] = 0.0, rows.output.qoi[i], 0.0
            yield Recorded(
                cast[turns[i]],
                rows.form.masked(rows.form.of(seen[i, : T + 1].copy()), masks[i, : T + 1].copy()),
                taken[i, :T].copy(),
                numbers[i, :T, 0].copy(),
                masks[i, : T + 1].copy(),
                numbers[i, : T + 1, 1].copy(),
                None if judge is None else numbers[i, : T + 1, 2].copy(),
            )
        length[ended], left[ended], turns[ended] = 0, left[ended] - 1, (turns[ended] + 1) % len(cast)
        rows.reset(ended[left[ended] > 0])
