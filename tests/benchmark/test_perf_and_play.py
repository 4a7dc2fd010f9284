"""The speed report at tiny sizes, a policy as the player of an environment, and what is compiled beforehand."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from refusal_cases import refuse

import bufgym.envs  # noqa: F401  (registers)
from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark import perf, yardstick
from bufgym.benchmark.run import draw, run
from bufgym.benchmark.warmup import PARTS
from bufgym.cli import main
from bufgym.envs.expert import Player
from bufgym.ground.errors import BufgymError
from bufgym.ground.kernel import FOLDER, JIT, named
from bufgym.policies import Policy
from bufgym.scenario import Interruption, Uplink
from bufgym.sim import run as run_senders
from bufgym.sim.metrics import outcome
from bufgym.sim.rollout import python_arrival, python_view
from bufgym.traces import Trace

PLAYABLE = [p.name for p in map(policies.get, policies.names()) if not (p.drops_at_dequeue or p.unbounded)]

TINY = perf.Sizes(3, (2, 1), 24, 10, 1, 1)


def test_every_figure_is_a_number_with_its_ratio_and_definition(tmp_path: Path) -> None:
    figures = perf.measure(TINY)
    assert all(math.isfinite(figure.value) and figure.value > 0 and figure.definition for figure in figures)
    assert all(figure.ratio and math.isfinite(figure.ratio) for figure in figures)
    assert figures[0].name == "yardstick" and len({figure.name for figure in figures}) == len(figures) == 19
    text = perf.report(figures, TINY.repeats)
    assert all(figure.name in text and figure.definition in text for figure in figures)
    perf.write_json(figures, TINY, tmp_path / "perf.json")
    read = json.loads((tmp_path / "perf.json").read_text())
    assert [figure["name"] for figure in read["figures"]] == [figure.name for figure in figures]


def test_a_history_says_what_fell_below_the_median_of_the_last_five(tmp_path: Path) -> None:
    file = tmp_path / "new" / "perf.jsonl"

    def told(ratio: float, sizes: perf.Sizes = TINY) -> str:
        return perf.remember([perf.Measurement("batch", 1.0, "steps/s", ratio, "")], sizes, file)

    assert all(told(ratio).startswith("no ratio") for ratio in (1.0, 1.0, 1.0, 9.0, 0.9, 1.1))
    assert told(0.86).startswith("no ratio fell") and told(0.84) == (
        "fell by more than 15% below the median of the last 5 runs: batch: 0.84 after 1"
    )
    assert told(0.1, perf.Sizes()).startswith("no ratio"), "other sizes"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(lines) == 9 and lines[3]["ratios"] == {"batch": 9.0}
    file.write_text("nothing\n")
    refuse("not a history", told, 1.0)


def test_the_yardstick_writes_the_numbers_of_the_environment() -> None:
    """It is set to the state of an environment; those that need its link and past stay out."""
    env: Any = gym.make("bufgym/Uplink-v0", capacity=4, observation="flat").unwrapped
    flat, info = env.reset(seed=3)
    for k in range(40):
        flat, _, ended, _, info = env.step(5 if info["action_mask"][5] else k % 4)
        assert not ended
    buffer, arrival = python_view(named(env.rows.senders.batch), 0), python_arrival(named(env.rows.senders.batch), 0)
    bare, s = yardstick.Bare.new(1, 4), len(buffer.slots)
    at_s, x, size, gain = bare.places[0]
    zero = buffer.dequeued_arrival_us
    rows = [*buffer.slots, arrival]
    at_s[1 : s + 2] = [(row.arrival_us - zero) * 1e-6 for row in rows]
    x[0], x[1 : s + 2] = buffer.dequeued_x, [row.x for row in rows]
    size[1 : s + 2] = [row.size_bytes for row in rows]
    bare.previous[0, :2] = (buffer.previous_us - zero) * 1e-6, buffer.previous_x
    at_s[s + 2] = 2 * at_s[s + 1] - bare.previous[0, 0]
    x[s + 2] = 2 * x[s + 1] - bare.previous[0, 1]
    gain[1:] = 1 - np.exp(-yardstick.STEEP * np.diff(x))
    bare.state[0, yardstick.QUEUED] = s
    mine, mask = np.zeros((1, 56), np.float32), np.zeros((1, 6), np.int8)
    yardstick.observe(bare, 0, mine, mask)
    assert s >= 2 and mask[0].tolist() == info["action_mask"].tolist()
    of_v = {*range(30, 35), *range(40, 45)}  # losses: this V is another
    places = [k for k in range(49) if k not in of_v]
    assert mine[0, places] == pytest.approx(flat[places], abs=2e-4)


GAPPY = Uplink(traces=(Trace.steps([(1.0, 900_000), (0.7, 0)], name="t"),), rate_hz=20, duration_s=5)


def played(env: Any, player: Player, episode: Any) -> dict[str, Any]:
    env.reset(options={"episode": episode})
    ended, info = False, {}
    while not ended:
        _, _, ended, _, info = env.step(player.action(env.rows.senders))
    refuse("no decision is due", player.action, env.rows.senders)
    return info


@pytest.mark.parametrize("name", PLAYABLE)
@pytest.mark.parametrize("scenario", [Interruption(t_max=40), GAPPY], ids=["interruption", "uplink"])
def test_a_player_in_the_environment_does_what_the_benchmark_does(name: str, scenario: Any) -> None:
    env: Any = gym.make("bufgym/Uplink-v0", scenario=scenario, capacity=3).unwrapped
    for row in run([policies.get(name)], scenario, [3], 2):
        info = played(env, Player(policies.get(name)), draw(scenario, row["seed"]))
        assert (info["delivered"], info["qoi"]) == (row["delivered"], pytest.approx(row["qoi"]))


@pytest.mark.parametrize("name", ["robofleet", "edf", "drop-oldest"])
def test_a_player_of_topics_reaches_what_its_policy_reaches(name: str) -> None:
    """At arrivals and at a free socket: the same deliveries and the same weighted QoI as a rollout's."""
    client = replace(scenarios.get("topics"), duration_s=2.0)
    episode, policy = draw(client, 3), policies.get(name)
    reached = outcome(run_senders(policy, [episode], 6, client.value, topics=client.topics), 0)
    info = played(gym.make("bufgym/Topics-v0", scenario=client, capacity=6).unwrapped, Player(policy), episode)
    assert info["qoi"] == pytest.approx(reached.qoi)
    assert (info["delivered"], info["invalid"]) == (reached.delivered, reached.invalid)


