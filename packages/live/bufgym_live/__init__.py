"""bufgym's policies where messages are real: ``robot`` has the live send buffer, ``relay`` the server of a fleet."""

__version__ = "0.2.0"
