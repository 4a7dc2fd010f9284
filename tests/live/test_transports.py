"""Queues on real sockets, over shaped links: as in the simulator, and worse where the system's buffers hide a queue."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import numpy as np
import pytest
from live_cases import OVER_TCP, meeting_port

from bufgym import policies
from bufgym.kernel import JIT
from bufgym.live import PolicyQueue, replay
from bufgym.live.log import Record
from bufgym.live.runs import Run, orders, table
from bufgym.live.shaped import ShapedLink
from bufgym.live.validate import play, validate
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, Uplink, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace

pytestmark = pytest.mark.skipif(not JIT, reason="uncompiled, decisions take as long as messages do")

V = qoi.exponential(0.618)
PERIOD_US, SIZE_BYTES = 33_333, 200_000


def fade(n: int = 150, fade_s: int = 3) -> Episode:
    """Video at 30 Hz over 4 MB/s, and from 1 s on for some time over a tenth of that."""
    seconds, megabytes = np.array([0, 1, 1 + fade_s, 2 + fade_s]), np.array([0, 4, 4 + 0.4 * fade_s, 8 + 0.4 * fade_s])
    trace = Trace("fade", seconds * 10**6, (megabytes * 10**6).astype(np.int64), "hold")
    return Episode(messages(np.arange(n) * PERIOD_US, SIZE_BYTES), Link(trace))


def live(episode: Episode, policy: str = "afr", capacity: int = 8, **settings: Any) -> list[Any]:
    return asyncio.run(
        asyncio.wait_for(play(policies.get(policy), episode, capacity, V, **{"speed": 2.0, **settings}), 60)
    )


@pytest.mark.parametrize("transport", OVER_TCP)
def test_on_sockets_as_in_the_simulator(transport: str, request: pytest.FixtureRequest) -> None:
    """Wide margins: on a quiet machine counts agree within 1 and QoI within 0.5 %."""
    records: list[Record] = []
    came = live(fade(), transport=transport, port=meeting_port(transport, request), log=records)
    simulated = outcome(run(policies.get("afr"), [fade()], 8, V), 0)
    assert [message.number for message in came] == list(range(len(came)))
    assert [message.seq for message in came] == sorted({message.seq for message in came})
    assert len(came) == pytest.approx(simulated.delivered, rel=0.15)
    assert V.information([message.x for message in came]) == pytest.approx(simulated.qoi, rel=0.08)
    # The log tells exactly what came, and the simulator makes the same of it.
    played = replay(records)
    assert played.differences == ()
    assert played.outcome.delivered == len(came)
    assert played.outcome.qoi == V.information([message.x for message in came])


def test_what_comes_too_late_is_not_awaited() -> None:
    """The link carries 10 kB in 0.1 s and then nothing: of two messages of 6 kB the second never comes."""
    link = Link(Trace.steps([(0.1, 100_000), (1.0, 0)], after="stop"))
    came = live(Episode(messages(np.array([0, 1000]), 6_000), link), until_s=0.5)
    assert [message.seq for message in came] == [0]


def test_what_the_systems_buffers_hide_is_lost() -> None:
    """With default buffers the system takes megabytes at once, which no policy can drop any more.

    For 5 s of a fade they come one after the other, seconds late: QoI of what has come when the stream ends.
    """
    episode = fade(200, fade_s=5)

    def in_time(**settings: Any) -> float:
        came = live(episode, "min-motion-gap", **settings)
        end_ns = came[0].received_ns + episode.arrivals["arrival_us"][-1] * 1000 // 2
        return V.information([message.x for message in came if message.received_ns <= end_ns])

    small, hidden = in_time(leaves="sent"), in_time(small=False, leaves="written")
    print("QoI in time, small and default buffers:", small, hidden)
    assert hidden < 0.9 * small


@pytest.mark.parametrize(("back", "carried_bytes"), [(True, 10**6), (False, 4)])
def test_a_link_whose_messages_come_back(back: bool, carried_bytes: int) -> None:
    """4 bytes go to who is called, 1 MB comes back. The link, of 2 MB/s, carries the one or the other."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(bytes(250_000) * len(await reader.readexactly(4)))
        await writer.drain()
        writer.close()

    async def fetch() -> tuple[float, int]:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        trace = Trace("even", np.array([0, 10**6]), np.array([0, 2 * 10**6]), "loop")
        link = ShapedLink(Link(trace), server.sockets[0].getsockname(), back=back)
        reader, writer = await asyncio.open_connection("127.0.0.1", await link.listen())
        began_s = time.monotonic()
        writer.write(b"send")
        await reader.readexactly(10**6)
        taken_s = time.monotonic() - began_s
        carried = link.carried_bytes
        writer.close()
        await writer.wait_closed()
        await link.close()
        server.close()
        await server.wait_closed()
        return taken_s, carried

    taken_s, carried = asyncio.run(fetch())
    assert carried == carried_bytes
    assert taken_s >= 0.45 * back


def test_nothing_is_compiled_while_the_episodes_time_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first decision of a process takes a second here: 2 s of the episode, which it must not cost."""

    class Compiling(PolicyQueue):
        compiled = False

        def put(self, *arguments: Any, **settings: Any) -> int:
            if not Compiling.compiled:
                time.sleep(1)
                Compiling.compiled = True
            return super().put(*arguments, **settings)

    monkeypatch.setattr("bufgym.live.validate.PolicyQueue", Compiling)
    came = live(fade(5))
    assert Compiling.compiled and came[0].at_us < 10**6


def test_a_window_of_several_messages() -> None:
    episode = fade(60)
    several = Episode(episode.arrivals, episode.link, window=3)
    records: list[Record] = []
    came = live(several, log=records)
    assert [message.number for message in came] == list(range(len(came)))
    assert replay(records).differences == ()


def test_validation_holds_both_side_by_side() -> None:
    scenario = Uplink(traces=(fade().link.trace,), duration_s=3.0, random_offset=False, propagation_us=0, value=V)
    chosen = [policies.get(name) for name in ("drop-oldest", "random")]
    runs = validate(chosen, scenario, 4, speed=3.0)
    assert [one.policy for one in runs] == ["drop-oldest", "random"]
    for one in runs:
        assert one.live_qoi == pytest.approx(one.simulated_qoi, rel=0.1)
        assert 0 <= one.simulated_regret < 1


def test_the_table_by_hand() -> None:
    runs = [
        Run("afr", "a", 0, 9, 10, 4.0, 5.0, 5.0, "tcp", (0.1, 0.2, 0.6), (0.1, 0.2)),
        Run("afr", "b", 0, 10, 10, 5.0, 5.0, 5.0, "tcp", (0.2, 0.4), (0.15,)),
    ]
    text = table(runs)
    assert "| afr | 9.5 | 10.0 | 4.500 | 5.000 | 10.00% | 0.00% | 0.250 | 0.150 |" in text
    assert "10.00% apart (median), 20.00% at most; delivered 0.5 and 1." in text


def test_orders_by_hand() -> None:
    """On link a the three differ by more than 1 % but for the last two, of which live one swaps with the first."""

    def one(policy: str, simulated: float, live: float, link: str = "a") -> Run:
        return Run(policy, link, 0, 1, 1, live, simulated, 9.0)

    runs = [one("afr", 5.0, 4.9), one("random", 4.0, 3.9), one("drop-oldest", 4.03, 4.95), one("afr", 1.0, 1.0, "b")]
    assert orders(runs) == (1, 2)
