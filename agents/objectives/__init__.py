"""What a run of any learner is measured by: a module for one environment, for one queue and a fleet."""

from __future__ import annotations

from agents.objectives.environment import EnvironmentObjective
from agents.objectives.families import FamiliesObjective
from agents.objectives.fleet import FleetObjective
from agents.objectives.objective import Objective
from agents.objectives.suites import SuitesObjective

OBJECTIVES: dict[str, type[Objective]] = {
    "environment": EnvironmentObjective,
    "queue": SuitesObjective,
    "families": FamiliesObjective,
    "fleet": FleetObjective,
}
"""``Settings.kind`` -> the objective."""
