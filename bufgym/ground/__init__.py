"""What every room stands on: the one error, files written whole or not at all, objects by name, compiled kernels."""

__version__ = "0.2.0"
