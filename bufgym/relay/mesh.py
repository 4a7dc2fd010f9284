"""Relays that share topics over Zenoh, so that robots at one of them reach viewers at another.

A message published at one relay goes through a queue to all others, and from there to clients that *their* rules allow.
Each relay knows one other, hears of the rest from it, and connects to all. So a relay that dies cuts off only its own
clients.

A no_drop message is first offered to the other relays by a Zenoh query. Relays that have a receiver hold it on disk and
say so; only then does the sender's relay ack it. If a relay does not answer, the sender must reconnect and send the
message again. Relays that already hold it recognize its fingerprint, so it still arrives once.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import threading
from typing import Any, Final

from bufgym.ground.errors import BufgymError
from bufgym.relay import policies, wire
from bufgym.relay.config import DEFAULT_CAPACITY, Mesh, Rule
from bufgym.relay.hub import OWN, Frame, Hub
from bufgym.relay.patterns import pattern
from bufgym.relay.quota import RefusedError
from bufgym.relay.rules import Identity, Permissions
from bufgym.relay.store import Session
from bufgym.relay.subscriber import Subscription, next_lane
from bufgym.robot.extra import needs

ROOT: Final = "bufgym/relay"
ANSWER_S: Final = 3.0
"""Time for another relay to say whether it holds a message."""
PATIENCE_S: Final = 0.2
"""Time to wait for a busy relay; then its message is dropped so that it delays no other."""
_MAX_FRAME_BYTES: Final = 2**26
_MOST_HEARD: Final = 64
"""Messages received and not yet given to the queues; with more, Zenoh's thread waits."""
_SELF: Final = Identity(email="relay mesh")


