"""One connection to NATS, and the JetStream stream in which relays give each other no_drop messages.

A connection that does not answer is given up for a new one. The library ``nats`` does not survive some of its own
faults: an answer that comes after its time ends the library's reader, without a word.
"""

import asyncio
import contextlib
import ssl
from collections import deque
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from bufgym.utils.errors import BufgymError
from bufgym.utils.files import read_utf8
from bufgym.utils.libraries import needs
from bufgym_relay.config import Nats, StoreLimits
from bufgym_robot.wire.messages import RefusedError

MESSAGE: Final = "bufgym.relay.message"
HOLD: Final = "bufgym.relay.hold"
TOLD: Final = "bufgym.relay.told"  # Subject of what relays say to each other: their stops, and how commands ended
NAME: Final = "bufgym.relay.name"  # Subject under which a relay answers for its name
STREAM: Final = "bufgym-relay"
ANSWER_S: Final = 3.0  # Time for the server to answer
ASK_S: Final = 5.0  # Time between two questions whether the server still knows this relay
TRIES: Final = 30  # Times that a message is tried for which this relay has no room, once a second
AHEAD_BYTES: Final = 2**18  # Most bytes on their way to the server of which it has not said that it has them
MANY: Final = 256  # Messages that are taken at a time before all are taken again
_SAME_NAME_S: Final = 1.0  # time for another relay of this name to answer
_BACKLOG_S: Final = 30.0  # time for what the server holds for this relay to come
_TAKE_S: Final = 10.0  # time after which a message is given again that was neither taken nor put back
_HEADER_BYTES: Final = 256
_CREDENTIALS: Final = ("-----BEGIN NATS USER JWT-----", "-----BEGIN USER NKEY SEED-----")


def options(settings: Nats) -> dict[str, Any]:
    """Give the library's options for a connection.

    Raises BufgymError: a file or a library is missing, or holds something else.
    """
    url, file = urlsplit(settings.url), settings.credentials
    found: dict[str, Any] = {"allow_reconnect": False, "max_reconnect_attempts": 1, "reconnect_time_wait": 0}
    found |= {"name": settings.name, "no_echo": True, "connect_timeout": ANSWER_S}
    names = ("user", "password") if url.password is not None else ("token",)
    found |= {name: unquote(value) for name, value in zip(names, (url.username, url.password), strict=False) if value}
    if file:
        with needs("nkeys", "bufgym-relay[mesh]", "bufgym_relay"):
            import_module("nkeys")
        text = read_utf8(file, 2**16)
        if not all(f"{line}\n" in text for line in _CREDENTIALS):  # the library would look for them for ever
            raise BufgymError(f"{file}: no NATS credentials: must have {' and '.join(_CREDENTIALS)}")
        found["user_credentials"] = file
    if url.scheme == "tls":
        try:
            found["tls"] = ssl.create_default_context(cafile=settings.authority or None)
        except OSError as error:
            raise BufgymError(f"{settings.authority}: no certificate: {error.strerror or error}") from None
    return found


