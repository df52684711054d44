"""TIFFs without a number type: floats are recognised by their bits, integers stay integers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from beamline.storage.readers.transforms import real_type
from drivers.base.frame import FrameKind
from tests.beamline.scans import TwoCylinders

LINES = TwoCylinders().line_integrals()[:6]
LINES = LINES + 0.005 * np.random.default_rng(0).standard_normal(LINES.shape)
IMAGES = {"line-integrals": LINES, "transmission": np.exp(-LINES), "counts": 40_000 * np.exp(-LINES) + 100}


def written(path: Path, images: NDArray[np.generic]) -> Path:
    """A stack whose file says no type: tifffile leaves out that of unsigned whole numbers."""
    tifffile.imwrite(path, images.view(f"u{images.dtype.itemsize}"), photometric="minisblack", metadata=None)
    return path


@pytest.mark.parametrize("quantity", IMAGES)
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_reals_are_read_as_such(tmp_path: Path, quantity: Any, kind: Any) -> None:
    images = IMAGES[quantity].astype(kind)
    with open_scan(SourceOptions(written(tmp_path / "s.tif", images), quantity=quantity)) as source:
        assert source.dtype == kind and "pixels" in source.attributes
        views = source.table.views  # transmission has references in front
        np.testing.assert_array_equal(source.read(views), images)
    np.testing.assert_array_equal(load_images(tmp_path / "s.tif", FrameKind.FLAT), images)


@pytest.mark.parametrize("level", [50, 3_000, 15_000, 40_000, 60_000])
@pytest.mark.parametrize("frames", [1, 1_000, 30_000])
def test_counts_stay_whole(level: float, frames: int) -> None:
    rng, beam = np.random.default_rng(1), level * np.exp(-TwoCylinders().line_integrals()[:6])
    counts = np.rint(frames * beam + np.sqrt(frames * beam) * rng.standard_normal(beam.shape)).clip(0)
    for kind in (np.uint16, np.uint32, np.uint64):
        images = counts.clip(0, np.iinfo(kind).max).astype(kind)
        assert real_type(images) is None


def test_a_scale_beside_images_of_cil(tmp_path: Path) -> None:
    scale, offset = 65535 / np.ptp(LINES), -LINES.min() * 65535 / np.ptp(LINES)
    for i, image in enumerate(LINES):
        tifffile.imwrite(tmp_path / f"p_idx_{i:04d}.tiff", np.rint(image * scale + offset).astype(np.uint16))
    (tmp_path / "scaleoffset.json").write_text(json.dumps({"scale": scale, "offset": offset}))
    with open_scan(tmp_path) as source:
        assert source.dtype == np.float32
        np.testing.assert_allclose(source.read([3, 1]), LINES[[3, 1]], atol=1 / scale)
