"""Processor sharing in whole bytes and microseconds: the link that the robots of a cell share.

See docs/methods.md, "A cell's link".
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, records
from bufgym.model.documented import documented
from bufgym.model.link import FOREVER, carried_by, finish_of
from bufgym.sim.decisions import arrive
from bufgym.sim.socket import finish_transmission, next_size_bytes
from bufgym.sim.state import CARRIES, END, IDLE, NOTHING, Batch

CELL = np.dtype(
    [
        # settings
        ("robots", np.int64),  # N: rows c N .. c N + N - 1 of the batch are in cell c
        ("first_knot", np.int64),  # first knot of the cell's trace, in the batch's knots
        ("last_knot", np.int64),
        ("after", np.int64),  # what follows the trace's end: LOOP, HOLD or STOP
        ("offset_us", np.int64),
        # clock
        ("tick_us", np.int64),  # the time of the arrivals under way
        ("next_us", np.int64),  # the time of the next arrivals
        ("robot", np.int64),  # the first robot that may still have an arrival now; N: all have come
        ("row", np.int64),  # the sender that the last event is about, and whose socket may be free
        # capacity
        ("busy", np.int64),  # n: senders with a message in transmission
        ("served", np.int64),  # bytes given to each sender that has been busy all the time
        ("position", np.int64),  # bytes of the trace used up by ``served``
        ("reached", np.int64),  # bytes that the trace has come to at ``tick_us``
        ("segment_now", np.int64),  # segment of the trace where clock and sockets were last looked up
        ("segment_finish", np.int64),
    ],
    align=True,
)


@documented
class Shares(NamedTuple):
    """The arrays of several cells with N robots each, beside the ``Batch`` of their senders."""

    cells: NDArray[Any]
    """CELL[cells]: settings and state of each cell."""
    goals: NDArray[np.int64]
    """int64[cells, N]: ``served`` at the end of the message in transmission; FOREVER for a free socket."""
    due_us: NDArray[np.int64]
    """int64[cells, N]: time of the next arrival, us; FOREVER after the last."""


def new_shares(cells: int, robots: int) -> Shares:
    """The arrays of so many cells with N = ``robots`` each."""
    numbers = np.zeros((cells, robots), np.int64)
    return Shares(records(cells, CELL), numbers, numbers.copy())


@kernel
def load_cell(batch: Batch, shares: Shares, c: int) -> None:
    """Begin the episodes that the senders of cell ``c`` have loaded: same link, nothing arrived."""
    cell = shares.cells[c]
    robots = shares.goals.shape[1]
    first = c * robots
    link = batch.senders[first]
    cell.robots, cell.robot, cell.row = robots, robots, first
    cell.first_knot, cell.last_knot, cell.after = link.first_knot, link.last_knot, link.after
    cell.offset_us = link.offset_us
    cell.segment_now, cell.segment_finish = cell.first_knot, cell.first_knot
    cell.tick_us, cell.busy, cell.served, cell.position, cell.reached = 0, 0, 0, 0, 0
    for robot in range(robots):
        shares.goals[c, robot] = FOREVER
        shares.due_us[c, robot] = batch.arrivals[first + robot, 0].arrival_us
    cell.next_us = least(shares.due_us[c])


@kernel
def least(numbers: NDArray[np.int64]) -> int:
    """The least of the numbers, or FOREVER if there are none."""
    smallest = FOREVER
    for number in numbers:
        smallest = min(smallest, number)
    return smallest


@kernel
def settle(batch: Batch, shares: Shares, c: int) -> None:
    """Give every busy sender the whole bytes that its share has come to by ``tick_us``."""
    cell = shares.cells[c]
    cell.reached = carried_by(batch.knot_us, batch.knot_bytes, cell, cell.tick_us)
    if cell.busy > 0:
        # Whole bytes for each, rounded down: the rest is shared later, so that no byte is given twice.
        share = (cell.reached - cell.position) // cell.busy
        cell.served += share
        cell.position += share * cell.busy


@kernel
def join(batch: Batch, shares: Shares, i: int) -> None:
    """Let sender ``i`` begin with a message, right after its previous one or from ``tick_us`` on."""
    c, robot = i // shares.goals.shape[1], i % shares.goals.shape[1]
    cell, sender = shares.cells[c], batch.senders[i]
    if cell.busy == 0 and sender.link == IDLE:
        cell.position = max(cell.reached, cell.position)  # an idle cell's capacity is gone
    sender.link, sender.began_us = CARRIES, sender.now_us
    cell.busy += 1
    shares.goals[c, robot] = cell.served + next_size_bytes(batch, i)


@kernel
def next_finish(batch: Batch, shares: Shares, c: int) -> tuple[int, int, int]:
    """Goal, position and time (us) of the message that will be transmitted first; time FOREVER if none ever will."""
    cell = shares.cells[c]
    if cell.busy == 0:
        return FOREVER, cell.position, FOREVER
    goal = least(shares.goals[c])
    # One byte for this sender is one for every busy sender.
    position = cell.position + cell.busy * (goal - cell.served)
    return goal, position, finish_of(batch.knot_us, batch.knot_bytes, cell, position)


@kernel
def finish_in_cell(batch: Batch, shares: Shares, c: int, goal: int, position: int, at_us: int) -> None:
    """Finish the message with the least goal (one, if several are equal), and free its sender's socket."""
    cell = shares.cells[c]
    robot = 0
    # Of equal goals the lowest row finishes first, on every machine.
    while shares.goals[c, robot] != goal:
        robot += 1
    cell.served, cell.position = goal, position
    cell.busy -= 1
    cell.row = c * cell.robots + robot
    shares.goals[c, robot] = FOREVER
    finish_transmission(batch, cell.row, at_us)


