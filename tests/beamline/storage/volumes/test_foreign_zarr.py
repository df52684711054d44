"""Zarr of other programs: compressed, both versions, with single time and channel axes, in several scales."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.page.tiles import TileRegion
from beamline.page.volume import ScaledSlices, slices_of
from beamline.storage.foreign_zarr import ZarrScale, open_zarr
from beamline.storage.volume_file import read_volume
from beamline.storage.volumes.files import opened_volume
from tests.messages import refused

SHAPE = 21, 130, 151
VALUES = np.random.default_rng(4).integers(0, 900, SHAPE, dtype=np.uint16)
CHUNK = 8, 64, 64
MICRO = (2.0, 0.5, 0.5)


def _codec(version: int, name: str) -> dict[str, Any]:
    if version == 2:
        from numcodecs import Blosc, Zstd

        return {"compressor": {"blosc": Blosc("lz4"), "zstd": Zstd(3)}[name]}
    from zarr.codecs import BloscCodec, ZstdCodec

    return {"compressors": {"blosc": BloscCodec(cname="lz4"), "zstd": ZstdCodec(level=3)}[name]}


def _halved(values: np.ndarray) -> np.ndarray:
    """Rounded up, as other programs do."""
    return values[::2, ::2, ::2]


def _write(
    path: Path, version: int, codec: str, lead: int = 0, shards: bool = False, unit: str | None = "micrometer"
) -> None:
    zarr = pytest.importorskip("zarr", reason="extra zarr")
    group = zarr.create_group(str(path), zarr_format=version)
    names = "tczyx"[2 - lead :]
    axes = [{"name": name, "type": "space" if name in "zyx" else "time"} for name in names]
    for axis in axes[lead:]:
        axis |= {"unit": unit} if unit else {}
    datasets = []
    for n, values in enumerate((VALUES, _halved(VALUES))):
        one = (1,) * lead
        more = {"shards": (*one, 16, 64, 128)} if shards else {}
        array = group.create_array(
            f"s{n}",
            shape=(*one, *values.shape),
            chunks=(*one, *CHUNK),
            dtype=values.dtype,
            **_codec(version, codec),
            **more,
        )
        array[:] = values.reshape(*one, *values.shape)
        scale = [1.0] * lead + [2**n * each for each in MICRO]
        datasets.append({"path": f"s{n}", "coordinateTransformations": [{"type": "scale", "scale": scale}]})
    image = [{"axes": axes, "datasets": datasets}]
    group.attrs.update({"multiscales": image} if version == 2 else {"ome": {"version": "0.5", "multiscales": image}})


@pytest.mark.parametrize("lead", [0, 2])
@pytest.mark.parametrize("codec", ["blosc", "zstd"])
@pytest.mark.parametrize("version", [2, 3])
def test_a_compressed_one_is_read_in_its_scales_and_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int, codec: str, lead: int
) -> None:
    monkeypatch.setattr("beamline.page.tiles.MOST", 80)
    _write(path := tmp_path / "v.zarr", version, codec, lead)
    with opened_volume(path) as record:
        data = record.volume.data
        assert (record.length_unit, record.volume.grid.spacing) == ("mm", pytest.approx((2e-3, 5e-4, 5e-4)))
        np.testing.assert_array_equal(data[3:9], VALUES[3:9])
        assert isinstance(data, ZarrScale) and data.dtype == np.uint16 and data.chunk == CHUNK
        np.testing.assert_array_equal(data.box((1, 60, 70), (20, 130, 90)), VALUES[1:20, 60:130, 70:90])
        (half,) = data.coarser
        np.testing.assert_array_equal(half[:], _halved(VALUES))
        shown = slices_of(path, data, 2**20)
        assert isinstance(shown, ScaledSlices)
        part, region, bin_ = shown.part(1, 100, TileRegion(0, 21, 0, 151))
        assert (bin_, region.slices) == (2, (slice(0, 22), slice(0, 152)))
        np.testing.assert_array_equal(part, _halved(VALUES)[:, 50])
    values, spacing = read_volume(path)
    np.testing.assert_array_equal(values, VALUES)
    assert spacing == pytest.approx((2e-3, 5e-4, 5e-4))


def test_shards_and_an_array_by_its_name_are_read(tmp_path: Path) -> None:
    _write(path := tmp_path / "v.zarr", 3, "zstd", shards=True)
    with opened_volume(path, "s1") as record:
        np.testing.assert_array_equal(record.volume.data[:], _halved(VALUES))
        assert record.volume.grid.spacing == pytest.approx((4e-3, 1e-3, 1e-3))
    with opened_volume(path / "s0") as record:
        np.testing.assert_array_equal(record.volume.data[:], VALUES)
        assert record.length_unit == "px"


def test_what_is_no_volume_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zarr = pytest.importorskip("zarr", reason="extra zarr")
    zarr.create_group(str(tmp_path / "bare.zarr"))
    zarr.create_array(str(tmp_path / "channels.zarr"), shape=(3, 4, 4, 4), dtype="u1", chunks=(1, 4, 4, 4))
    _write(tmp_path / "cut.zarr", 3, "zstd")
    for name, said in (("bare", "Name one of its arrays"), ("channels", "one time and one channel")):
        with pytest.raises(DataError, match=said), opened_volume(tmp_path / f"{name}.zarr"):
            pass
    with refused(DataError), opened_volume(tmp_path / "bare.zarr", "nothing"):
        pass
    chunk = next(path for path in (tmp_path / "cut.zarr/s0/c").rglob("*") if path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:20])
    with opened_volume(tmp_path / "cut.zarr") as record, refused(DataError):
        _ = record.volume.data[:]
    monkeypatch.setitem(sys.modules, "zarr", None)
    with refused(DataError), opened_volume(tmp_path / "bare.zarr"):
        pass


@pytest.mark.parametrize("coarser", ["group", "image", "empty"])
def test_a_coarser_scale_that_is_no_volume_is_left_out(tmp_path: Path, coarser: str) -> None:
    _write(tmp_path / "v.zarr", 3, "zstd")
    group = pytest.importorskip("zarr").open_group(str(tmp_path / "v.zarr"))
    del group["s1"]
    if coarser == "group":
        group.create_group("s1")
    else:
        group.create_array(
            "s1",
            shape={"image": (65, 76), "empty": (0, 65, 76)}[coarser],
            dtype="u2",
            chunks=(8,) * (2 + (coarser == "empty")),
        )
    finest, _ = open_zarr(tmp_path / "v.zarr")
    assert (finest.shape, finest.coarser) == (SHAPE, ())


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf, True, "1"])
def test_a_voxel_without_a_size_is_refused(tmp_path: Path, scale: float) -> None:
    _write(tmp_path / "v.zarr", 2, "zstd")
    group = pytest.importorskip("zarr").open_group(str(tmp_path / "v.zarr"))
    said = group.attrs["multiscales"]
    said[0]["datasets"][0]["coordinateTransformations"] = [{"type": "scale", "scale": [1.0, 1.0, scale]}]
    group.attrs["multiscales"] = said
    with refused(DataError):
        open_zarr(tmp_path / "v.zarr")
