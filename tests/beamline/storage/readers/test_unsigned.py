"""Counts beyond a signed type are read as unsigned; values that are negative for other reasons are not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.reference_files import load_images
from beamline.storage.readers.transforms import type_wrapped
from drivers.base.frame import FrameKind
from tests.beamline.scans import TwoCylinders, write_exchange, write_nxtomo

SCAN = TwoCylinders()


@given(
    beam=st.floats(33_500, 65_000),
    noise=st.floats(0, 300),
    seed=st.integers(0, 99),
    sign=st.sampled_from([np.int16, ">i2"]),
)
def test_counts_that_wrapped_are_told_at_any_level_of_light(beam: float, noise: float, seed: int, sign: Any) -> None:
    rng = np.random.default_rng(seed)
    views = beam * np.exp(-SCAN.line_integrals()[:6]) + noise * rng.standard_normal((6, *SCAN.shape))
    counts = views.clip(0, 65535).astype(np.uint16)
    assert type_wrapped(counts.astype(">u2").view(">i2").astype(sign)) == np.dtype(sign).str.replace("i", "u")
    flat = np.full((2, 4, 40), beam) + noise * rng.standard_normal((2, 4, 40))
    if np.unique(flat.astype(np.uint16)).size > 1 and flat.max() < 65535:
        assert type_wrapped(flat.astype(np.uint16).view(np.int16)) == np.uint16


@given(beam=st.floats(0, 32_000), noise=st.floats(0, 300), marked=st.sampled_from([None, -1, -32768]))
def test_counts_that_fit_are_left_as_they_are(beam: float, noise: float, marked: int | None) -> None:
    rng = np.random.default_rng(1)
    views = (beam * np.exp(-SCAN.line_integrals()[:6]) + noise * rng.standard_normal((6, *SCAN.shape))).clip(-3e4, 3e4)
    counts = views.astype(np.int16)
    if marked is not None:
        counts = np.maximum(counts, 0)
        counts[:, 1, 10:20] = marked
    assert all(type_wrapped(counts.astype(kind)) is None for kind in (np.int16, np.int32, np.float32))


@pytest.mark.parametrize("kind", ["tiff", "exchange", "nxtomo"])
def test_they_are_read_from_any_format_and_named(tmp_path: Path, kind: str) -> None:
    counts, path = SCAN.counts(40_000), tmp_path / "s.h5"
    flats, darks = np.full((2, *SCAN.shape), 40_100, np.uint16), np.full((2, *SCAN.shape), 100, np.uint16)
    flats[:, 0, 0] += 5
    if kind == "tiff":
        path = tmp_path / "s.tif"
        tifffile.imwrite(path, counts.view(np.int16), photometric="minisblack")
        tifffile.imwrite(tmp_path / "f.tif", flats.view(np.int16), photometric="minisblack")
        options = SourceOptions(path, angles=SCAN.angles, darks=darks, flats=tmp_path / "f.tif")
        np.testing.assert_array_equal(load_images(tmp_path / "f.tif", FrameKind.FLAT), flats)
    else:
        if kind == "exchange":
            images = {"data": counts, "data_white": flats, "data_dark": darks}
            write_exchange(path, SCAN, {name: counted.view(np.int16) for name, counted in images.items()})
        else:
            frames, keys = np.concatenate([darks, flats, counts]), np.repeat([2, 1, 0], [2, 2, len(counts)])
            write_nxtomo(path, frames.view(np.int16), keys, np.degrees(np.r_[np.zeros(4), SCAN.angles]))
        options = SourceOptions(path)
    with open_scan(options) as source:
        assert source.dtype == np.uint16 and source.quantity == "counts"
        np.testing.assert_array_equal(source.read(np.flatnonzero(source.table.kinds == 0)), counts)
        np.testing.assert_array_equal(source.read(np.flatnonzero(source.table.kinds == 1)), flats)
        np.testing.assert_array_equal([frame.counts for frame in source.frames()][-1], counts[-1])
    assert any("int16 that overflowed, read as uint16" in finding.message for finding in validate(options))


@pytest.mark.parametrize("flats_as", [np.uint16, np.int16])
def test_views_that_wrapped_beside_flats_of_another_type_are_read(tmp_path: Path, flats_as: type) -> None:
    counts = SCAN.counts(40_000)
    flats = np.full((2, *SCAN.shape), 40_100, np.uint16)
    flats[:, 0, 0] += 5
    changes = {"data": counts.view(np.int16), "data_white": flats.view(flats_as)}
    with open_scan(write_exchange(tmp_path / "s.h5", SCAN, changes)) as source:
        assert source.dtype == np.uint16 and "overflowed" in str(source.attributes["pixels"])
        np.testing.assert_array_equal(source.read(source.table.views), counts)
        np.testing.assert_array_equal(source.read(source.table.flats), flats)
