"""The relay's server: WebSockets and the page on one port, over the library ``websockets``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final, cast

from msgspec.structs import replace
from websockets.asyncio.server import Server as WebSocketServer
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import NegotiationError
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from bufgym.utils.errors import BufgymError
from bufgym_relay import connection, pages, policies, turns
from bufgym_relay.admission import Accepted, Admission
from bufgym_relay.caller import Caller
from bufgym_relay.config import POLICIES, Config
from bufgym_relay.connection import HELLO_BYTES, Connection
from bufgym_relay.faults import doubts
from bufgym_relay.hub import CONNECTED, STATUS, Hub
from bufgym_relay.identity import Verifier, check_file, renew, server_context
from bufgym_relay.robofleet import RobofleetConnection
from bufgym_relay.rules import Identity, Permissions
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.sockets import free_port
from bufgym_robot.wire.tasks import until_one_ends

if TYPE_CHECKING:
    from bufgym_relay.foxglove import Window

TICK_S: Final = 1.0  # Time between two ticks, which publish the relay's state and forget what has expired
OTHER_FILES: Final = 64  # Files that a relay may have open beside its connections
SWITCH_S: Final = 5e-4  # Time for which a thread that computes, as for a replay, may keep the event loop waiting
_QUIET: Final = logging.getLogger("bufgym.relay.websockets")
"""Silenced logger; clients' faults go to the audit log, not to tracebacks."""
_QUIET.setLevel(logging.CRITICAL + 1)


def _is_ours(request: Request | None) -> bool:
    """Whether the client speaks our protocol."""
    return request is not None and request.path.partition("?")[0] == wire.PATH


def _hosts(host: str) -> list[str]:
    """Give the addresses to listen at; ``localhost`` has two, if this machine has IPv6."""
    hosts = ["127.0.0.1"] if host == "localhost" else [host]
    with contextlib.suppress(OSError):
        if host == "localhost":
            socket.create_server(("::1", 0), family=socket.AF_INET6).close()
            hosts.append("::1")
    return hosts