def test_a_player_refuses_a_decision_that_means_nothing() -> None:
    env: Any = gym.make("bufgym/Interruption-v0", capacity=3).unwrapped
    env.reset(seed=0)
    for decision, says in ((3, "decision 3"), (None, "on_arrival returned None: must be a whole number")):
        with pytest.raises(BufgymError, match=f"policy odd: {says}"):
            Player(Policy("odd", lambda buffer, arrival, memory: decision)).action(env.rows.senders)  # noqa: B023
    env = gym.make("bufgym/Topics-v0", capacity=3).unwrapped
    env.reset(seed=0)
    env.step(4)  # accept: now the socket asks
    with pytest.raises(BufgymError, match="policy odd: sends slot 3"):
        odd = Policy("odd", policies.get("fifo").on_arrival, on_send=lambda buffer, memory: 3)
        Player(odd).action(env.rows.senders)
    for name, why in (("codel", "drops at dequeue"), ("rosbridge", "has an unbounded queue")):
        refuse(f"policy {name} {why}", Player, policies.get(name))


@pytest.mark.nightly
@pytest.mark.skipif(not JIT, reason="nothing is compiled")
def test_each_part_is_named_and_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["warmup"]) == 0
    told = capsys.readouterr()
    text = told.out + told.err
    assert all(f"/{len(PARTS)} {name}: " in text for name in PARTS)
    assert FOLDER in text
