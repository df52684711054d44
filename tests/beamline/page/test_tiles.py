"""Tiles: means of blocks, and 16-bit numbers that give the values back to half a step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.page.tiles import TileRegion, bin_mean, pack


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4), st.integers(1, 4))
def test_each_pixel_of_a_binned_picture_is_the_mean_of_its_block(rows: int, cols: int, down: int, across: int) -> None:
    pixels = np.arange(rows * cols, dtype=float).reshape(rows, cols) ** 1.5
    binned = bin_mean(pixels, (down, across))
    for i in range(binned.shape[0]):
        for k in range(binned.shape[1]):
            block = pixels[i * down : (i + 1) * down, k * across : (k + 1) * across]
            assert binned[i, k] == pytest.approx(block.mean(), rel=1e-5)


def test_packed_values_come_back_to_half_a_step(rng: np.random.Generator) -> None:
    values = rng.normal(3, 100, (20, 30)).astype(np.float32)
    values[2, 3] = np.nan
    packed = pack(values)
    back = packed.offset + packed.scale * packed.numbers
    assert packed.numbers[2, 3] == 65535
    others = np.isfinite(values)
    assert np.abs(back - values)[others].max() <= 0.51 * packed.scale + 1e-4
    assert packed.numbers[others].max() == 65534


@given(*[st.integers(0, 10**9)] * 4)
def test_any_region_has_a_pixel_inside_the_picture(a: int, b: int, c: int, d: int) -> None:
    inside = TileRegion(a, b, c, d).inside((7, 5))
    assert 0 <= inside.first_row < inside.last_row <= 7
    assert 0 <= inside.first_col < inside.last_col <= 5