class Server:
    """A relay.

    server = Server(config)
    port = await server.start()
    await server.close()
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.hub = Hub(config)
        self._admission = Admission(self.hub)
        self._verifier = None if config.tokens is None else Verifier(config.tokens)
        self._tls = None if config.tls is None else server_context(config.tls)
        self._server: WebSocketServer | None = None
        self._ticking: asyncio.Task[None] | None = None
        self.window: Window | None = None
        """Foxglove's server, if the configuration has one."""

    async def start(self) -> int:
        """Listen and return the port; policies are imported and compiled while robots reconnect."""
        limits, hosts = self.config.limits, _hosts(self.config.host)
        if self.config.nats is not None:
            from bufgym_relay.peers import Peers  # not at start-up: few need it

            self.hub.peers = peers = Peers(self.hub, self.config.nats)
            await peers.start()
        if self.config.foxglove is not None:
            from bufgym_relay.foxglove import Window  # not at start-up: few need it

            self.window = Window(self.config.foxglove, self.config)
            self.hub.own.append(self.window)
        try:
            self._server = await serve(
                self._serve,
                cast(str, hosts),  # asyncio takes several
                self.config.port or (free_port(hosts[0]) if len(hosts) > 1 else 0),
                select_subprotocol=self._subprotocol,
                process_request=self._request,
                create_connection=cast(type[Accepted], partial(Accepted, self._admission)),  # it is called, no more
                compression=None,  # pictures are compressed; and a small message may unpack to a large one
                max_size=HELLO_BYTES,
                max_queue=2,
                write_limit=(1, 0),  # a message has left when the system has all of it
                open_timeout=limits.hello_s,
                close_timeout=1.0,
                ping_interval=wire.PING_S,
                ping_timeout=wire.PONG_S,
                logger=_QUIET,
                server_header=None,
                ssl=self._tls,
                backlog=1_024,
            )
        except OSError as error:
            raise BufgymError(f"{self.config.host}:{self.config.port}: {error.strerror or error}") from None
        self._warming = asyncio.create_task(asyncio.to_thread(self._warm))
        self._ticking = asyncio.create_task(self._tick())
        self.hub.audit("started", host=self.config.host, port=self.port)
        return self.port

    @property
    def port(self) -> int:
        """Port on which it listens."""
        assert self._server is not None
        return int(next(iter(self._server.sockets)).getsockname()[1])

    def _warm(self) -> None:
        _check_policies(self.config)
        policies.warm(self.config.policies[0])

    async def warm(self) -> None:
        """Wait until the first policy is compiled.

        Raises BufgymError: the configuration names an unknown policy.
        """
        await asyncio.shield(self._warming)

    def reread(self, config: Config) -> list[str]:
        """Take the rules, the issuer's keys and the certificate of a configuration; return what else it changes.

        Connections go on; one ends if no rule is for it any more.

        Raises BufgymError: the certificate cannot be read; then nothing has changed.
        """
        if self._tls is not None and config.tls is not None:
            renew(self._tls, config.tls)
        if self.config.tokens is not None and config.tokens is not None:
            self._verifier = Verifier(config.tokens)
        kept = {"tls": config.tls, "tokens": config.tokens}
        taken = {name: new for name, new in kept.items() if new and getattr(self.config, name)}
        self.config = replace(self.config, rules=config.rules, **taken)
        self.hub.reruled(self.config)
        self.hub.audit("reread", rules=len(config.rules))
        same = (
            ("host", "port", "limits") if self.config.port == 0 else ("limits",)
        )  # ``_fitted`` may have changed these
        return [
            one
            for one in Config.__struct_fields__
            if one not in same and getattr(config, one) != getattr(self.config, one)
        ]

    async def close(self) -> None:
        """Close all connections; held messages stay on disk."""
        if self._ticking is not None:
            self._ticking.cancel()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
        if self.hub.peers is not None:
            await self.hub.peers.close()
        await self.hub.holding.end()
        self.hub.close()
        if self._server is not None:
            await asyncio.wait([self._warming])  # after the files: a first compilation takes long

    async def _serve(self, accepted: ServerConnection) -> None:
        assert isinstance(accepted, Accepted)
        ours = _is_ours(accepted.request)
        caller = Caller(self.hub, accepted, self._verifier, listens=ours)
        try:
            await connection.serve(Connection if ours else RobofleetConnection, caller, accepted.greeted)
        except Exception:
            with self.hub.outliving("connection"):
                raise
            await accepted.close(CloseCode.INTERNAL_ERROR)

    def _subprotocol(self, socket: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
        if not _is_ours(socket.request):
            return None
        if wire.SUBPROTOCOL not in offered:
            raise NegotiationError(f"must offer the subprotocol {wire.SUBPROTOCOL}")
        return Subprotocol(wire.SUBPROTOCOL)

    def _request(self, socket: ServerConnection, request: Request) -> Response | None:
        """Deny a request, answer it with a page, or let it become a WebSocket."""
        assert isinstance(socket, Accepted)
        refused = self._admission.refusal(socket.address, request)
        if refused is not None:
            socket.refused(refused.code, refused)
            return pages.response(HTTPStatus.FORBIDDEN, f"{refused}\n")
        if _is_ours(request) or (self.config.robofleet and "Upgrade" in request.headers):
            return None
        match request.path.partition("?")[0]:
            case "/healthz":
                stuck = self._ticking is None or self._ticking.done()
                if ills := ["stuck"] * stuck + self.hub.ills:
                    return pages.response(HTTPStatus.SERVICE_UNAVAILABLE, f"{', '.join(ills)}\n")
                return pages.response(HTTPStatus.OK, "ok\n")
            case "/metrics":
                return self._metrics(socket.address)
            case "/sign-in.json":
                return pages.response(HTTPStatus.OK, self._sign_in(), "application/json")
        tokens = self.config.tokens
        return pages.answer(request.path, request.headers, origins=tokens.origins if tokens else ())

    def _sign_in(self) -> str:
        """What the page must know to sign somebody in; nothing if it asks for a token."""
        tokens = self.config.tokens
        if tokens is None or not tokens.client:
            return "{}"
        return json.dumps({"issuer": tokens.issuer, "client": tokens.client, "scope": tokens.scope})

    def _metrics(self, address: str) -> Response:
        if not Permissions(self.config.rules, Identity(address)).allow("receive", STATUS):
            return pages.response(HTTPStatus.FORBIDDEN, f"no rule lets this address receive {STATUS}\n")
        from bufgym_relay import metrics  # not at start-up: few need it

        counts = metrics.text(self.hub.status(), self.hub.audit.refusals)
        return pages.response(HTTPStatus.OK, counts, metrics.CONTENT_TYPE)

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            with self.hub.outliving("tick"):
                began_s = turns.clock()
                self.hub.tick()
                self.hub.turns.note("tick", began_s)
                self._admission.incoming.end_late()


def _fitted(config: Config, say: Any) -> Config:
    """Let this process open as many files as it may, and take no more connections than that."""
    with contextlib.suppress(ImportError, ValueError):  # Windows has none, macOS allows less than it says
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        limits = config.limits
        if most != resource.RLIM_INFINITY and most < limits.all_connections + OTHER_FILES:
            fewer = max(1, most - OTHER_FILES)
            say(f"limits: all_connections is {fewer}, not {limits.all_connections}: ulimit -Hn is {most} open files")
            return replace(config, limits=replace(limits, all_connections=fewer))
    return config


def _check_policies(config: Config) -> None:
    """Raise a BufgymError for a name of ``policies`` that none has."""
    for name in config.policies:
        if name not in POLICIES:
            policies.policy(name)


def check(config: Config) -> None:
    """Raise a BufgymError for an unknown policy, and for files of ``[tls]`` and ``[tokens]`` that cannot be read."""
    _check_policies(config)
    if config.tls is not None:
        server_context(config.tls)
    if config.tokens is not None and "://" not in config.tokens.keys:
        check_file("tokens", "keys", config.tokens.keys)


async def serve_forever(config: Config, say: Any = print, load: Callable[[], Config] | None = None) -> None:
    """Run a relay until cancelled, or until the process gets SIGTERM; at SIGHUP it rereads what ``load`` gives."""
    sys.setswitchinterval(SWITCH_S)
    server = Server(_fitted(config, say))
    port = await server.start()
    scheme = "http" if config.tls is None else "https"
    say(f"{scheme}://{config.host}:{port}/ is the page, {wire.PATH} for robots; Ctrl-C ends it")
    if config.folder is None:
        say("no folder: what is held, and stops of robots that are away, end with the relay")
    for doubt in doubts(config):
        say(doubt)
    if server.hub.peers is not None and server.hub.peers.state != CONNECTED:
        say(f"{server.hub.peers.state}; goes on without the other relays until NATS is there")
    if server.window is not None:
        say(f"ws://{server.window.address}: Foxglove, Lichtblick")
    asked_to_end = asyncio.Event()

    def reread() -> None:
        try:
            others = server.reread(config if load is None else load())
        except BufgymError as error:
            say(f"not reread, all stays as it was: {error}")
        else:
            more = f"; a restart is needed for: {', '.join(others)}" if others else ""
            say(f"reread: {len(server.config.rules)} rules, keys and certificate{more}")
            for doubt in doubts(server.config):
                say(doubt)

    with contextlib.suppress(
        AttributeError, NotImplementedError, RuntimeError, ValueError
    ):  # Windows; a thread other than the main one
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, asked_to_end.set)
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, reread)

    async def works() -> None:
        await server.warm()
        await asked_to_end.wait()

    try:
        await until_one_ends(works(), asked_to_end.wait())
    finally:
        await server.close()
