"""Sheets of images."""

import io

import matplotlib.image
import numpy as np
import pytest

from beamline.report.sheets import reference_sheet

pytestmark = pytest.mark.usefixtures("real_pictures")


def _pixels(png: bytes) -> np.ndarray:
    return np.asarray(matplotlib.image.imread(io.BytesIO(png)))


@pytest.mark.parametrize("rows", [20, 1])
def test_the_sheet_of_darks_and_flats_shows_each_as_it_is_in_its_own_window(rows: int) -> None:
    """A picture that is dark on the left, its mirror image beside the same other picture, and brighter ones."""
    step = np.repeat(np.array([[0, 1]], np.float32), 15, axis=1).repeat(rows, axis=0)
    own, mirrored, brighter = (
        _pixels(reference_sheet({"dark": image, "flats": step}, (10 * rows, 300))).mean(axis=2)
        for image in (step, step[:, ::-1], 50 * step)
    )
    changed = np.flatnonzero((own != mirrored).any(axis=0))
    assert changed[0] > 0 and changed[-1] < own.shape[1] / 2  # the other panel is the same
    left, right = ((own - mirrored)[:, part].mean() for part in np.array_split(changed, 2))
    assert left < -0.1 and right > 0.1
    panel = own[:, changed[0] : changed[-1]]
    assert np.abs(panel - brighter[:, changed[0] : changed[-1]]).max() < 0.01
