"""Pictures for notebooks: PNG files that other programs read, showing the right voxels the right way up."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from matplotlib.image import imread

import recon
from recon.base.greys import fan, middle_slices, png


def _seen(page: str) -> np.ndarray:
    match = re.search(r'src="data:image/png;base64,([^"]+)"', page)
    assert match is not None
    return np.rint(255 * imread(io.BytesIO(base64.b64decode(match[1])))).astype(int)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (300, 7)])
def test_a_png_reads_as_it_was_written(shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    assert np.array_equal(np.rint(255 * imread(io.BytesIO(png(pixels)))), pixels)


def test_three_slices_y_and_z_downwards() -> None:
    data = np.zeros((4, 6, 8), np.float32)
    data[2, 1, 5] = data[1, 3, 2] = data[3, 5, 4] = 1  # in the slices z = 2, y = 3, x = 4
    sheet, (low, high) = middle_slices(data)
    assert sheet.shape == (6, 8 + 4 + 8 + 4 + 6)
    assert low == 0 < high
    assert sheet[1, 5] == sheet[1, 12 + 2] == sheet[3, 24 + 5] > 230


def test_large_volumes_are_thinned_and_odd_values_are_no_error() -> None:
    sheet, _ = middle_slices(np.broadcast_to(np.float32(1), (3, 600, 500)))
    assert max(sheet.shape[0], sheet.shape[1]) < 600
    strange = np.full((2, 3, 4), np.nan, np.float32)
    assert middle_slices(strange)[1] == (0, 1)
    strange[0, 0, 0] = np.inf
    assert (middle_slices(strange)[0] <= 255).all()


def test_rays_run_along_the_views() -> None:
    along_y, along_x = fan(np.array([0.0]), 0.5)[:128], fan(np.array([np.pi / 2]), 0.5)[:128]
    assert (np.unique(np.argwhere(along_y < 100)[:, 1]).tolist(), np.ptp(np.argwhere(along_y < 100)[:, 0]) > 30) == (
        [64],
        True,
    )
    assert np.unique(np.argwhere(along_x < 100)[:, 0]).tolist() == [64]
    assert fan(np.zeros(1), 3.0).max() == 255  # an axis outside the detector


def test_values_show_themselves_in_a_notebook() -> None:
    geometry = recon.Geometry.parallel(np.linspace(0, np.pi, 16, endpoint=False), (2, 12))
    data = np.ones((16, 2, 12), np.float32)
    result = recon.reconstruct(data, geometry, recon.Sirt(iterations=2))
    for value in (geometry, result.volume, result):
        page = value._repr_html_()
        assert np.ptp(_seen(page)) > 0
        assert page.count("<div") == page.count("</div>") == 1
    assert "16 views from 0 to" in geometry._repr_html_()
    assert "after 2 steps" in result._repr_html_() and "sirt" in result._repr_html_()
