"""Picks from two Lanes against numpy's."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from recon.kernels.cpu import lanes
from recon.kernels.cpu.picks import least, pick, whole

F32 = NDArray[np.float32]


@njit
def _kernel(numbers: F32, at: F32, further: int, out: F32) -> None:
    low, high, places = lanes.load(numbers, 0, 0), lanes.load(numbers, 0, 16), lanes.load(at, 0, 0)
    lanes.store(out, 0, 0, pick(low, high, places, further))
    lanes.store(out, 1, 0, whole(places))
    lanes.store(out, 2, 0, least(low, high))


def test_picks_are_those_of_an_array() -> None:
    rng = np.random.default_rng(0)
    numbers, at = rng.normal(size=(1, 32)).astype(np.float32), rng.uniform(0, 32, (1, 16)).astype(np.float32)
    at[0, :3] = 0, 31, 31.99
    out = np.empty((3, 16), np.float32)
    for further in (0, 1, 5, 40):
        _kernel(numbers, at, further, out)
        np.testing.assert_array_equal(out[0], numbers[0, (at[0].astype(int) + further) % 32])
    np.testing.assert_array_equal(out[1], np.floor(at[0]))
    np.testing.assert_array_equal(out[2], np.minimum(numbers[0, :16], numbers[0, 16:]))


@pytest.mark.slow
def test_picks_need_no_avx512() -> None:
    """A processor without it, as numba is told by its environment."""
    generic = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": os.devnull}
    run = f"import runpy; runpy.run_path({__file__!r})['test_picks_are_those_of_an_array']()"
    done = subprocess.run([sys.executable, "-c", run], env=generic, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
