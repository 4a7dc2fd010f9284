"""Plausible actions: the two smallest gaps and a head whose turn is near, beside accepting and rejecting."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import policies
from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.envs.expert.player import Player
from bufgym.envs.options import Options
from bufgym.envs.plausible import NEAR, keep_plausible
from bufgym.envs.rows import Rows
from bufgym.jit import named
from bufgym.scenario import Interruption, Uplink
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.sim.rollout import python_arrival, python_view
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

SWITCHING = Uplink(traces=(Trace.steps([(1.0, 2_000_000), (1.5, 60_000)]),), rate_hz=20, duration_s=10.0)


def plausible(rows: Rows) -> Any:
    """The mask of all rows, cleared."""
    mask = rows.output.action_mask.copy()
    keep_plausible(rows.senders.batch, np.arange(len(rows)), mask)
    return mask


def begun(scenario: Any, L: int, n: int = 1) -> Rows:
    """Rows at their first decision."""
    rows = Rows(n, scenario, Options(capacity=L, actions="slots"))
    for i in range(n):
        rows.seed(i, np.random.default_rng(i))
    rows.reset(np.arange(n))
    return rows


@pytest.mark.kernels
def test_in_an_interruption_the_two_smallest_gaps_may_go() -> None:
    """L = 4, and nothing leaves. x counts the messages, and 0 has crossed. All are accepted up to 4; to let 5 in, 2
    goes; to let 6 in, 4 goes: the queue is 1 3 5 6, asked for 7. Its gaps if one goes are 3 - 0, 5 - 1, 6 - 3, 7 - 5.
    """
    rows = begun(Interruption(law="uniform", t_min=20, t_max=20), 4)
    for action in (5, 5, 5, 5, 1, 2):
        rows.step(np.array([action]))
    batch = rows.senders.batch
    first = int(batch.senders["first"][0])
    assert batch.slots["seq"][0][first - 1 : first + 4].tolist() == [0, 1, 3, 5, 6]
    # 2 for the tail is smallest; then 3, by the older of two. Nobody accepts into a full queue.
    assert rows.output.action_mask[0].tolist() == [1, 1, 1, 1, 1, 0]
    assert plausible(rows)[0].tolist() == [1, 0, 0, 1, 1, 0]


def slow_reference(rows: Rows, i: int) -> list[int]:
    """The mask of row ``i`` by sorting, from what a policy sees."""
    valid: list[int] = rows.output.action_mask[i].tolist()
    if rows.output.terminated[i]:
        return valid
    batch = named(rows.senders.batch)
    buffer, arrival = python_view(batch, i), python_arrival(batch, i)
    x = [buffer.dequeued_x, *(message.x for message in buffer.slots), arrival.x]
    kept = {k for _, k in sorted((x[k + 2] - x[k], k) for k in range(len(buffer.slots)))[:2]}
    if buffer.left_bytes < NEAR * buffer.period_us / 1e6 * buffer.short_rate_bytes_per_s:
        kept.add(0)
    return [valid[k] and int(k in kept) for k in range(rows.capacity)] + valid[-2:]


@pytest.mark.kernels
@pytest.mark.parametrize("L", [1, 2, 6])
def test_over_a_switching_link_it_is_what_sorting_says(L: int) -> None:
    rng, rows = np.random.default_rng(L), begun(SWITCHING, L, 3)
    cleared, heads = 0, 0
    while not rows.output.terminated.all():
        mask = plausible(rows)
        assert mask.tolist() == [slow_reference(rows, i) for i in range(3)]
        cleared += int((rows.output.action_mask - mask).sum())
        heads += int((mask[:, :L].sum(axis=1) > 2).sum())
        rows.step((rng.random(mask.shape) * mask).argmax(axis=1))
    assert (cleared > 0, heads > 0) == (L > 2, L > 2)


def test_the_rule_chooses_among_them() -> None:
    """``target-gap`` on a shipped link: at most one decision in two hundred is another."""
    rows, rule = begun(uplink_over_lte(), 8), Player(policies.get("target-gap"))
    kept: list[bool] = []
    while not rows.output.terminated[0]:
        action = rule.action(rows.senders)
        kept.append(bool(plausible(rows)[0, action]))
        rows.step(np.array([action]))
    assert len(kept) > 800 and np.mean(kept) > 0.995


def test_environments_show_them_if_asked() -> None:
    """Beside an environment that shows all valid actions, in the same states; a batch shows the same."""
    made: dict[str, Any] = {"scenario": SWITCHING, "capacity": 6}
    valid, few = SenderEnv(**made, actions="slots"), SenderEnv(**made, mask="plausible", actions="slots")
    batch = SenderVectorEnv(1, **made, mask="plausible", actions="slots")
    (_, shown), (_, info), (_, infos) = (env.reset(seed=3) for env in (valid, few, batch))
    rng = np.random.default_rng(0)
    for _ in range(100):
        assert info["action_mask"].tolist() == plausible(valid.rows)[0].tolist() == infos["action_mask"][0].tolist()
        action = int((rng.random(8) * shown["action_mask"]).argmax())
        shown, info = valid.step(action)[4], few.step(action)[4]
        infos = batch.step(np.array([action]))[4]
    assert shown["qoi"] == info["qoi"] and shown["invalid"] == info["invalid"] == 0


def test_what_it_is_not_for() -> None:
    refuse("mask = 'few': must be one of 'valid', 'plausible'", SenderEnv, SWITCHING, mask="few")
    with pytest.raises(BufgymError, match="known for one queue, not for several topics"):
        gym.make("bufgym/Topics-v0", mask="plausible")
