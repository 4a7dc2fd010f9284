"""Scenarios: messages and links for the sender. All randomness is drawn here, before the simulation, which has none.

``Scenario.draw(streams) -> Episode`` draws one episode: when messages arrive, how large they are, how far the scene
moves, which link carries them. Arrivals, link and policies draw from separate random streams, so that two policies (or
two policy seeds) meet the same episode: common random numbers.
"""

from bufgym.scenario.arrivals import messages
from bufgym.scenario.client import Client, Stream, read_client, robofleet_example
from bufgym.scenario.episode import Episode, Scenario, Streams
from bufgym.scenario.fleet import FleetEpisode, FleetScenario
from bufgym.scenario.interruption import Interruption
from bufgym.scenario.numbered import draw
from bufgym.scenario.registry import SCENARIOS, about, get, register
from bufgym.scenario.uplink import Uplink

__all__ = [
    "Episode", "FleetScenario", "Interruption", "Stream", "Streams", "Uplink", "draw", "get", "messages", "read_client",
    "register",
]  # fmt: skip
