"""What fuzzing reads lies beside the other tests' helpers."""

import sys
from pathlib import Path

sys.path += [str(Path(__file__).resolve().parents[1] / name) for name in ("traces", "core", "benchmark")]