class Others:
    """All other relays as one ``hub.Member``."""

    acks = False

    def __init__(self, hub: Hub, mesh: Mesh) -> None:
        self._hub, self._mesh = hub, mesh
        self.session = Session("mesh", _SELF, temporary=True)
        self.permissions = Permissions((Rule(email=_SELF.email, receive=True),), _SELF)
        self.subscriptions: dict[str, Subscription] = {}
        self.sent = 0
        self._awake = asyncio.Event()
        self._room = threading.Semaphore(_MOST_HEARD)
        self._zenoh: Any = None
        self._sending: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Listen, and connect to the known relays."""
        policy = await asyncio.to_thread(policies.warm, self._hub.config.policies[0])
        self.subscriptions = {"all": Subscription("all", pattern(""), policy, DEFAULT_CAPACITY)}
        self._loop = asyncio.get_running_loop()
        await asyncio.to_thread(self._open)
        self._hub.join(self)
        self._sending = asyncio.create_task(self._send_all())

    def _open(self) -> None:
        with needs("zenoh", "zenoh", "[mesh]"):
            import zenoh
        config, mesh = zenoh.Config(), self._mesh
        scheme = "tls" if mesh.certificate else "tcp"
        settings: dict[str, Any] = {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "listen/endpoints": [f"{scheme}/{mesh.listen}"],
            "connect/endpoints": [f"{scheme}/{each}" for each in mesh.connect],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {"period_init_ms": 200, "period_max_ms": 2_000, "period_increase_factor": 2},
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": round(PATIENCE_S * 1e6),
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": round(PATIENCE_S * 1e6),
        }
        if mesh.certificate:
            settings["transport/link/tls"] = {
                "root_ca_certificate": mesh.authority,
                "listen_certificate": mesh.certificate,
                "listen_private_key": mesh.key,
                "connect_certificate": mesh.certificate,
                "connect_private_key": mesh.key,
                "enable_mtls": True,
            }
        try:
            for key, setting in settings.items():
                config.insert_json5(key, json.dumps(setting))
            self._zenoh = zenoh.open(config)
            self._zenoh.declare_subscriber(f"{ROOT}/message", self._heard, allowed_origin=zenoh.Locality.REMOTE)
            self._zenoh.declare_queryable(f"{ROOT}/hold", self._queried, allowed_origin=zenoh.Locality.REMOTE)
        except zenoh.ZError as error:
            raise BufgymError(f"mesh: {mesh.listen}: {error}") from None

    async def close(self) -> None:
        """Leave the others."""
        if self._sending is not None:
            self._sending.cancel()
            self._hub.leave(self)
        self._room.release(1_000)  # wakes every waiting thread; a million would take a second
        if self._zenoh is not None:
            await asyncio.to_thread(self._zenoh.close)

    # --- ordinary messages --------------------------------------------------------------------------------------------

    def offer(self, subscription: Subscription, frame: Frame) -> None:
        """Offer a message of this relay."""
        topic = frame.message.topic
        if not frame.message.no_drop and not topic.startswith(f"/{OWN}/"):
            subscription.offer(topic, frame, frame.size_bytes)
            self._awake.set()

    async def _send_all(self) -> None:
        while True:
            await self._awake.wait()
            self._awake.clear()
            while (lane := next_lane(list(self.subscriptions.values()), self._hub.clock())) is not None:
                item = lane.take(self._hub.clock())
                if item is not None:
                    await asyncio.to_thread(self._zenoh.put, f"{ROOT}/message", item.message.binary, express=True)
                    self.sent += 1
                lane.gone()

    def _heard(self, sample: Any) -> None:
        """In a thread of Zenoh's."""
        self._room.acquire()
        self._soon(self._take, sample.payload.to_bytes())

    def _soon(self, call: Any, *arguments: Any) -> None:
        try:
            self._loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:  # the relay has ended
            self._room.release()

    def _take(self, data: bytes) -> None:
        self._room.release()
        try:
            message = wire.decode(data, _MAX_FRAME_BYTES)
            if not self._hub.is_no_drop(message.topic) and not message.topic.startswith(f"/{OWN}/"):
                self._hub.publish(self, message._replace(no_drop=False))
        except wire.WireError as error:
            self._hub.audit.repeated(what="mesh", code="wrong", why=str(error))

    # --- what may not be lost -----------------------------------------------------------------------------------------

    async def hold(self, sender: Session, message: wire.Message) -> int | None:
        """Ask the other relays to hold a message; return the number of receivers, or None if not all have answered.

        Raises RefusedError: a relay has no room, and no other holds it.
        """
        origin = json.dumps({"session": sender.name, "of": sender.identity.key}).encode()
        replies = await asyncio.to_thread(self._ask, wire.encode(message), origin)
        if any(reply.ok is None for reply in replies):
            return None
        answers = [json.loads(reply.ok.payload.to_bytes()) for reply in replies]
        held: int = sum(answer.get("held", 0) for answer in answers)
        refused = next((answer for answer in answers if "code" in answer), None)
        if refused is not None and not held:
            raise RefusedError(refused["code"], refused["why"])
        return held

    def _ask(self, frame: bytes, origin: bytes) -> list[Any]:
        import zenoh

        return list(
            self._zenoh.get(
                f"{ROOT}/hold",
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                payload=frame,
                attachment=origin,
                timeout=ANSWER_S,
                congestion_control=zenoh.CongestionControl.BLOCK,
                allowed_destination=zenoh.Locality.REMOTE,
            )
        )

    def _queried(self, query: Any) -> None:
        """In a thread of Zenoh's."""
        self._room.acquire()
        self._soon(self._answer, query)

    def _answer(self, query: Any) -> None:
        self._room.release()
        try:
            answer: dict[str, Any] = self._held(query.payload.to_bytes(), json.loads(query.attachment.to_bytes()))
        except RefusedError as refused:
            answer = {"held": 0} if refused.code == "no_receiver" else {"code": refused.code, "why": str(refused)}
        except (BufgymError, ValueError, KeyError, AttributeError) as error:
            answer = {"code": "wrong", "why": str(error)}
        query.reply(f"{ROOT}/hold", json.dumps(answer).encode())
        query.drop()  # that was all

    def _held(self, frame: bytes, origin: dict[str, str]) -> dict[str, int]:
        message = wire.decode(frame, _MAX_FRAME_BYTES)
        session = self._session(str(origin["session"]), str(origin["of"]))
        fingerprint = int.from_bytes(hashlib.blake2b(frame, digest_size=6).digest())
        if session.received == fingerprint:  # sent again because our answer was lost
            return {"held": 1}
        return {"held": self._hub.hold(self, message, taken=(session, fingerprint))}

    def _session(self, name: str, key: str) -> Session:
        """Find the session of a sender at another relay; ``received`` is the fingerprint of its last message."""
        store, identity = self._hub.store, Identity(email=f"{_SELF.email}: {key}")
        try:
            return store.open(name, identity, False, 0, 0)
        except RefusedError:
            old = [each for each in store.sessions.values() if each.identity.key == identity.key]
            self._hub.settled(store.forget(min(old, key=lambda each: each.seen_s)))
            return store.open(name, identity, False, 0, 0)

    # --- what a member has besides ------------------------------------------------------------------------------------

    def wake(self) -> None:
        """Do nothing; no message is held for it."""

    def tell(self, op: str, **fields: Any) -> None:
        """Do nothing; it is told nothing."""

    def end(self, why: str) -> None:
        """Do nothing; it ends with the relay."""
