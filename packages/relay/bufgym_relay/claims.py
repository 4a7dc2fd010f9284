"""Which session is which robot: a robot's connection claims its name, and commands wait for that session alone."""

import json
import math
from collections.abc import Callable
from typing import Final

from bufgym_relay.audit import Audit
from bufgym_relay.rules import Identity, Permissions
from bufgym_relay.store import Store
from bufgym_relay.stored import StoredSession
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import RefusedError

SILENT_S: Final = 3.0
"""Silence of a robot after which another connection may be it; a robot says something five times a second."""
_MOST: Final = 10_000
CLAIM: Final = "claim"


class Claims:
    """Robots' names; ``publish`` is called with each warning that two have claimed one."""

    def __init__(
        self,
        store: Store,
        audit: Audit,
        publish: Callable[[wire.Message], None],
        clock: Callable[[], float],
        now_us: Callable[[], int],
    ) -> None:
        self._store = store
        self._audit, self._publish, self._clock, self._now_us = audit, publish, clock, now_us
        self.told: Callable[[str, str], None] = lambda robot, address: None
        """Called with each robot that is here anew, and its address, for other relays."""
        self._sessions = {session.robot: session for session in store.sessions.values() if session.robot}

    def get(self, robot: str) -> StoredSession | None:
        """The session that is this robot, here or away; None if nobody has claimed it."""
        return self._sessions.get(robot)

    def rival(self, robot: str, identity: Identity, session: str, permissions: Permissions) -> StoredSession | None:
        """Check that a session may be this robot; return the session that is it no more, if there is one.

        Raises RefusedError: no rule lets it, or another connection is this robot and not silent.
        """
        wire.check_robot(robot)
        if not permissions.allow("send", f"/robots/{robot}/status"):
            raise RefusedError("unauthorized", f"robot {robot}: no rule allows to send /robots/{robot}/status")
        other = self._sessions.get(robot)
        if other is None or other.key == (identity.key, session):
            return None
        here = other.away_s == math.inf
        if here and self._clock() - other.heard_s < SILENT_S:
            why = f"another robot of this name is here, at {other.identity.address}"
            self._warn(robot, f"two robots have this name: the one at {identity.address} was refused", identity)
            raise RefusedError("taken", f"robot {robot}: {why}")
        if here or other.identity.key != identity.key:
            who = identity.email or identity.address
            self._warn(robot, f"{who} took over from {other.identity.email or other.identity.address}", identity)
        return other

    def claim(self, robot: str, session: StoredSession) -> None:
        """Note that a session is this robot."""
        self._sessions.pop(robot, None)
        self._sessions[robot] = session
        self._store.claimed(session, robot)
        self.told(robot, session.identity.address)
        if len(self._sessions) > _MOST:
            del self._sessions[next(iter(self._sessions))]

    def elsewhere(self, robot: str, relay: str, address: str) -> None:
        """Warn if a robot that is at another ``relay``, from ``address``, is connected here, too."""
        session = self._sessions.get(robot)
        if session is not None and session.away_s == math.inf and self._clock() - session.heard_s < SILENT_S:
            self._warn(robot, f"two robots have this name: one at {address}, at relay {relay}", session.identity)

    def _warn(self, robot: str, why: str, identity: Identity) -> None:
        self._audit.repeated(what="robot", code="taken", why=f"{robot}: {why}", **identity.as_json())
        now_us, payload = self._now_us(), json.dumps({"why": why}).encode()
        self._publish(wire.Message(f"/robots/{robot}/{CLAIM}", payload, sender=wire.OWN, stamp_us=now_us, at_us=now_us))
