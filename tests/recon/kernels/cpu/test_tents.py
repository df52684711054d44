"""Sums in coarse cells: against a dense matrix, its transpose, and that the weights of a voxel add up to one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.kernels.cpu.tents import add_tents, cells_of, least_width, spectrum_of_tents, tent_sums

F32 = NDArray[np.float32]
SHAPES = [((20, 33, 3), 4), ((7, 6, 1), 8), ((65, 64, 2), 2), ((16, 24, 5), 8), ((9, 9, 2), 1), ((10, 3, 1), 5)]


def matrix(n: int, width: int) -> NDArray[np.float64]:
    """[cell, voxel] tents, by their definition."""
    cells = cells_of(n, width)
    place = np.clip((np.arange(n) + 0.5) / width - 0.5, 0, cells - 1)
    return np.maximum(1 - np.abs(place - np.arange(cells)[:, None]), 0)


@pytest.mark.parametrize(("shape", "width"), SHAPES)
def test_sums_and_their_transpose_are_those_of_a_matrix(
    shape: tuple[int, int, int], width: int, rng: np.random.Generator
) -> None:
    x = rng.normal(size=shape).astype(np.float32)
    down, across = matrix(shape[0], width), matrix(shape[1], width)
    sums = tent_sums(x, width)
    np.testing.assert_allclose(sums, np.einsum("ay,bx,yxz->abz", down, across, x), atol=2e-5)
    cells = rng.normal(size=sums.shape).astype(np.float32)
    added = x.copy()
    add_tents(added, -0.5, cells, width)
    np.testing.assert_allclose(added, x - 0.5 * np.einsum("ay,bx,abz->yxz", down, across, cells), atol=2e-6)
    back = np.zeros_like(x)
    add_tents(back, 1.0, cells, width)
    assert float(np.vdot(sums, cells)) == pytest.approx(float(np.vdot(x, back)), abs=1e-3)


@pytest.mark.parametrize(("shape", "width"), SHAPES)
def test_the_weights_of_a_voxel_add_up_to_one(shape: tuple[int, int, int], width: int) -> None:
    ones = np.zeros(shape, np.float32)
    add_tents(ones, 1.0, np.ones_like(tent_sums(ones, width)), width)
    np.testing.assert_allclose(ones, 1, atol=1e-6)


@pytest.mark.parametrize("width", [1, 2, 4, 5])
def test_what_tents_leave_of_a_wave(width: int) -> None:
    """Of a long wave far from the faces: the sum of a tent's voxels, each with the phase of the wave, squared."""
    n, cycles = 40 * width, 3.0
    voxels = np.arange(1 - width, width) if width % 2 else np.arange(-width, width) + 0.5
    tent = np.maximum(1 - np.abs(voxels) / width, 0)
    once = abs((tent * np.exp(2j * np.pi * cycles * voxels / n)).sum()) / width
    assert float(spectrum_of_tents(np.array([cycles]), n, width)[0]) == pytest.approx(once**2, rel=2e-2)


def test_cells_are_as_many_as_allowed() -> None:
    assert [least_width(n, 64) for n in (1, 64, 65, 2048)] == [1, 1, 2, 32]
