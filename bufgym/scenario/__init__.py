"""Scenarios: messages and links for the sender. All randomness is drawn here, before the simulation, which has none.

``Scenario.draw(streams) -> Episode`` draws one episode: when messages arrive, how large they are, how far the scene
moves, which link carries them. Arrivals, link and policies draw from separate random streams, so that two policies (or
two policy seeds) meet the same episode: common random numbers.
"""

from bufgym.scenario.arrivals import messages
from bufgym.scenario.client import Client, Stream, read_client, robofleet_example
from bufgym.scenario.episode import Episode, Scenario, Streams
from bufgym.scenario.fleet import MAX_ROBOTS, FleetEpisode, FleetScenario
from bufgym.scenario.interruption import LAWS, Interruption
from bufgym.scenario.numbered import by_trace, draw
from bufgym.scenario.registry import SCENARIOS, about, get, register
from bufgym.scenario.uplink import Uplink

__all__ = [
    "LAWS", "MAX_ROBOTS", "SCENARIOS", "Client", "Episode", "FleetEpisode", "FleetScenario", "Interruption", "Scenario",
    "Stream", "Streams", "Uplink", "about", "by_trace", "draw", "get", "messages", "read_client", "register",
    "robofleet_example",
]  # fmt: skip
