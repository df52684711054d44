"""Sheets of images."""

import io

import matplotlib.image
import numpy as np
import pytest

from beamline.report.sheets import reference_sheet

pytestmark = pytest.mark.usefixtures("real_pictures")


def _pixels(png: bytes) -> np.ndarray:
    return np.asarray(matplotlib.image.imread(io.BytesIO(png)))


def test_the_sheet_of_darks_and_flats(rng: np.random.Generator) -> None:
    images = {title: rng.random((20, 30), dtype=np.float32) for title in ("dark", "flats", "last flats / first")}
    assert _pixels(reference_sheet(images, (200, 300))).ndim == 3
    assert _pixels(reference_sheet({"dark": images["dark"][:1]}, (2, 300))).ndim == 3
