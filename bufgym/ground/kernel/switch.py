"""Whether kernels are compiled at all."""

from __future__ import annotations

from typing import Any, cast

import numba

JIT = not cast(Any, numba.config).DISABLE_JIT
"""False where compilation is off and every kernel runs as its Python source."""
