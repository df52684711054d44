"""How the threads of torch and numba share the cores; imported before the first kernel of either."""

from __future__ import annotations

import os

# libgomp reads this when it is loaded: without it idle threads spin, and two processes that share the cores
# (a scan and its live reconstruction) slow each other down twentyfold.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

# Torch brings its own libgomp; where numba's threads start first, both share the system's and torch is 20x slower.
import torch  # noqa: F401
