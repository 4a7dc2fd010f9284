"""The command that this package adds to ``bufgym``: where its function is."""

REPRODUCE = "bufgym_papers.figures.commands:reproduce"
