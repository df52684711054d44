"""`beamline export`: formats, grey values, errors, and files."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import opened_volume, write_volume
from recon.base.decisions import MaterialPrior
from tests.beamline.cli.small_scan import beamline

VALUES = np.linspace(-0.1, 1.1, 60, dtype=np.float32).reshape(3, 4, 5)


@pytest.fixture
def volume(folder: Path) -> Path:
    record = bare_record(folder / "scan.h5", VALUES, (0.5, 0.5, 0.5))
    write_volume(folder / "v.h5", replace(record, parameters={"method": "fbp"}))
    return folder


def test_values_stay_as_they_are(volume: Path) -> None:
    for name in ("v.tif", "v", "v.npy", "v.nrrd", "copy.h5"):
        result = beamline("export", "v.h5", "-o", name)
        assert result.exit_code == 0, result.output
        with opened_volume(volume / name) as read:
            np.testing.assert_array_equal(read.volume.data[:], VALUES)
    assert beamline("export", "v", "-o", "again.h5").exit_code == 0
    with opened_volume(volume / "again.h5") as read, opened_volume(volume / "v.h5") as first:
        np.testing.assert_array_equal(read.volume.data[:], VALUES)
        assert (read.volume.grid, read.parameters) == (first.volume.grid, first.parameters)


def test_volumes_of_others(folder: Path) -> None:
    np.savez(folder / "other.npz", v=VALUES, voxel_mm=0.5)
    assert beamline("export", "other.npz", "-o", "v.h5").exit_code == 0
    with opened_volume(folder / "v.h5") as read:
        np.testing.assert_array_equal(read.volume.data[:], VALUES)
        assert (read.volume.grid.voxel_size, read.length_unit) == (0.5, "mm")


def test_grey_values_say_what_was_clipped(volume: Path) -> None:
    result = beamline("export", "v.h5", "-o", "g.tif", "--bits", "8", "--window", "0:1", "--json")
    assert result.exit_code == 0, result.output
    done = json.loads(result.stdout.splitlines()[-1])
    outside = float(((VALUES < 0) | (VALUES > 1)).mean())
    assert (done["bits"], done["window"], done["clipped"]) == (8, [0.0, 1.0], pytest.approx(outside))
    grey = tifffile.imread(volume / "g.tif")
    assert grey.dtype == np.uint8
    assert np.abs(grey / 255 - np.clip(VALUES, 0, 1)).max() <= 0.5 / 255 + 1e-6


def test_probabilities_of_a_material(folder: Path) -> None:
    """Of a volume at two levels a tenth apart, with noise in each."""
    values = np.where(np.arange(512).reshape(8, 8, 8) % 8 < 4, 0.1, 0.2).astype(np.float32)
    known = dict(zip(MaterialPrior._fields, MaterialPrior((0.1, 0.2), (0.5, 0.5), 1.0, 0.02), strict=True))
    settings = {f"{name}_of_materials": np.array(value) for name, value in known.items()}
    record = bare_record(folder / "scan.h5", values, (0.5, 0.5, 0.5))
    write_volume(folder / "v.h5", replace(record, parameters={"method": "discrete", **settings}))
    assert beamline("export", "v.h5", "-o", "p.h5", "--material", "2").exit_code == 0
    with opened_volume(folder / "p.h5") as read:
        inside = read.volume.data[:][:, :, 6]
        assert read.unit == "" and inside.min() > 0.5 and read.volume.data[:][:, :, 1].max() < 0.1
    for name, number, said in (
        ("v.h5", "3", "materials of this volume are 1 to 2"),
        ("p.h5", "1", "no discrete levels"),
    ):
        refused = beamline("export", name, "-o", "q.h5", "--material", number)
        assert refused.exit_code == 5 and said in refused.stderr


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([], "Every voxel in the slices that were read is 0, so no window"),
        ([((3, 4, 5), 2.5)], "--window 0:2.5 "),
        ([(0, 1.5)], "--window 0:1.5 "),
        ([(..., 1.0), ((..., slice(0, 3)), 1e-6)], "--window 1:1.000001 "),
        ([(..., np.nan)], "The slices that were read have no finite value"),
    ],
)
def test_a_window_is_proposed_that_can_be_given(folder: Path, values: list[Any], said: str) -> None:
    data = np.zeros((9, 40, 40), np.float32)
    for where, value in values:
        data[where] += np.float32(value)
    np.save(folder / "v.npy", data)
    result = beamline("export", "v.npy", "-o", "g.tif", "--bits", "16")
    assert result.exit_code == 2 and said in result.stderr
    if (window := re.search(r"--window (\d\S*:\S+) ", result.stderr)) is not None:
        assert beamline("export", "v.npy", "-o", "g.tif", "--bits", "16", "--window", window[1]).exit_code == 0
        assert np.ptp(tifffile.imread(folder / "g.tif")) > 30_000


def test_a_folder_of_slices_of_another_program_is_a_volume(folder: Path) -> None:
    data = np.random.default_rng(2).random((12, 8, 9)).astype(np.float32)
    (folder / "slices").mkdir()
    for z, values in enumerate(data):
        tifffile.imwrite(folder / f"slices/rec_{z}.tif", values)  # 9 before 10, as numbers
    (folder / "slices/._rec_0.tif").write_bytes(b"\0\5\26\7")
    assert beamline("export", "slices", "-o", "v.npy").exit_code == 0
    np.testing.assert_array_equal(np.load(folder / "v.npy"), data)
    tifffile.imwrite(folder / "slices/rec_12.tif", data[0, :4])
    assert (
        "rec_12.tif has the type float32 and the shape (4, 9); expected slices [y, x] of the type float32 and the"
        in beamline("export", "slices", "-o", "w.npy").stderr
    )
