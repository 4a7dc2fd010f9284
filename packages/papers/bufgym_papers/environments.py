"""The environment that this package adds to bufgym's: its scenario, what it is, the arguments it begins with."""

MAPPING = (
    "bufgym_papers.perception.worth:mapping",
    "a made-up room is filmed: what are the frames worth?",
    {"reward": "covered"},
)
"""Its reward is a robot's own task. It needs the extra ``perception``."""
