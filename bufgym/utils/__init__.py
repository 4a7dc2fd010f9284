"""What every subpackage stands on: the one error, files written whole or not at all, objects by name, tables."""

from bufgym.utils.errors import BufgymError

__all__ = ["BufgymError", "__version__"]
__version__ = "0.3.0"
