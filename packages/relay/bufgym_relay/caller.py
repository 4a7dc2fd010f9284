"""The other end of a WebSocket: its identity as far as it has proved it, and the answers that it is to be sent."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Final

from websockets.exceptions import WebSocketException

from bufgym.utils.errors import BufgymError
from bufgym_relay.admission import POLICY_VIOLATION, Accepted
from bufgym_relay.hub import Hub
from bufgym_relay.identity import Verifier, certificate_email
from bufgym_relay.rules import Identity, plain_address
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import RefusedError

_FRAME_BYTES: Final = 500  # bytes of JSON whose parsing takes as long as all else that is done for a frame
_PACE_S: Final = 0.05
PIECE: Final = 2**16  # Characters of a frame; a longer answer goes in several, each of them once its client has room


class Caller:
    """Whoever has connected, before its hello and after."""

    def __init__(self, hub: Hub, socket: Accepted, verifier: Verifier | None, *, listens: bool = True) -> None:
        """With ``listens`` False it is told nothing, because it would not understand."""
        self.hub, self.socket = hub, socket
        self.identity = Identity(plain_address(socket.remote_address[0]))
        self.answers: deque[str] = deque()
        self.subscriptions: dict[str, Subscription] = {}
        self._verifier, self._listens = verifier, listens
        self.on_answer: Callable[[], None] = lambda: None  # called with each answer to come

    async def prove(self, token: str | None) -> Identity:
        """Learn who it is: by token, certificate, or address alone."""
        tls = self.socket.transport.get_extra_info("ssl_object")
        email, until_s = certificate_email(tls.getpeercert()) if tls is not None else "", float("inf")
        if token is not None:
            if self._verifier is None:
                raise RefusedError("unauthorized", "token: this relay takes none")
            email, until_s = await self._verifier.email(token)
        self.identity = Identity(self.identity.address, email, until_s=until_s)
        self.socket.is_of(self.identity)
        return self.identity

    async def heard(self) -> bytes | str:
        """Receive a frame; a text frame is kept back until its identity may have it parsed."""
        data: bytes | str = await self.socket.recv()
        if isinstance(data, str):
            await self.pace(len(data) + _FRAME_BYTES)
        return data

    async def pace(self, json_bytes: int) -> None:
        """Wait until the budgets of the identity and of its address allow to parse so much JSON."""
        loop = asyncio.get_running_loop()
        for whose in (self.identity.key, f"@{self.identity.address}"):
            while not self.hub.quotas.of(whose).json.take(json_bytes, loop.time()):
                await asyncio.sleep(_PACE_S)
                if self.socket.ended:
                    raise RefusedError("too_many", "the connection has ended")

    def tell(self, op: str, **fields: Any) -> None:
        """Have this sent before any message."""
        if self._listens:
            self.say(wire.say(op, **fields))

    def say(self, text: str) -> None:
        """Have this text frame sent before any message."""
        self.answers.append(text)
        self.on_answer()

    def refuse(self, what: str, error: BufgymError, **fields: Any) -> None:
        """Tell it of a refusal and the reason. Refusals of messages are audited elsewhere."""
        code = error.code if isinstance(error, RefusedError) else "wrong"
        if what != "publish":
            self.hub.audit.repeated(what=what, code=code, why=str(error), **self.identity.as_json())
        self.tell("refused", what=what, code=code, why=str(error), **fields)

    async def send_answers(self) -> None:
        """Send all answers."""
        while self.answers:
            text = self.answers.popleft()
            await self.socket.send(text if len(text) <= PIECE else _pieces(text))

    async def close(self, why: str) -> None:
        """Send the last answers, and close."""
        try:
            async with asyncio.timeout(1.0):
                await self.send_answers()
                await self.socket.close(POLICY_VIOLATION, why)
        except (WebSocketException, TimeoutError):
            self.socket.transport.abort()


async def _pieces(text: str) -> AsyncIterator[str]:
    """Yield an answer bit by bit; all others have a turn between two pieces."""
    for begin in range(0, len(text), PIECE):
        yield text[begin : begin + PIECE]
        await asyncio.sleep(0)
