"""Compute kernels: cpu (numba), gpu (Triton), and the reference implementation that both are tested against.

Nothing here knows files, clocks or devices.
"""

# Torch is imported before any numba kernel runs: both share the system's libgomp, and torch is 20 times slower where
# numba's threads start first.
import torch  # noqa: F401