class Bus:
    """One connection to a NATS server, from its beginning to its first fault."""

    def __init__(self, settings: Nats, limits: StoreLimits, note: Callable[[str], None], most: int) -> None:
        """``note`` is told of faults that leave the connection as it is; ``most`` as the last connection left it."""
        with needs("nats", "bufgym-relay[mesh]", "bufgym_relay"):
            import nats.aio.client
        self._library: Any = nats
        self._client: Any = nats.aio.client.Client()
        self._settings, self._limits, self._note = settings, limits, note
        self._open = False
        self._last: Exception | None = None
        self._doubted = asyncio.Event()
        self._ahead: deque[tuple[asyncio.Task[None], int]] = deque()
        self._ahead_bytes = 0
        self._turn, self._late, self._left = asyncio.Event(), False, 0
        self.most = most
        """Messages of other relays that are taken at a time, 0 for all."""

    async def open(
        self, given: dict[str, Any], heard: Callable[[Any], bool], told: Callable[[bytes], None], known: set[str]
    ) -> None:
        """Connect, and take this relay's place in the stream; other ``known`` relays keep theirs.

        ``heard`` is called with each message of another relay, and says whether it is late; ``told`` with what another
        relay says of itself.

        Raises BufgymError: NATS does not let this relay in, or another relay has its name. Any other error may pass.
        """
        async with asyncio.timeout(ANSWER_S + _SAME_NAME_S):
            await self._client.connect(self._settings.place, error_cb=self._wrong, **given)
            await self._take_name()
            # The name before the place: two relays of one name would take each other's messages from one place.
            self._stream = self._client.jetstream(timeout=ANSWER_S)
            await self._take_place(known)
            # The place before all else: NATS forgets a no_drop message that no place waits for.
            self._heard = heard
            self._messages = await self._subscribe()

            async def take(said: Any) -> None:
                told(said.data)

            await self._client.subscribe(TOLD, cb=take)
            await self._client.flush(ANSWER_S)  # from here on the server sends what others publish
        self._open = True

    async def _subscribe(self) -> Any:
        """Have the server send the next messages of other relays."""
        self._late, self._left = False, self.most

        async def take(message: Any) -> None:
            self._late |= self._heard(message)
            self._left -= 1
            if self._late or self._left == 0:
                self._turn.set()

        messages = await self._client.subscribe(MESSAGE, cb=take)
        if self.most:
            # The subscription's own limit would lose all but the first of messages that come together.
            await self._client._send_unsubscribe(messages._id, self.most)
        return messages

    async def take_turns(self) -> None:
        """While messages come late, take only as many at a time as come in time, twice as many each time.

        Otherwise the server would hold ever more for a relay behind a slow link, and slow down all who publish.
        """
        while True:
            await self._turn.wait()
            self._turn.clear()
            if self._late:
                self.most = max(1, (self.most or MANY) // 2)
            else:
                self.most = 2 * self.most if 2 * self.most <= MANY else 0
            # The flush lets all that was sent to the old subscription come before the new one begins to count.
            await self._messages.unsubscribe()
            await self._client.flush(_BACKLOG_S)
            self._messages = await self._subscribe()

    async def _take_name(self) -> None:
        """Make sure that no other relay has this relay's name."""

        async def here(asked: Any) -> None:
            await asked.respond(b"")

        subject = f"{NAME}.{self._settings.name}"
        # Before it asks: of two that start at once each hears the other. no_echo: its own question it does not hear.
        await self._client.subscribe(subject, cb=here)
        with contextlib.suppress(self._library.errors.NoRespondersError, TimeoutError):
            await self._client.request(subject, timeout=_SAME_NAME_S)
            raise BufgymError(f"nats: name = {self._settings.name!r}: another relay has it; each needs its own")

    async def _take_place(self, known: set[str]) -> None:
        """Make the stream of no_drop messages unless it is there, and the relays' places in it."""
        errors, keep_s = self._library.js.errors, self._limits.keep_s
        try:
            await self._stream.stream_info(STREAM)
        except errors.ServiceUnavailableError:
            raise ConnectionError("no JetStream, which nats-server -js has") from None
        except errors.NotFoundError:
            kind = {"subjects": [HOLD], "retention": "interest", "discard": "new"}
            await self._stream.add_stream(name=STREAM, max_age=keep_s, max_bytes=self._limits.bytes, **kind)
        one_by_one = {"filter_subject": HOLD, "deliver_policy": "new", "max_ack_pending": 1}
        limits = {"max_deliver": TRIES, "ack_wait": _TAKE_S, "inactive_threshold": keep_s}
        for name in {self._settings.name, *known}:
            await self._stream.add_consumer(STREAM, name=name, durable_name=name, **one_by_one, **limits)
        self._place = await self._stream.pull_subscribe_bind(durable=self._settings.name, stream=STREAM)

    async def _wrong(self, error: Exception) -> None:
        self._last = error
        if self._open:
            self._note(_why(error))

    def fault(self, error: Exception) -> Exception:
        """Say why the connection could not be made or has ended: a BufgymError if it needs a person."""
        errors = self._library.errors
        if isinstance(error, BufgymError):
            return error
        if isinstance(error, errors.NoServersError | TimeoutError) and self._last is not None:
            error = self._last
        why = _why(error)
        passing = isinstance(error, OSError | TimeoutError) and not isinstance(error, ssl.SSLError)
        passing |= isinstance(error, errors.Error) and "auth" not in why.lower()
        return (ConnectionError if passing else BufgymError)(f"nats: {self._settings.place}: {why}")

    async def close(self) -> None:
        """End the connection; a server that takes nothing does not hold it up."""
        self._open = False
        for task, _ in self._ahead:
            task.cancel()
        with contextlib.suppress(Exception):
            async with asyncio.timeout(ANSWER_S):
                await self._client.close()

    async def publish(self, topic: str, frame: bytes, headers: dict[str, str]) -> None:
        """Send a message, and wait until the server has all but the last ``AHEAD_BYTES``.

        Raises RefusedError: it is too large. At any other error, as if the server takes it too late, the connection
        must be given up.
        """
        self._check_size(topic, frame)
        await self._client.publish(MESSAGE, frame, headers=headers)
        taken = asyncio.create_task(self._client.flush(ANSWER_S))
        taken.add_done_callback(lambda task: task.cancelled() or task.exception())  # this is asked for later, or never
        self._ahead.append((taken, len(frame)))
        self._ahead_bytes += len(frame)
        while self._ahead and (self._ahead_bytes > AHEAD_BYTES or self._ahead[0][0].done()):
            await self._ahead[0][0]
            self._ahead_bytes -= self._ahead.popleft()[1]

    async def tell(self, said: bytes) -> None:
        """Say something to all other relays."""
        await self._client.publish(TOLD, said)

    def _check_size(self, topic: str, frame: bytes) -> None:
        most = self._client.max_payload - _HEADER_BYTES
        if len(frame) > most:
            raise RefusedError("too_large", f"topic {topic}: {len(frame)} bytes: must be at most {most} for NATS")

    async def hold(self, topic: str, frame: bytes, headers: dict[str, str]) -> bool:
        """Put a no_drop message into the stream; return whether the server has it, False if it does not answer.

        Raises RefusedError: the server does not take it.
        """
        self._check_size(topic, frame)
        try:
            await self._stream.publish(HOLD, frame, headers=headers)
        except self._library.js.errors.APIError as error:
            raise RefusedError("store_full", f"topic {topic}: NATS does not take it: {error.description}") from None
        except (TimeoutError, self._library.errors.Error) as error:
            self._note(_why(error))
            self._doubted.set()
            return False
        return True

    async def next(self) -> Any:
        """Wait for the next no_drop message in the stream, of this relay or another."""
        while True:
            with contextlib.suppress(TimeoutError):  # there was none
                return (await self._place.fetch(1, timeout=ASK_S))[0]

    async def watch(self, known: set[str]) -> None:
        """Keep ``known`` up to date; raise an error as soon as the server does not answer or has lost this relay."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ASK_S):
                    await self._doubted.wait()
            self._doubted.clear()
            names = {place.name for place in await self._stream.consumers_info(STREAM)}
            if self._settings.name not in names:
                raise ConnectionError("the server has lost this relay's place among the others")
            known.clear()
            known.update(names)


def _why(error: Exception) -> str:
    return str(error).removeprefix("nats: ") or f"no answer ({type(error).__name__})"
