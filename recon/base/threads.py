"""Torch before numba: where numba's threads start first, both share the system's libgomp and torch is 20x slower."""

from __future__ import annotations

import torch  # noqa: F401
