"""A robot's stops: numbered facts that relay, robot and page each keep, and compare whenever they meet.

Everybody who says stops numbers them, so a stop is named by who said it and its number: ``WHO-NUMBER``. Of each who the
last one is kept. The higher number wins, and of one number the release, which names what it releases. So two that meet
agree, whatever each has missed, in any order and however often: no stop is lost, and none that was released comes back.

A command says which stops the relay knew when it took it. A robot that knows another one does not execute it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

from bufgym.utils.errors import BufgymError

MOST_RELEASED: Final = 32  # Released stops that are kept of a robot; the ones released first go
MOST_HELD: Final = 64  # Stops that hold at a time; further ones are refused, and the robot stands
MOST_CHARACTERS: Final = 100  # of who says a stop, and of its shown name
_MOST_NUMBER: Final = 2**53
_ID: Final = re.compile("(.+)-([0-9]{1,16})", re.DOTALL)


class Stop(NamedTuple):
    """One stop, and its release if it has been released."""

    who: str
    """Client that said it, which numbers its stops."""
    number: int
    by: str = ""
    """Its e-mail or name, as others see it."""
    at_us: int = 0
    """When the relay took it, by the relay's clock."""
    released_by: str = ""
    released_us: int = 0
    """When the relay took its release; 0 while it holds."""

    @property
    def id(self) -> str:
        """Its name for people and programs, ``WHO-NUMBER``."""
        return f"{self.who}-{self.number}"

    @property
    def holds(self) -> bool:
        """Whether nobody has released it."""
        return self.released_us == 0

    @property
    def order(self) -> tuple[Any, ...]:
        """Which of two of one who is the later: the number, then the release; the rest makes the choice unique."""
        return self.number, self.released_us, self.released_by, self.at_us, self.by

    def as_json(self) -> dict[str, Any]:
        """Return it as messages and files hold it."""
        released = {} if self.holds else {"released_by": self.released_by, "released_us": self.released_us}
        return {"id": self.id, "by": self.by, "at_us": self.at_us, **released}


def named(id: str) -> tuple[str, int]:
    """Read a stop's id: who said it, and its number. An id without a number is a who that says one stop."""
    found = _ID.fullmatch(id)
    return (id, 1) if found is None or int(found[2]) > _MOST_NUMBER else (found[1], int(found[2]))


def read(said: Any) -> Iterator[Stop]:
    """Read a list of stops as ``as_json`` writes them; what is none of these is left out."""
    for one in said if isinstance(said, list) else ():
        if not isinstance(one, dict) or not isinstance(one.get("id"), str) or not one["id"]:
            continue
        who, number = named(one["id"][: MOST_CHARACTERS + 17])
        texts = [str(one.get(name, ""))[:MOST_CHARACTERS] for name in ("by", "released_by")]
        times = [one.get(name, 0) for name in ("at_us", "released_us")]
        if len(who) <= MOST_CHARACTERS and all(type(us) is int and 0 <= us <= _MOST_NUMBER for us in times):
            yield Stop(who, number, texts[0], times[0], texts[1], times[1])


class Ledger:
    """The stops of one robot that one party knows."""

    def __init__(self, stops: Iterable[Stop] = ()) -> None:
        self._stops: dict[str, Stop] = {}
        self.take(stops)

    def __iter__(self) -> Iterator[Stop]:
        return iter(self._stops.values())

    @property
    def held(self) -> list[Stop]:
        """The stops that hold, the last one at the end."""
        return sorted((stop for stop in self if stop.holds), key=lambda stop: (stop.at_us, stop.id))

    @property
    def by(self) -> str:
        """Who said the stops that hold."""
        return ", ".join(dict.fromkeys(stop.by or stop.who for stop in self.held))

    def take(self, stops: Iterable[Stop]) -> list[Stop]:
        """Take note of what another party knows; return what was new here."""
        new = []
        for stop in stops:
            before = self._stops.get(stop.who)
            if before is None or stop.order > before.order:
                self._stops[stop.who] = stop
                new.append(stop)
        released = [stop for stop in self if not stop.holds]
        for stop in sorted(released, key=lambda one: (one.released_us, one.who))[
            : max(0, len(released) - MOST_RELEASED)
        ]:
            del self._stops[stop.who]
        return [stop for stop in new if self._stops.get(stop.who) is stop]

    def knows(self, who: str, number: int) -> bool:
        """Whether this stop, or a later one of the same who, is known."""
        return who in self._stops and self._stops[who].number >= number

    def say(self, id: str, by: str, at_us: int) -> list[Stop]:
        """Take a stop; return it if it is new.

        Raises BufgymError: so many hold that one more makes no difference.
        """
        who, number = named(id)
        if self.knows(who, number):
            return []
        if len(self.held) >= MOST_HELD and not (who in self._stops and self._stops[who].holds):
            raise BufgymError(f"was stopped {MOST_HELD} times: release it first")
        return self.take([Stop(who, number, by, at_us)])

    def release(self, ids: Iterable[str], by: str, at_us: int) -> list[Stop]:
        """Release these stops, also those that have not come yet; return what is new here.

        Raises BufgymError: none of them holds, but another does, which whoever releases these has not seen.
        """
        names = dict(named(id) for id in ids if len(id) <= MOST_CHARACTERS + 17)
        here = [stop for stop in self.held if stop.number <= names.get(stop.who, -1)]
        if self.held and not here:
            raise BufgymError(f"was stopped again, by {self.by}: release that")
        # Later than all before, also by a clock that went back: the releases that went first are forgotten.
        at_us = max(1, at_us, *(stop.released_us + 1 for stop in self))
        coming = [Stop(who, number) for who, number in names.items() if not self.knows(who, number)]
        return self.take(stop._replace(released_by=by, released_us=at_us) for stop in (*here, *coming))

    @property
    def seen(self) -> str:
        """What a command says of the stops that are known: JSON, who -> number; empty without any."""
        return json.dumps({stop.who: stop.number for stop in self}, separators=(",", ":")) if self._stops else ""

    def unseen(self, seen: str) -> list[Stop]:
        """List the stops that are not in a command's ``seen``."""
        known: Mapping[str, Any] = {}
        with suppress(ValueError, RecursionError):
            said = json.loads(seen or "{}")
            known = said if isinstance(said, dict) else {}
        numbers = {who: number for who, number in known.items() if type(number) is int}
        return [stop for stop in self if stop.number > numbers.get(stop.who, 0)]

    def refusal(self, seen: str) -> str:
        """Say why a command that moves the robot must not be executed, or nothing."""
        if self.held:
            return f"stopped by {self.by}: release it first"
        later = self.unseen(seen)
        return f"withdrawn: stopped by {later[-1].by or later[-1].who}" if later else ""

    def as_json(self) -> list[dict[str, Any]]:
        """Return all stops as messages and files hold them."""
        return [stop.as_json() for stop in self]
