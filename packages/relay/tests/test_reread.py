"""A relay that runs on: SIGHUP rereads rules, keys and certificate; methods that are not GET are named."""

import signal
import ssl
from pathlib import Path

import pytest
from needs import needs
from relay_cases import ALL, client, nothing, process, relay, settings, until, untrusted, wait
from test_identity import HERE, Authority

from bufgym.utils.errors import BufgymError
from bufgym_relay.config import Rule, Tls
from bufgym_relay.rules import Identity, Permissions
from bufgym_robot.wire.sockets import free_port


async def test_new_rules_hold_for_who_is_here() -> None:
    """Ann may watch a only from now on, and Bob nothing: his connection ends, hers and the robot's go on."""
    before = tuple(Rule(address=f"127.2.0.{k}", send=True, receive=True) for k in (1, 2, 3))
    after = before[0], Rule(address="127.2.0.2", receive=True, topic="/robots/a/.*")
    async with (
        relay(settings(rules=before)) as server,
        client(server.port, "127.2.0.1", name="robot") as robot,
        client(server.port, "127.2.0.2", name="ann") as ann,
        client(server.port, "127.2.0.3", name="bob") as bob,
    ):
        for one in (ann, bob):
            await one.subscribe("^/robots/")
        await robot.put("/robots/b/status")
        assert (await ann.next()).topic == (await bob.next()).topic == "/robots/b/status"
        assert server.reread(settings(rules=after, latched=("/x",))) == ["latched"]
        await robot.put("/robots/b/status")
        await robot.put("/robots/a/status")
        assert (await ann.next()).topic == "/robots/a/status"
        await wait("bob's end", bob.socket.wait_closed())
        assert bob.socket.close_reason == "no rule allows anything to this identity any more"
        await ann.put("/robots/a/status")
        assert (await ann.next())["code"] == "unauthorized" and await nothing(robot)
        assert len(server.hub.members) == 2


async def test_a_renewed_certificate_serves_the_next_connection(tmp_path: Path) -> None:
    """The connection from before goes on. A file that is no certificate changes nothing."""
    old, new = Authority(tmp_path, "old"), Authority(tmp_path, "new")

    def trusts(authority: Authority) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=str(authority.file))

    certificate, key = old.issue("server", HERE)
    config = settings(rules=(ALL,), tls=Tls(certificate, key))
    async with relay(config) as server, client(server.port, tls=trusts(old), name="ann") as ann:
        new.issue("server", HERE)  # in the same two files
        server.reread(config)
        async with client(server.port, tls=trusts(new), name="bob") as bob:
            await bob.subscribe("^/a$")
            await ann.put("/a")
            assert (await bob.next()).topic == "/a"
        with pytest.raises(ssl.SSLError):
            async with client(server.port, tls=trusts(old)):
                pass
        Path(certificate).write_text("no certificate")
        with pytest.raises(BufgymError, match=r"tls: .*server\.pem"):
            server.reread(config)
        async with client(server.port, tls=trusts(new), name="eve") as eve:
            assert eve.welcome["name"] == "eve"


async def test_sighup_rereads_the_file(tmp_path: Path) -> None:
    if not hasattr(signal, "SIGHUP"):
        pytest.skip(needs("system", "SIGHUP"))
    port = free_port("127.0.0.1")
    async with process(port, tmp_path) as one, client(port, name="ann") as ann:
        config = tmp_path / "relay.toml"
        text = config.read_text()
        for written, said in (
            (text.replace("send = true\n", ""), b"reread: 1 rules, keys and certificate\n"),
            (text + "no TOML", b"not reread, all stays as it was: "),
        ):
            config.write_text(written)
            one.send_signal(signal.SIGHUP)
            line = b""
            while b"reread" not in line:
                line = await wait("an answer", one.stdout.readline())
            assert line.startswith(said)
        await ann.put("/a")
        assert (await ann.next())["code"] == "unauthorized"


@pytest.mark.parametrize("method", ["HEAD", "POST", "TRACE"])
async def test_only_get_is_answered(method: str) -> None:
    async with relay(settings()) as server, untrusted(server.port) as (reader, writer):
        writer.write(f"{method} / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 3\r\n\r\nabc".encode())
        answer = await wait("the answer", reader.read())
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 405 ") and b"Allow: GET" in head
        assert body == (b"" if method == "HEAD" else b"only GET\n")
        await until("the log", lambda: any(method in str(one.get("why")) for one in server.hub.audit.recent))


def test_emails_fold_ascii_alone() -> None:
    """The sign of Kelvin is no k, though ``lower`` says so; nor is a dotted I an i."""
    rules = [Rule(email="Nick@X.org", send=True)]
    for email, means in (("nick@x.ORG", True), ("nic\u212a@x.org", False), ("n\u0130ck@x.org", False)):
        assert bool(Permissions(rules, Identity("10.0.0.1", email)).rules) is means
    assert Identity(email="NICK@x.org").key == "<nick@x.org>" != Identity(email="nic\u212a@x.org").key
