"""Agents that learn to buffer: networks, training, evaluation. Imports bufgym, never the reverse."""
