"""A part of the instrument in the beam of all projections is found; a sample is not mistaken for one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.prep.references import shadowed

N, ROWS, COLS, NOISE = 16, 24, 60, 1e-3
ALL = slice(None)


def _light(seed: int = 0) -> NDArray[np.float32]:
    """Views of a sample that moves from side to side and lets a tenth through."""
    light = np.random.default_rng(seed).normal(1, 0.02, (N, ROWS, COLS)).astype(np.float32)
    for view, middle in enumerate(np.linspace(12, 48, N).astype(int)):
        light[view, :, middle - 10 : middle + 10] *= 0.1
    return light


def _dark(light: NDArray[np.float32], rows: slice, cols: slice) -> None:
    part = light[:, rows, cols]
    part[:] = np.random.default_rng(1).normal(0, NOISE, part.shape)


@pytest.mark.parametrize(
    ("rows", "cols"),
    [(ALL, slice(0, 15)), (ALL, slice(50, None)), (slice(0, 6), ALL), (slice(4, 15), slice(44, None))],
    ids=["left", "right", "top", "corner"],
)  # fmt: skip
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("blur", [0.01, 0.7])
def test_it_is_found_with_its_blurred_edge(rows: slice, cols: slice, seed: int, blur: float) -> None:
    light, true = _light(seed), np.zeros((ROWS, COLS), np.bool_)
    true[rows, cols] = True
    share = gaussian_filter(true.astype(np.float32), blur)
    light *= 1 - share
    light += np.random.default_rng(1).normal(0, NOISE, light.shape)
    light[3, 5, 50] = 0.8  # a zinger
    found = shadowed(light)
    assert found[share > 0.1].mean() > 0.97 and found[share < 1e-3].mean() < 0.01


def test_nothing_that_turns_is_taken_for_one() -> None:
    light = _light()
    assert not shadowed(light).any()
    _dark(light, slice(None), slice(25, 36))  # an opaque rod on the axis
    assert not shadowed(light).any()
    edge = _light()
    edge[:, :, :20] *= np.linspace(0.01, 0.2, N)[:, None, None]  # strong matter that reaches the edge and moves
    assert not shadowed(edge).any()
