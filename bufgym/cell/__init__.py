"""One cell: the uplink that several robots share, each with a sender of its own.

A robot is one row of a ``Senders`` batch: its own buffer, arrivals and motion. What it does not have for itself is the
link. The cell divides its capacity equally among those that have a message in transmission (processor sharing, the
fluid limit of the round robin or proportionally fair schedulers that base stations run: Kleinrock, Queueing Systems
vol. 2, 1976, sec. 4.4), so a robot's message takes twice as long while two are sending.

Only the link differs from ``bufgym.sender``: arrivals, decisions, the buffer, what is seen and what is earned are its
functions, and a cell with one robot does exactly what one sender does.
"""

from bufgym.cell.fleet import Fleet, compiled_fleet_rollout, fleet_rollout, run_fleet
from bufgym.cell.scenario import MAX_ROBOTS, FleetEpisode, FleetScenario
from bufgym.cell.sharing import CELL, Shares, cell_event, decide_in_cell, offer

__all__ = [
    "CELL",
    "MAX_ROBOTS",
    "Fleet",
    "FleetEpisode",
    "FleetScenario",
    "Shares",
    "cell_event",
    "compiled_fleet_rollout",
    "decide_in_cell",
    "fleet_rollout",
    "offer",
    "run_fleet",
]
