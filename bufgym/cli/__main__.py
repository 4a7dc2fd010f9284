"""``python -m bufgym.cli``: the same as the command ``bufgym``."""

import sys

from bufgym.cli import main

if __name__ == "__main__":
    sys.exit(main())
