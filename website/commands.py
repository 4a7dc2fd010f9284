"""The page of the command line, from its commands."""

from bufgym import cli


def page() -> str:
    """Every command with its options."""
    return cli.app().generate_docs(max_heading_level=3).replace("# bufgym\n", "# Command line\n", 1)
