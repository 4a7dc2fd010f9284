"""Objectives of CMA-ES, one module per kind of task: one environment, one queue, topics, a fleet."""

from __future__ import annotations

from agents.objectives.fleet import FleetObjective
from agents.objectives.guided import GuidedObjective
from agents.objectives.objective import Objective
from agents.objectives.suites import SuitesObjective
from agents.objectives.topics import TopicsObjective

OBJECTIVES: dict[str, type[Objective]] = {
    "environment": GuidedObjective,
    "queue": SuitesObjective,
    "topics": TopicsObjective,
    "fleet": FleetObjective,
}
"""``Settings.kind`` -> the objective."""
