"""Picking elements from a line of an array, compared with numpy, for each processor level."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from recon.compiled import V3
from recon.kernels.cpu import lanes
from recon.kernels.cpu.picks import NEAR_STEP, bilinear, bilinear_near, lanes_per_window, least, pick, pick_near, whole

F32 = NDArray[np.float32]
GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}


@njit
def _sharing() -> int:
    return lanes_per_window()


@njit
def _kernel(numbers: F32, at: F32, col: int, further: int, share: float, out: F32) -> None:
    places = lanes.load(at, 0, 0)
    lanes.store(out, 0, 0, pick(numbers, 0, col, places, further))
    lanes.store(out, 1, 0, bilinear(numbers, 0, 1, np.float32(share), col, places))
    lanes.store(out, 2, 0, whole(places))
    lanes.store(out, 3, 0, least(places, lanes.load(numbers, 0, 0)))


@njit
def _near(numbers: F32, at: F32, col: int, further: int, share: float, out: F32) -> None:
    places = lanes.load(at, 0, 0)
    lanes.store(out, 0, 0, pick_near(numbers, 0, col, places, further))
    lanes.store(out, 1, 0, bilinear_near(numbers, 0, 1, np.float32(share), col, places))


def _expected(numbers: F32, at: F32, col: int, further: int, share: float) -> tuple[F32, F32]:
    lower = at.astype(int)
    lines = numbers[0] + np.float32(share) * (numbers[1] - numbers[0])
    between = lines[col + lower] + (at - lower) * (lines[col + lower + 1] - lines[col + lower])
    return numbers[0, col + lower + further], between


def test_picks_are_those_of_an_array() -> None:
    rng = np.random.default_rng(0)
    numbers, out = rng.normal(size=(2, 80)).astype(np.float32), np.empty((4, 16), np.float32)
    most = (2 * _sharing() - 3) / (_sharing() - 1)
    for step in (0.01, 0.5, 0.999, NEAR_STEP, 1.0, 1.3, most):
        for start in (0.0, 0.37, 1 - 1e-7):
            at = (start + step * np.arange(16)).astype(np.float32)[None]
            for further in (0, 1):
                want = _expected(numbers, at[0], 7, further, 0.3)
                for kernel in (_kernel, _near) if step <= NEAR_STEP else (_kernel,):
                    kernel(numbers, at, 7, further, 0.3, out)
                    np.testing.assert_array_equal(out[0], want[0])
                    np.testing.assert_allclose(out[1], want[1], atol=2e-6)
            np.testing.assert_array_equal(out[2], np.floor(at[0]))
            np.testing.assert_array_equal(out[3], np.minimum(numbers[0, :16], at[0]))


def test_lanes_that_nobody_wants_read_within_32_neighbours() -> None:
    numbers = np.full((2, 80), np.inf, np.float32)
    numbers[:, 20:54] = 1
    out = np.empty((4, 16), np.float32)
    for at in (np.linspace(-90, 90, 16), np.full(16, -70.0), np.full(16, 1000.0), np.arange(16) * 4.0):
        for kernel in (_kernel, _near):
            kernel(numbers, at.astype(np.float32)[None], 20, 1, 0.5, out)
            assert (out[0] == 1).all()
            assert np.isfinite(out[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "laws"),
    [
        (V3.environment, "pick or lanes or tiles or steps_of_any_length or single_slice_is"),
        (GENERIC, "pick or lanes"),
        pytest.param(GENERIC, "single_slice_is", marks=pytest.mark.long),
    ],
)
def test_picks_need_no_avx512(level: Mapping[str, str], laws: str) -> None:
    """A processor without it, as numba is told by its environment; the other laws are those of their own tests.

    Whole projectors, which take a minute to compile, are asked of the level that is shipped."""
    environment = {**os.environ, **level, "NUMBA_CACHE_DIR": os.devnull}
    root = Path(__file__).parents[4]
    tests = [__file__, str(root / "tests/recon/voxels/test_projector.py"), "-k", laws]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", *tests],
        env=environment, capture_output=True, text=True, cwd=root,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
