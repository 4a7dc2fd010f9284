"""A small model of one robot's stops: a page and the robot, each at a relay of its own, and all that may go wrong.

The parties use ``Ledger`` itself; the model is of what goes between them. ``explored`` tries every interleaving of the
events up to a depth: stops, releases and goals are said, links carry what they carry late or never, and a relay without
a file forgets all. The properties are in terms of sets of stops, which the model keeps beside the ledgers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.ledger import Ledger, Stop

Stops = tuple[Stop, ...]
LINKS = (("page", "near"), ("near", "far"), ("far", "robot"))
MOST_SAID, MOST_GOALS = 2, 1


class State(NamedTuple):
    """A ledger is what a party has in its file; the near relay may have none."""

    page: Stops = ()
    near: Stops = ()
    far: Stops = ()
    robot: Stops = ()
    waiting: tuple[str, ...] = ()
    """Stops of the page that it says until the robot confirms them, in its browser's storage."""
    said: tuple[int, int] = (0, 0)
    """How many stops the page, and a client at the far relay, have said."""
    goals: tuple[tuple[str, frozenset[str]], ...] = ()
    """Goals on their way: what they say of stops, and which the relay knew in truth."""
    taken: frozenset[str] = frozenset()
    """Stops that somebody was told are in force."""
    released: frozenset[str] = frozenset()
    """Stops whose release a relay has taken."""
    executed: tuple[str, ...] = ()
    """Stops that the robot knew, and the relay that took a goal did not, when the robot executed it."""


def known(stops: Stops) -> frozenset[str]:
    """The stops that a ledger knows: a later number of one who covers the earlier ones."""
    return frozenset(f"{stop.who}-{k + 1}" for stop in stops for k in range(stop.number))


def known_released(stops: Stops) -> frozenset[str]:
    return known(tuple(stop for stop in stops if not stop.holds))


def held(stops: Stops) -> list[str]:
    return [stop.id for stop in Ledger(stops).held]


def merged(mine: Stops, others: Stops) -> Stops:
    ledger = Ledger(mine)
    ledger.take(others)
    return tuple(sorted(ledger))


def stopped(state: State, relay: str, id: str) -> State:
    ledger = Ledger(getattr(state, relay))
    new = ledger.say(id, "", 1)
    return state._replace(**{relay: tuple(sorted(ledger)), "taken": state.taken | {stop.id for stop in new}})


def released(state: State, relay: str, ids: list[str]) -> State:
    ledger = Ledger(getattr(state, relay))
    try:
        new = ledger.release(ids, "", 2)
    except BufgymError:
        return state
    over = state.released | known(tuple(new))
    return state._replace(**{relay: tuple(sorted(ledger)), "released": over, "taken": state.taken - over})


def without_released(state: State) -> State:
    """The page says no stop again that it knows to be released."""
    over = known_released(state.page)
    return state._replace(waiting=tuple(id for id in state.waiting if id not in over))


def arrived(state: State, k: int) -> State:
    """A goal comes to the robot; the far relay gives it what it knows of stops before."""
    seen, truth = state.goals[k]
    state = state._replace(goals=state.goals[:k] + state.goals[k + 1 :], robot=merged(state.robot, state.far))
    if Ledger(state.far).refusal(seen) or Ledger(state.robot).refusal(seen):
        return state
    return state._replace(executed=tuple(sorted(known(state.robot) - truth)) + tuple(held(state.robot)))


def events(state: State) -> Iterator[tuple[str, State]]:
    """All that can happen next."""
    page, client = state.said
    if page < MOST_SAID:
        id = f"page-{page + 1}"
        yield f"the page says {id}", state._replace(waiting=(*state.waiting, id), said=(page + 1, client))
    if client < 1:
        yield "a client at the far relay stops", stopped(state._replace(said=(page, 1)), "far", "client-1")
    for id in state.waiting:
        yield f"{id} comes to the near relay", stopped(state, "near", id)
        if any(stop.who == "page" and stop.number >= int(id[-1]) for stop in state.robot):
            yield f"the robot confirms {id}", state._replace(waiting=tuple(one for one in state.waiting if one != id))
    if names := sorted({*held(state.page), *held(state.robot), *state.waiting}):
        yield "the page releases all", released(state, "near", names)
    if names := held(state.far):
        yield "the client releases all", released(state, "far", names)
    for relay in ("near", "far"):
        stops = getattr(state, relay)
        if len(state.goals) < MOST_GOALS and not held(stops):
            goal = Ledger(stops).seen, known(stops)
            yield f"a goal at the {relay} relay", state._replace(goals=(*state.goals, goal))
    for one, two in LINKS:
        for here, there in ((one, two), (two, one)):
            if here == "page":  # which says stops and releases, not its ledger
                continue
            both = merged(getattr(state, there), getattr(state, here))
            if both != getattr(state, there):
                yield f"{here} tells {there}", without_released(state._replace(**{there: both}))
    for k in range(len(state.goals)):
        yield "a goal comes to the robot", arrived(state, k)
    if state.near:
        others = merged(state.far, state.robot)  # a release that only a relay without a file has is lost with it
        told = frozenset(id for id in state.released if any(id in known((stop,)) and not stop.holds for stop in others))
        yield "the near relay, which has no file, forgets all", state._replace(near=(), released=told)


def settled(state: State) -> State:
    """All links work for long enough."""
    for id in state.waiting:
        state = stopped(state, "near", id)
    for one, two in (*LINKS, *reversed(LINKS), *LINKS):
        both = merged(getattr(state, one), getattr(state, two))
        if one != "page":
            state = state._replace(**{one: both, two: both})
    return state._replace(page=merged(state.page, state.near))


def fault(state: State) -> str:
    """What is wrong with a state, or nothing."""
    if state.executed:
        return f"a goal was executed though {state.executed} came before it"
    end = settled(state)
    shown = sorted({*held(end.page), *held(end.near), *held(end.robot)} - known_released(end.near))
    parties = [sorted(shown), *(sorted(held(stops)) for stops in (end.near, end.far, end.robot))]
    if any(one != parties[0] for one in parties):
        return f"page, relays and robot do not agree: {parties}"
    if lost := [id for id in state.taken if id not in known(end.robot)]:
        return f"{lost} are lost"
    carried = {id for stop in end.robot if stop.holds for id in known((stop,))}
    if lost := [id for id in state.taken - state.released if id not in carried]:
        return f"{lost} hold no more, and nobody has released them"
    if back := [id for id in parties[3] if id in state.released]:
        return f"{back} are back after their release"
    refused = [bool(Ledger(end.robot).refusal(Ledger(one).seen)) for one in (end.near, end.far)]
    return "goals are refused after all stops are released" if any(refused) and not parties[3] else ""


def explored(depth: int) -> tuple[int, list[str]]:
    """Try all up to a depth; return how many states there are, and the events to the first fault with its text."""
    paths: dict[State, tuple[State, str] | None] = {State(): None}
    level = [State()]
    for _ in range(depth):
        following = []
        for state in level:
            for event, after in events(state):
                if after in paths:
                    continue
                paths[after] = state, event
                following.append(after)
                if why := fault(after):
                    return len(paths), [*story(paths, after), why]
        level = following
    return len(paths), []


def story(paths: dict[State, tuple[State, str] | None], state: State) -> list[str]:
    """The events that lead to a state."""
    found = []
    while (step := paths[state]) is not None:
        state, event = step
        found.append(event)
    return found[::-1]