@kernel
def next_in_cell(batch: Batch, shares: Shares, c: int) -> int:
    """The next event in cell ``c``: a message transmitted, a tick, an arrival at one of its robots, or the END.

    The order is the same as for one sender. Messages that the link finishes up to and including a time leave, and
    successors start. Then the arrivals of that time come, in the order of the robots. No decision and no start among
    them changes the transmissions at that time, so all of them may also be gathered before the first is answered.
    NOTHING unless an arrival asks for a DECISION.
    """
    cell = shares.cells[c]
    if cell.robot < cell.robots:
        return arrive_in_cell(batch, shares, c)
    goal, position, finish_us = next_finish(batch, shares, c)
    # FOREVER - 1: on a dead link nothing finishes, also when no arrival is to come.
    if finish_us <= min(cell.next_us, FOREVER - 1):
        finish_in_cell(batch, shares, c, goal, position, finish_us)
    elif cell.next_us == FOREVER:
        return END
    else:
        cell.tick_us, cell.robot = cell.next_us, 0
        settle(batch, shares, c)
    return NOTHING


@kernel
def arrive_in_cell(batch: Batch, shares: Shares, c: int) -> int:
    """Let the next arrival of this tick come, if one is left: DECISION if it asks for one, else NOTHING."""
    cell = shares.cells[c]
    robot = cell.robot
    while robot < cell.robots and shares.due_us[c, robot] != cell.tick_us:
        robot += 1
    cell.robot = min(robot + 1, cell.robots)
    event = NOTHING
    if robot < cell.robots:
        i = c * cell.robots + robot
        sender = batch.senders[i]
        following = sender.next + 1
        # Read before ``arrive``, which may settle the arrival and move ``next`` on.
        due_us = batch.arrivals[i, following].arrival_us if following < sender.arrivals else FOREVER
        shares.due_us[c, robot] = due_us
        # The position at which a link of its own would have the same bytes left.
        sender.position = shares.goals[c, robot] - cell.served + cell.reached if sender.busy > 0 else 0
        cell.row = i
        event = arrive(batch, i)
    if cell.robot == cell.robots:
        cell.next_us = least(shares.due_us[c])
    return event
