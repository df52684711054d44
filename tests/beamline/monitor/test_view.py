"""A view is the line integrals of a frame on a grid of cells, and knows which cells have beam."""

import numpy as np
import pytest

from beamline.monitor.view import COLS, grid_of, remaining_intensity, view_of

SHAPE = (40, 300)
FLAT = np.full(SHAPE, 1100.0, np.float32)
DARK = np.full(SHAPE, 100.0, np.float32)
GRID = grid_of(SHAPE, 8, DARK, FLAT)
DEPTH = np.tile(np.linspace(0, 2, SHAPE[1]), (SHAPE[0], 1))


def counts(depth: object, light: float = 1.0) -> np.ndarray:
    return (100 + 1000 * light * np.exp(-np.asarray(depth))).astype(np.float32)


@pytest.mark.parametrize("shape", [(10, 20), (576, 1024), (288, 512), (32, 128), (1, 160)])
def test_the_grid_has_128_columns_or_a_few_more(shape: tuple[int, int]) -> None:
    rows, cols = grid_of(shape, 4, None, None).shape
    assert cols == shape[1] if shape[1] < COLS else COLS <= cols < 2 * COLS
    assert rows >= 1


def test_line_integrals_are_those_of_the_cells_mean_light() -> None:
    seen = view_of(counts(DEPTH), GRID, 7, 0.1, 1.0)
    cells = np.exp(-DEPTH)[:, : 2 * 150].reshape(20, 2, 150, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(seen.depth, -np.log(cells), atol=2e-5)
    np.testing.assert_allclose(seen.weight, cells, rtol=2e-5)
    np.testing.assert_allclose(seen.rows, 1000 * np.exp(-DEPTH).mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(seen.cols, 1000 * np.exp(-DEPTH).mean(axis=0), rtol=1e-4)
    assert seen.edges == pytest.approx((np.mean(DEPTH[0, :4]), np.mean(DEPTH[0, -4:])), abs=0.01)


def test_a_longer_exposure_is_no_brighter_sample() -> None:
    np.testing.assert_allclose(
        view_of(counts(DEPTH, light=3.0), GRID, 0, 0.0, 3.0).depth,
        view_of(counts(DEPTH), GRID, 0, 0.0, 1.0).depth,
        atol=1e-4,
    )


def test_places_without_light_are_left_out_and_the_edges_are_those_of_the_light() -> None:
    flat = FLAT.copy()
    flat[:, :20] = flat[:, 280:] = 101.0
    grid = grid_of(SHAPE, 8, DARK, flat)
    seen = view_of(counts(DEPTH), grid, 0, 0.0, 1.0)
    assert (grid.left, grid.right) == (10, 139)
    assert not seen.depth[:, :10].any() and not seen.weight[:, 140:].any()
    assert seen.edges == pytest.approx((DEPTH[0, 22], DEPTH[0, 277]), abs=0.02)


@pytest.mark.parametrize("light", [0.02, 0.4, 1.0, 1.3])
def test_light_left_is_the_beams_whatever_the_sample_does(light: float) -> None:
    last = view_of(counts(DEPTH), GRID, 0, 0.0, 1.0)
    assert remaining_intensity(view_of(counts(DEPTH, light), GRID, 1, 0.1, 1.0), last, GRID) == pytest.approx(
        light, rel=0.01
    )
    turned = view_of(counts(DEPTH[:, ::-1], light), GRID, 1, 0.1, 1.0)
    assert remaining_intensity(turned, last, GRID) > light
