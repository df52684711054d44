"""OME-Zarr: every scale is the mean of the previous one, at the right position, for us and the format's library."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.volumes.files import opened_volume, write_volume
from recon.base.volume import Grid, Volume
from tests.beamline.storage.volumes.test_files import RECORD

SHAPE = 35, 40, 530
VALUES = np.random.default_rng(4).normal(size=SHAPE).astype(np.float32)
GRID = Grid(SHAPE, 0.25, (0.5, 0.0, -1.0))
LARGE = replace(RECORD, volume=Volume(VALUES, GRID))


def _halved(values: np.ndarray) -> np.ndarray:
    z, y, x = (n // 2 for n in values.shape)
    return values[: 2 * z, : 2 * y, : 2 * x].astype(np.float64).reshape(z, 2, y, 2, x, 2).mean(axis=(1, 3, 5))


def _array(folder: Path) -> np.ndarray:
    """An array of raw chunks, put together from its files by the words of the specification."""
    said = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
    shape, chunk = said["shape"], said["chunk_grid"]["configuration"]["chunk_shape"]
    out = np.full(shape, np.nan)
    for index in np.ndindex(*(-(-n // m) for n, m in zip(shape, chunk, strict=True))):
        raw = np.frombuffer((folder / "c" / "/".join(map(str, index))).read_bytes(), said["data_type"]).reshape(chunk)
        where = tuple(slice(i * m, min((i + 1) * m, n)) for i, m, n in zip(index, chunk, shape, strict=True))
        out[where] = raw[tuple(slice(part.stop - part.start) for part in where)]
    return out


def test_scales_are_means_in_their_places(tmp_path: Path) -> None:
    write_volume(tmp_path / "v.ome.zarr", LARGE)
    said = json.loads((tmp_path / "v.ome.zarr/zarr.json").read_text(encoding="utf-8"))["attributes"]["ome"]
    (image,) = said["multiscales"]
    assert [axis["name"] + axis["unit"] for axis in image["axes"]] == ["zmillimeter", "ymillimeter", "xmillimeter"]
    assert [dataset["path"] for dataset in image["datasets"]] == ["0", "1", "2"]
    expected, first = VALUES.astype(np.float64), np.array([centres[0] for centres in GRID.coordinates()])
    for n, dataset in enumerate(image["datasets"]):
        np.testing.assert_allclose(_array(tmp_path / "v.ome.zarr" / dataset["path"]), expected, atol=1e-6)
        scale, translation = dataset["coordinateTransformations"]
        np.testing.assert_allclose(scale["scale"], 0.25 * 2**n)
        np.testing.assert_allclose(translation["translation"], first + 0.25 * (2**n - 1) / 2)
        expected = _halved(expected)
    with opened_volume(tmp_path / "v.ome.zarr") as read:
        np.testing.assert_array_equal(read.volume.data[14:18], VALUES[14:18])  # of two rows of chunks
        np.testing.assert_array_equal(read.volume.data[::7], VALUES[::7])


def test_a_folder_that_lost_chunks_is_refused(tmp_path: Path) -> None:
    write_volume(tmp_path / "v.zarr", LARGE)
    (tmp_path / "v.zarr/0/c/1/0/2").unlink()
    with pytest.raises(DataError, match="1 of 9 chunks"), opened_volume(tmp_path / "v.zarr"):
        pass
    assert [finding.severity for finding in validate(tmp_path / "v.zarr")] == ["error"]
    (tmp_path / "v.zarr/0/zarr.json").unlink()
    with pytest.raises(DataError, match="as a Zarr"), opened_volume(tmp_path / "v.zarr"):
        pass
