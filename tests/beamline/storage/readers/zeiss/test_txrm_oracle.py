"""A .txrm compared with txrm2tiff's reading of it (Diamond Light Source; extra "oracle")."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.storage.readers.open import open_scan
from tests.beamline.storage.compound import write_compound
from tests.beamline.storage.readers.zeiss.test_txrm import VIEWS, streams

theirs = pytest.importorskip("txrm2tiff.txrm")


@pytest.mark.parametrize("dtype", ["<u2", "<f4"])
def test_images_angles_exposures_and_scale_are_those_of_txrm2tiff(tmp_path: Path, dtype: str) -> None:
    path = write_compound(tmp_path / "s.txrm", streams(VIEWS.astype(dtype)))
    with theirs.open_txrm(path, strict=True) as txrm, open_scan(path) as ours:
        views = ours.table.views
        (flat,) = ours.table.flats
        np.testing.assert_array_equal(ours.read(views), txrm.get_images())
        np.testing.assert_array_equal(ours.read([flat])[0], txrm.get_reference())
        np.testing.assert_allclose(np.degrees(ours.table.angles[views]), txrm.image_info["Angles"], atol=1e-12)
        assert ours.table.exposures[views].tolist() == txrm.exposures
        assert ours.table.exposures[flat] == txrm.reference_exposure
        assert ours.pixel_size_mm == pytest.approx(1e-3 * txrm.image_info["PixelSize"][0])  # µm
