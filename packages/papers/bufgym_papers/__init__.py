"""The papers behind bufgym: ``figures`` has our number beside each of theirs, ``perception`` a robot's own tasks."""

__version__ = "0.3.0"
