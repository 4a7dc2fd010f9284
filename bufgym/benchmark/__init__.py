"""Comparison of policies on the same episodes, which ``bufgym.compare`` starts: sweeps over suites, scores, reports."""
