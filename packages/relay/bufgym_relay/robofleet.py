"""Robofleet's own protocol for its released clients, robofleet_client and robofleet_webviz of ut-amrl on GitHub.

Each binary frame is one flatbuffer. By its schema, msg2fbs/schema.fbs in ut-amrl/robofleet, every message's table
begins with ``__metadata``, a table of ``type`` and ``topic``. The rest is the message, which the relay passes on
unchanged. A message of type ``amrl_msgs/RobofleetSubscription`` is a request to the relay: ``action`` 1 subscribes to
``topic_regex`` and 0 unsubscribes. Text frames are JSON, and ``{"id_token": ...}`` gives the identity. There is no
hello and no ack.
"""

import json
import secrets
import struct
from functools import partial
from typing import Any, Final, NamedTuple

from bufgym_relay import protocol
from bufgym_relay.caller import Caller
from bufgym_relay.config import SKIP_PENDING
from bufgym_relay.connection import Connection
from bufgym_relay.outgoing import ROBOFLEET, Outgoing
from bufgym_relay.protocol import Admitted
from bufgym_relay.rules import Permissions
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import WireError

SUBSCRIPTION_TYPES: Final = ("amrl_msgs/RobofleetSubscription", "RobofleetSubscription")
_FIRST: Final = 4  # offset of a table's field 0 in its vtable; each further field is 2 bytes on


class Flat(NamedTuple):
    """Fields of a flatbuffer that the relay reads."""

    type: str
    topic: str
    pattern: str = ""  # pattern of a subscription
    subscribe: bool = False


def read(data: bytes) -> Flat:
    """Read a message's metadata and a subscription's request.

    Raises WireError: it is not one of Robofleet's messages.
    """
    from flatbuffers.number_types import Uint8Flags, UOffsetTFlags
    from flatbuffers.table import Table

    def text(table: Any, field: int) -> str:
        offset = table.Offset(_FIRST + 2 * field)
        return str(table.String(offset + table.Pos).decode()) if offset else ""

    try:
        table = Table(data, int(UOffsetTFlags.packer_type.unpack_from(data)[0]))
        offset = table.Offset(_FIRST)
        if not offset:
            raise WireError("flatbuffer: has no metadata")
        metadata = Table(data, table.Indirect(offset + table.Pos))
        flat = Flat(text(metadata, 0), text(metadata, 1))
        if flat.type in SUBSCRIPTION_TYPES:
            action = table.Offset(_FIRST + 4)
            subscribes = bool(action and table.Get(Uint8Flags, action + table.Pos) == 1)
            flat = flat._replace(pattern=text(table, 1), subscribe=subscribes)
    except (struct.error, IndexError, TypeError, ValueError, OverflowError) as error:
        raise error if isinstance(error, WireError) else WireError(f"flatbuffer: {error}") from None
    topic = flat.topic if flat.topic.startswith("/") else f"/{flat.topic}"
    wire.check_topic(topic)
    wire.check_name("type", flat.type)
    return flat._replace(topic=topic)


def token(text: str) -> str | None:
    """The token that a text frame names, if it names one."""
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        raise WireError("text: must be JSON") from None
    found = said.get("id_token") if isinstance(said, dict) else None
    return found if isinstance(found, str) else None


class RobofleetConnection(Connection):
    """Connection of a client that Robofleet released."""

    acks = False
    own_policies = (SKIP_PENDING,)

    @staticmethod
    async def greet(caller: Caller) -> Admitted:
        """Admit the client by its address or certificate, or once it has sent its token; it sends no hello."""
        identity, rules = await caller.prove(None), caller.hub.config.rules
        while not Permissions(rules, identity).rules:
            data = await caller.heard()
            if isinstance(data, str) and (proof := token(data)) is not None:
                identity = await caller.prove(proof)
        return protocol.admit({"form": ROBOFLEET}, identity, rules, secrets.token_hex(8))

    async def _read(self) -> None:
        while self._ending is None:
            data = await self._caller.heard()
            if isinstance(data, str):
                before, proof = self._caller.identity, token(data)
                if proof is not None and (await self._caller.prove(proof)).key != before.key:
                    raise WireError("id_token: must be said first; connect again to be somebody else")
                continue
            flat = read(data)
            if flat.type in SUBSCRIPTION_TYPES:
                await self._ordered(flat)
                continue
            message = wire.Message(flat.topic, data, ROBOFLEET, flat.type)
            if self._hub.is_no_drop(flat.topic):
                message = message._replace(no_drop=True)
                await self._later(partial(self._publish, message), message)
            else:
                await self._publish(message)

    async def _publish(self, message: wire.Message) -> None:
        """Publish it; the client numbers no messages."""
        await super()._publish(message._replace(seq=self.session.received + 1) if message.no_drop else message)

    async def _ordered(self, flat: Flat) -> None:
        """Subscribe or unsubscribe; as at Robofleet's server, a client with bytes pending is skipped."""
        if not flat.subscribe:
            self._hub.unsubscribe(self, flat.pattern)
        else:
            await self._subscribe({"id": flat.pattern, "topic": flat.pattern, "policy": SKIP_PENDING})

    def offer(self, subscription: Subscription, outgoing: Outgoing) -> None:
        """Offer a message if it is a flatbuffer, the only encoding that the client reads."""
        if outgoing.message.encoding == ROBOFLEET:
            super().offer(subscription, outgoing)
