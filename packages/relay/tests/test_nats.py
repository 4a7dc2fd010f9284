"""Relays whose NATS server is away, stands still, forgets, or does not let them in."""

import json
import signal
import sys
from pathlib import Path

import pytest
from nats_cases import alone, connected, nats_server, needs_server, shared, still
from refusal_cases import refuse
from relay_cases import client, nothing, relay, settings, until, untrusted, wait, within

from bufgym.utils.errors import BufgymError
from bufgym_relay import Nats, StoreLimits
from bufgym_relay.hub import Hub
from bufgym_relay.peers import Peers
from bufgym_robot.wire.clock import Delays
from bufgym_robot.wire.sockets import free_port

pytestmark = needs_server


@pytest.fixture(autouse=True)
def _hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Relays wait little for NATS."""
    for name in ("ANSWER_S", "ASK_S"):
        monkeypatch.setattr(f"bufgym_relay.bus.{name}", 0.5)
    monkeypatch.setattr("bufgym_robot.wire.backoff.MOST_S", 0.1)


async def test_relays_hear_each_other_again_after_nats_has_stood_still(tmp_path: Path) -> None:
    """A stopped server still holds its connections. The relays give them up, and find each other on new ones."""
    port = free_port("127.0.0.1")
    async with (
        nats_server(port, tmp_path) as server,
        shared(port, "a") as a,
        shared(port, "b") as b,
        client(a.port) as robot,
        client(b.port) as viewer,
    ):
        await viewer.subscribe("odom$")
        await still(server)
        await robot.put("/robots/a/odom", b"1")
        await alone(a, b)
        server.send_signal(signal.SIGCONT)
        await connected(a, b)
        async with within("a message over NATS"):
            seen: list[bytes] = []
            while b"2" not in seen:
                await robot.put("/robots/a/odom", b"2")
                seen += [bytes(each.payload) for each in await viewer.rest()]


async def test_a_relay_connects_again_whose_library_has_stopped_to_read(tmp_path: Path) -> None:
    """A header that is no text ends the reader of the library, which tells nobody."""
    port, broken = free_port("127.0.0.1"), b"NATS/1.0 \xff\xff\xff x\r\n\r\n"
    async with nats_server(port, tmp_path), shared(port, "a") as a, untrusted(port) as (_, bus):
        bus.write(b'CONNECT {"verbose": false, "headers": true}\r\n')
        bus.write(b"HPUB bufgym.relay.message %d %d\r\n%b\r\n" % (len(broken), len(broken), broken))
        await wait("NATS to have it", bus.drain())
        text = "'state': 'connected'"  # the log has it, also where the time between is too short to be seen
        await until("another connection", lambda: str(a.hub.audit.recent).count(text) == 2)


async def test_without_nats_a_relay_serves_its_own_robots_and_joins_when_it_comes(tmp_path: Path) -> None:
    """It says how it stands. A command for a robot elsewhere is refused, not held for nobody."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with shared(port, "a") as a, shared(port, "b") as b, client(a.port) as operator, client(a.port) as here:
        await here.subscribe("^/robots/a/")
        await here.subscribe("^/relay/status$", id="status")
        while b"nats" not in bytes((status := await here.next()).payload):
            pass
        assert f'"nats": "nats: nats://127.0.0.1:{port}: ' in bytes(status.payload).decode()
        assert a.hub.audit.recent[0]["event"] == "nats"
        await here.say("unsubscribe", id="status")
        await operator.acked(command, 1)
        await here.came(1)
        await operator.command(2, "/robots/b/command")
        refused = await operator.next()
        assert (refused["code"], refused["why"][-39:]) == ("no_receiver", ", and the other relays are out of reach")
        async with nats_server(port, tmp_path), client(b.port) as there:
            await connected(a, b)
            await there.subscribe("^/robots/b/")
            await operator.acked("/robots/b/command", 2)
            await there.came(1, payload=b"2")


def test_a_clock_that_is_set_back_makes_messages_late_for_two_minutes_at_most() -> None:
    delays = Delays()
    assert [delays.extra_s(delay_s, now_s) for now_s, delay_s in ((0, 5), (1, 4), (30, 4.5))] == [0, 0, 0.5]
    assert [delays.extra_s(14, now_s) for now_s in (40, 61, 122)] == [10, 10, 0]


async def test_commands_outlive_the_loss_of_the_stream(tmp_path: Path) -> None:
    """NATS comes back with nothing on its disk. Relay b is away meanwhile: a keeps b's place among the relays."""
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with shared(port, "a") as a, client(a.port) as operator:
        async with (
            nats_server(port, tmp_path / "1"),
            shared(port, "b", folder=tmp_path / "b") as b,
            client(b.port, session="robot") as one,
        ):
            await one.subscribe("^/robots/a/", durable=True)
            await until("a to know b", lambda: a.hub.peers._known == {"a", "b"})
        await alone(a)
        async with nats_server(port, tmp_path / "2"):
            await connected(a)
            await operator.acked(command, 1)
            async with shared(port, "b", folder=tmp_path / "b") as b, client(b.port, session="robot") as one:
                await one.came(1)


async def test_a_relay_that_is_gone_for_good_is_forgotten(tmp_path: Path) -> None:
    """Commands are kept for it no longer than for a session, here for four seconds; then there is room again."""
    port, command, limits = free_port("127.0.0.1"), "/robots/a/command", StoreLimits(keep_s=4.0, bytes=1_200)
    async with nats_server(port, tmp_path), shared(port, "a", store=limits) as a, client(a.port) as operator:
        async with shared(port, "b", store=limits):
            await until("a to know b", lambda: a.hub.peers._known == {"a", "b"})
        for seq in range(1, 5):
            await operator.put(command, bytes(300), seq=seq, no_drop=True)
            answer = await operator.next()
            if answer["op"] == "refused":
                break
        assert answer["code"] == "store_full" and seq in (2, 3)
        await until("a to forget b", lambda: a.hub.peers._known == {"a"})
        await operator.acked(command, seq)


