"""The picture of a growing volume: positions in it, and a difference image in units of the noise."""

import io

import matplotlib.image
import numpy as np
import pytest

from beamline.report.live_picture import live_picture, volume_rows
from recon.base.volume import Grid, Volume

pytestmark = pytest.mark.usefixtures("real_pictures")

GAP, TOP, LINES = 14, 30, 30  # pixels: between panels, of the title, of a label


def shown(volume: Volume, view: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[row, col, rgb] of the picture."""
    picture = live_picture(volume_rows(volume, view, render, "20 views", "mm"))
    return matplotlib.image.imread(io.BytesIO(picture))[..., :3]


def panel(image: np.ndarray, across: int, tall: int, above: int | None = None) -> np.ndarray:
    """The image below a label, row 0 at the top, `tall` pixels high, that far from the left; `above`: the height of
    the panels above it."""
    pitch = (image.shape[1] - GAP) // 3
    top = TOP + GAP + LINES + (0 if above is None else above + GAP + LINES)
    return image[top : top + tall, GAP + across * pitch : (across + 1) * pitch]


@pytest.mark.parametrize(("side", "zoom"), [(40, 7), (160, 2), (280, 1), (700, 0.5)])
def test_slices_are_where_the_matter_is_and_fill_their_panels(side: int, zoom: float, rng: np.random.Generator) -> None:
    grid = Grid((4, side, side), 0.01)
    volume = np.zeros(grid.shape, np.float32)
    volume[1:3, side // 2 : 3 * side // 4, side // 4 : side // 2] = 2.0
    view = rng.normal(0, 0.1, (20, side)).astype(np.float32)
    image = shown(Volume(volume, grid), view, view)
    tall, low = round(side * zoom), round(20 * zoom)
    assert image.shape[1] == 3 * tall + 4 * GAP  # nothing between the panels but gaps
    assert image.shape[0] == TOP + 2 * (GAP + LINES) + tall + low + GAP
    slice_ = panel(image, 0, tall)
    y, x = (round(f * tall) for f in (0.625, 0.375))
    assert slice_[y, x].min() > 0.95 and slice_[x, y].max() < 0.05  # y down, x to the right
    assert panel(image, 1, round(4 * zoom))[0, 0].max() < 0.05  # right below its label
    difference = panel(image, 2, low, tall)
    np.testing.assert_allclose(difference, 0.5, atol=0.01)  # a view like its render differs by nothing


def test_differences_are_in_units_of_the_noise(rng: np.random.Generator) -> None:
    grid = Grid((8, 64, 64), 0.01)
    volume = Volume(np.ones(grid.shape, np.float32), grid)
    view = rng.normal(0, 0.1, (64, 64)).astype(np.float32)
    render = np.zeros((64, 64), np.float32)
    render[:32] = -0.5  # five times the noise less than the view
    difference = panel(shown(volume, view, render), 2, 256, 256)[..., 0].mean(axis=1)
    assert difference[10:100].mean() > 0.8  # brighter than the fit by about five times the noise, and not all white
    assert difference[150:250].mean() == pytest.approx(0.5, abs=0.05)  # noise alone
