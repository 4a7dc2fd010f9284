"""A session's subscriptions, and the program's functions that they call."""

import asyncio
import inspect
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

from bufgym_robot.wire.messages import Message
from bufgym_robot.wire.patterns import Pattern
from bufgym_robot.wire.patterns import pattern as compiled

OnMessage = Callable[[Message], Awaitable[str | None] | str | None]
"""A program's function; of a command it may return why it was not executed."""


class SubscriptionRequest(NamedTuple):
    """A subscription that is asked of the relay."""

    pattern: Pattern
    on_message: OnMessage
    fields: dict[str, Any]


class Wanted:
    """Subscriptions of one session, over all its connections."""

    def __init__(self) -> None:
        self._requests: dict[str, SubscriptionRequest] = {}
        self.confirmed: set[str] = set()
        """Ids of the subscriptions that this connection's relay has accepted."""

    def add(self, pattern: str, on_message: OnMessage, **chosen: Any) -> dict[str, Any]:
        """Add a subscription; return the fields of its request, without those that are None."""
        id = str(len(self._requests))
        fields = {"id": id, "topic": pattern, **{key: value for key, value in chosen.items() if value is not None}}
        self._requests[id] = SubscriptionRequest(compiled(pattern), on_message, fields)
        return fields

    def asked(self, stands_in: bool) -> list[SubscriptionRequest]:
        """Give the subscriptions that a relay is asked for; one that stands in holds nothing for who is away."""
        return [one for one in self._requests.values() if not (stands_in and "durable" in one.fields)]

    def are_confirmed(self, stands_in: bool) -> bool:
        """Whether the relay has accepted all that it was asked for."""
        return self.confirmed.issuperset(one.fields["id"] for one in self.asked(stands_in))

    async def call(self, message: Message) -> str:
        """Call the functions of all subscriptions that a message matches; return why one did not execute it."""
        takers = [one for one in self._requests.values() if one.pattern.part(message.topic)]
        whys = [await _called(one.on_message, message) for one in takers]
        return next(filter(None, whys), "") if takers else "nothing here takes it"


async def _called(on_message: OnMessage, message: Message) -> str:
    """Call a program's function; its fault, which nothing here fixes, goes to the event loop."""
    try:
        done = on_message(message)
        why = await done if inspect.isawaitable(done) else done
        return why if isinstance(why, str) else ""
    except (Exception, asyncio.CancelledError) as error:
        if asyncio.current_task().cancelling():  # type: ignore[union-attr]
            raise
        about = {"message": f"on_message of {message.topic}", "exception": error}
        asyncio.get_running_loop().call_exception_handler(about)
        return f"{type(error).__name__}: {error}"