async def test_a_command_whose_answer_was_lost_arrives_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NATS stands still: the sender's connection ends, unanswered. It comes again and sends the same again.

    While the relay has given NATS up, it does not refuse that command: NATS takes it later. Another's, which NATS was
    never asked to take, it refuses.
    """
    monkeypatch.setattr("bufgym_relay.bus.ASK_S", 60.0)  # nothing but the command finds out
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with (
        nats_server(port, tmp_path) as server,
        shared(port, "a") as a,
        shared(port, "b") as b,
        client(b.port) as one,
    ):
        await one.subscribe("^/robots/a/")
        async with client(a.port, session="operator") as operator:
            await still(server)
            await operator.command(1, command, stamp_us=1)
            with pytest.raises(Exception, match="NATS does not answer"):
                await operator.next()
        await alone(a)
        async with client(a.port, session="operator") as operator, client(a.port, session="another") as another:
            await operator.command(1, command, stamp_us=1)
            with pytest.raises(Exception, match="NATS does not answer"):
                await operator.next()
            await another.command(1, command, stamp_us=1)
            assert (await another.next())["code"] == "no_receiver"
        server.send_signal(signal.SIGCONT)
        await connected(a, b)
        async with client(a.port, session="operator") as operator:
            assert operator.welcome["received"] == 0
            await operator.acked(command, 1, stamp_us=1)
            await one.came(1)
            assert await nothing(one)


async def test_a_relay_that_ends_before_the_answer_does_not_refuse_what_nats_may_have(tmp_path: Path) -> None:
    """It starts alone, while NATS stands still; the client says which of its commands have no answer.

    Said again in time, the command waits for NATS; once its deadline is over, nobody knows whether it was executed: it
    was, since NATS had read it.
    """
    port, command = free_port("127.0.0.1"), "/robots/a/command"
    async with nats_server(port, tmp_path) as server, shared(port, "b") as b, client(b.port) as one:
        await one.subscribe("^/robots/a/")
        async with shared(port, "a") as a, client(a.port, session="operator") as operator:
            await still(server)
            await operator.command(1, command, stamp_us=1)
            with pytest.raises(Exception, match="NATS does not answer"):
                await operator.next()
        async with shared(port, "a") as a, client(a.port, session="other") as other:
            await other.command(1, command, stamp_us=1)
            assert (await other.next())["code"] == "no_receiver"
            async with client(a.port, session="operator", open=[1]) as operator:
                await operator.command(1, command, stamp_us=1)
                with pytest.raises(Exception, match="NATS does not answer"):
                    await operator.next()
            async with client(a.port, session="operator", open=[1]) as operator:
                await operator.command(1, command, stamp_us=1, until_us=1)
                why = (await operator.next())["why"]
                assert "after its deadline" in why and why.endswith("nobody knows whether it was executed")
                await operator.command(1, command, stamp_us=2)  # another one, of which all is known
                assert (await operator.next())["code"] == "no_receiver"
        server.send_signal(signal.SIGCONT)
        await one.came(1)


async def test_a_wrong_password_ends_the_start_at_once_and_is_not_told(tmp_path: Path) -> None:
    port = free_port("127.0.0.1")
    async with nats_server(port, tmp_path, "--user", "west", "--pass", "r#ght"):
        async with relay(settings(nats=Nats(f"nats://west:r%23ght@127.0.0.1:{port}", "a"))) as a:
            assert a.hub.status()["nats"] == "connected"
        with pytest.raises(BufgymError) as failed:
            async with relay(settings(nats=Nats(f"nats://west:wrong@127.0.0.1:{port}", "a"))):
                pass
        assert str(failed.value) == f"nats: nats://127.0.0.1:{port}: 'Authorization Violation'"


def test_credentials_are_looked_at_before_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library that signs with them may be missing, and so may they."""
    credentials = tmp_path / "west.creds"
    with_them = settings(nats=Nats("nats://127.0.0.1:1", "a", str(credentials)))
    monkeypatch.setitem(sys.modules, "nkeys", None)
    refuse(r"bufgym_relay needs nkeys: pip install ", Peers, Hub(with_them), with_them.nats)
    monkeypatch.setitem(sys.modules, "nkeys", object())
    refuse(r"west\.creds: no such file", Peers, Hub(with_them), with_them.nats)
    credentials.write_text("a password\n")
    with pytest.raises(BufgymError, match=r"west\.creds: no NATS credentials: must have -----BEGIN NATS USER JWT-----"):
        Peers(Hub(with_them), with_them.nats)
    with pytest.raises(BufgymError, match=r"url = 'nats://west\.example': must be nats://HOST:PORT") as failed:
        Nats("nats://west:p#ss@west.example", "a")
    assert "p#ss" not in str(failed.value)


async def test_two_robots_of_one_name_at_two_relays_are_told(tmp_path: Path) -> None:
    """The second one claims its name at its own relay; whoever watches at the first relay is told."""
    port = free_port("127.0.0.1")
    async with nats_server(port, tmp_path), shared(port, "a") as a, shared(port, "b") as b, client(a.port) as watch:
        await connected(a, b)
        await watch.subscribe("^/robots/r/claim$")
        async with client(a.port, session="one", robot="r") as one, client(b.port, session="two", robot="r"):
            await one.put("/robots/r/odom")
            said = json.loads(bytes((await watch.next()).payload))
    assert said["why"] == "two robots have this name: one at 127.0.0.1, at relay b"
