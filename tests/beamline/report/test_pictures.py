"""Pictures of a report: one grey window, rows and axes pointing down, differences centred at zero."""

import io

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from beamline.report import pictures
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume

pytestmark = pytest.mark.usefixtures("real_pictures")


def _pixels(png: bytes) -> np.ndarray:
    return matplotlib.image.imread(io.BytesIO(png), format="png")


def _levels(png: bytes) -> set[float]:
    """Grey levels of large areas of a picture."""
    pixels = _pixels(png)[..., :3]
    grey = pixels[(np.ptp(pixels, axis=-1) == 0)][:, 0]
    values, counts = np.unique(np.round(grey, 2), return_counts=True)
    return set(values[counts > 2000].tolist())


def test_slices_share_one_window(rng: np.random.Generator) -> None:
    """Two flat volumes of 0 and 1 beside one of 0.5: with one window they are black, white and mid-grey."""
    grid = Grid((20, 24, 28), 0.5)
    volumes = {f"{v}": Volume(np.full(grid.shape, v, np.float32), grid) for v in (0.0, 0.5, 1.0)}
    levels = _levels(pictures.orthogonal_slices(volumes, "mm"))
    assert {0.0, 1.0} <= levels
    assert any(abs(level - 0.5) < 0.02 for level in levels)


def test_y_and_z_run_downwards_in_slices_and_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Row 0 is at the top, as image viewers show it, and the numbers beside it agree."""
    drawn: list[Figure] = []
    monkeypatch.setattr(pictures, "png", lambda figure: drawn.append(figure) or b"")
    data = np.arange(40.0, dtype=np.float32).reshape(4, 10, 1).repeat(10, axis=2)
    pictures.projection(data[:, :, 0][None], Geometry.parallel([0.0], (4, 10)), 0, "mm")
    pictures.orthogonal_slices({"v": Volume(data, Grid(data.shape, 1.0))}, "mm")
    volume = Volume(data, Grid(data.shape, 1.0))
    pictures.differences({"v": volume, "w": volume}, "mm")
    pictures.significance(data[0], volume.grid, 0, "mm")
    axes = [axes for figure in drawn for axes in figure.axes if axes.get_xlabel() in ("u (mm)", "x (mm)", "y (mm)")]
    names = [panel.get_ylabel() for panel in axes]
    assert names == ["← z (mm)", "← y (mm)", "← z (mm)", "← z (mm)", "← y (mm)", "← y (mm)"]
    for panel in axes:
        bottom, top = panel.get_ylim()
        assert (panel.images[0].origin, top < bottom) == ("upper", True)


def test_differences_are_from_the_first_in_one_scale_about_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(pictures, "png", lambda figure: drawn.append(figure) or b"")
    grid = Grid((3, 8, 9), 1.0)
    volumes = {name: Volume(np.full(grid.shape, v, np.float32), grid) for name, v in (("a", 1), ("b", 3), ("c", 0.5))}
    pictures.differences(volumes, "px")
    images = [(axes.get_title(), axes.images[0]) for axes in drawn[0].axes if axes.images]
    assert [title for title, _ in images] == ["b − a", "c − a"]
    for (_, image), value in zip(images, (2.0, -0.5), strict=True):
        np.testing.assert_array_equal(np.asarray(image.get_array()), value)
        assert image.norm.vmin == -image.norm.vmax  # type: ignore[operator]
