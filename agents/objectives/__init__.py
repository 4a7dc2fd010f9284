"""Objectives of evolution, one module per kind of task: one environment, one queue, topics, a fleet."""

from __future__ import annotations

from agents.objectives.fleet import FleetObjective
from agents.objectives.guided import GuidedObjective
from agents.objectives.objective import Objective
from agents.objectives.queue import QueueObjective
from agents.objectives.topics import TopicsObjective

OBJECTIVES: dict[str, type[Objective]] = {
    "guided": GuidedObjective,
    "queue": QueueObjective,
    "topics": TopicsObjective,
    "fleet": FleetObjective,
}
"""``Settings.objective`` -> the objective."""
