"""Comparison of policies: ``run`` plays the experiment, ``table`` prints it, ``perf`` measures bufgym's speed."""
