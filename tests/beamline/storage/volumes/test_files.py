"""Volume files: every format gives back what was written, to other programs and to us; complete or absent."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import describe, validate
from beamline.storage.readers.open import open_scan
from beamline.storage.recon_record import ReconRecord, Value
from beamline.storage.volumes import formats, suffixes_text
from beamline.storage.volumes.base import Pixels, Slices, facts_of, record_of
from beamline.storage.volumes.files import format_of, opened_volume, volume_format, write_volume
from beamline.storage.volumes.images import tiff
from recon.base.volume import Grid, Volume
from tests.messages import refused

SHAPE = 3, 4, 5
VALUES = ((np.arange(60.0).reshape(SHAPE) - 7) / 8).astype(np.float32)
RECORD = ReconRecord(
    volume=Volume(VALUES, Grid(SHAPE, 0.25, (0.5, 0.0, -1.0), slice_pitch=0.375)),
    length_unit="mm",
    raw_file="scan.h5",
    title='a "test" of \\ µm',
    sample="battery",
    time=1795150000.0,
    parameters={"axis_col": 85.75, "views": np.array([0, 2, 4]), "method": "fbp", "seed": 3},
    metrics={"residual": 0.125},
)
AS_NUMBERS = ("v.h5",)
NAMES = ("v.h5", "v.tif", "v", "v.ome.zarr", "v.npy", "v.nrrd")


def test_the_suffix_names_the_format() -> None:
    suffixes = [suffix for kind in formats() for suffix in kind.suffixes]
    assert len(suffixes) == len(set(suffixes))
    assert all(kind.suffixes[0] in suffixes_text() for kind in formats())  # in help
    assert [format_of(Path(name)) for name in NAMES] == list(formats())
    assert format_of(Path("V.TIFF")) is format_of(Path("v.tif"))
    for name in ("v.zip", "v.png", "v.html", "scan_v1.2", ".h5", ""):
        with pytest.raises(ValueError, match=r"volume"):
            format_of(Path(name))


@pytest.mark.parametrize("name", NAMES)
def test_everything_that_a_format_holds_comes_back(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    assert write_volume(path, RECORD) == 0
    assert list(tmp_path.iterdir()) == [path]
    assert volume_format(path) is format_of(path)
    with opened_volume(path) as read:
        data = read.volume.data
        np.testing.assert_array_equal(data[:], VALUES)
        np.testing.assert_array_equal(data[1:3], VALUES[1:3])
        assert (data.shape, data.dtype) == (SHAPE, np.float32)
        if name != "v.npy":
            assert (read.title, read.sample, read.raw_file, read.time) == (
                RECORD.title, "battery", "scan.h5", RECORD.time
            )  # fmt: skip
            assert read.volume.grid == RECORD.volume.grid
            assert (read.parameters["method"], read.metrics) == ("fbp", {"residual": 0.125})
    assert {finding.severity for finding in validate(path)} == {"info"}


@pytest.mark.parametrize("name", [name for name in NAMES if name != "v.npy"])  # which has the voxels alone
def test_numbers_that_are_not_finite_harm_no_format(tmp_path: Path, name: str) -> None:
    """Rays of a fit have an infinite limit by default, and a residual of nothing is NaN. HDF5 has such numbers; JSON
    has null for them."""
    numbers: dict[str, Value] = {
        "rays_exact_above": math.inf,
        "lowest": -math.inf,
        "unknown": math.nan,
        "text": "NaN",
        "seed": 3,
    }
    record = replace(RECORD, parameters=numbers, metrics={"residual": math.nan, "psnr": math.inf})
    write_volume(tmp_path / name, record)
    with opened_volume(tmp_path / name) as read:
        kept = numbers if name in AS_NUMBERS else {"text": "NaN", "seed": 3}
        assert repr(dict(sorted(read.parameters.items()))) == repr(dict(sorted(kept.items())))
        psnr = math.inf if name in AS_NUMBERS else math.nan
        assert repr(dict(sorted(read.metrics.items()))) == repr({"psnr": psnr, "residual": math.nan})
        for other in NAMES:
            write_volume(tmp_path / f"again_{other}", read)


def test_a_file_of_an_earlier_version_has_null_in_place_of_such_a_number() -> None:
    facts = {**facts_of(RECORD, Pixels()), "parameters": {"seed": 3, "rays": None}, "metrics": {"snr": None}}
    read = record_of(Path("v.tif"), facts, VALUES)
    assert read.parameters == {"seed": 3} and math.isnan(read.metrics["snr"])


def test_other_programs_read_the_same(tmp_path: Path) -> None:
    for name in NAMES:
        write_volume(tmp_path / name, RECORD)
    np.testing.assert_array_equal(np.load(tmp_path / "v.npy"), VALUES)
    with tifffile.TiffFile(tmp_path / "v.tif") as tif:
        np.testing.assert_array_equal(tif.asarray(), VALUES)
        assert len(tif.pages) == SHAPE[0]
        assert (tif.is_imagej, tif.series[0].axes) == (True, "ZYX")
    slices = sorted((tmp_path / "v").iterdir())
    assert [path.name for path in slices] == ["slice_00000.tif", "slice_00001.tif", "slice_00002.tif"]
    np.testing.assert_array_equal([tifffile.imread(path) for path in slices], VALUES)
    header, _, data = (tmp_path / "v.nrrd").read_bytes().partition(b"\n\n")
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(SHAPE), VALUES)
    fields = dict(line.split(": ", 1) for line in header.decode("ascii").splitlines()[1:-1])
    assert header.startswith(b"NRRD0004\n")
    assert (fields["sizes"], fields["encoding"], fields["endian"]) == ("5 4 3", "raw", "little")
    assert fields["space origin"] == "(-1.5,-0.375,0.125)"  # centre of the first voxel, x first
    assert fields["space directions"] == "(0.25,0,0) (0,0.25,0) (0,0,0.375)"
    with h5py.File(tmp_path / "v.h5") as file:
        np.testing.assert_array_equal(file["entry/data/data"][:], VALUES)


@pytest.mark.parametrize(("bits", "greatest"), [(8, 255), (16, 65535)])
@pytest.mark.parametrize("name", ["g.tif", "g", "g.npy", "g.nrrd", "g.zarr"])
def test_grey_values_are_the_window_to_half_a_step(tmp_path: Path, name: str, bits: int, greatest: int) -> None:
    low, high = -0.5, 5.0
    values = VALUES.copy()
    values[1, 0, 0] = np.nan
    record = replace(RECORD, volume=Volume(values, RECORD.volume.grid))
    clipped = write_volume(tmp_path / name, record, Pixels(bits, (low, high)))
    assert clipped == 1 + VALUES.size - np.count_nonzero(np.clip(VALUES, low, high) == VALUES)
    with opened_volume(tmp_path / name) as read:
        grey = np.asarray(read.volume.data[:])
        assert (grey.dtype.itemsize * 8, grey.min(), grey.max()) == (bits, 0, greatest)
        if name != "g.npy":
            np.testing.assert_array_equal(read.parameters["window"], [low, high])
    back = low + grey.astype(float) * (high - low) / greatest
    step = (high - low) / greatest
    known = np.isfinite(values)
    np.testing.assert_allclose(back[known], np.clip(VALUES, low, high)[known], rtol=0, atol=step * (0.5 + 1e-6))
    assert grey[1, 0, 0] == 0


@pytest.mark.parametrize("name", NAMES)
def test_a_failure_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The disk is full at the second slice."""

    class Full:
        def __getitem__(self, part: slice) -> np.ndarray:
            if part.start or part.stop > 1:
                raise OSError(28, "No space left on device")
            return VALUES[part]

    record = replace(RECORD, volume=Volume(VALUES, RECORD.volume.grid))
    object.__setattr__(record.volume, "data", Full())
    with pytest.raises(DataError, match="No space left"):
        write_volume(tmp_path / name, record)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("precious")
    with refused(DataError):
        write_volume(tmp_path / name, RECORD)
    assert (tmp_path / name).read_text() == "precious"
    assert list(tmp_path.iterdir()) == [tmp_path / name]


@pytest.mark.parametrize(("unit", "name"), [("mm", "mm"), ("px", "pixel")])
def test_imagej_sees_a_stack_along_z_with_the_edges_of_a_voxel(tmp_path: Path, unit: str, name: str) -> None:
    write_volume(tmp_path / "v.tif", replace(RECORD, length_unit=unit))
    with tifffile.TiffFile(tmp_path / "v.tif") as tif:
        said = tif.imagej_metadata or {}
        assert (said["slices"], said["spacing"], said["unit"]) == (3, 0.375, name)
        assert [tif.pages.first.tags[f"{axis}Resolution"].value for axis in "XY"] == [(4, 1)] * 2  # pixels per unit
        assert tif.pages.first.tags["ResolutionUnit"].value == 1  # that of the description


def test_large_volumes_are_a_bigtiff_of_ome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff, "CLASSIC_TIFF_BYTES", VALUES.nbytes)
    write_volume(tmp_path / "v.tif", RECORD)
    with tifffile.TiffFile(tmp_path / "v.tif") as tif:
        assert (tif.is_bigtiff, tif.series[0].axes) == (True, "ZYX")
        np.testing.assert_array_equal(tif.asarray(), VALUES)
        for size in ('PhysicalSizeZ="0.375"', 'PhysicalSizeY="0.25"', 'PhysicalSizeXUnit="mm"'):
            assert size in (tif.ome_metadata or "")
    with opened_volume(tmp_path / "v.tif") as read:
        np.testing.assert_array_equal(read.volume.data[:], VALUES)
        assert (read.volume.grid, read.title) == (RECORD.volume.grid, RECORD.title)
    with refused(DataError):
        open_scan(tmp_path / "v.tif")


@pytest.mark.parametrize("name", ["v.h5", "v.tif", "v.nrrd"])
def test_a_file_cut_off_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_volume(path, RECORD)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=path.name), opened_volume(path) as read:
        np.asarray(read.volume.data[:])
    assert [finding.severity for finding in validate(path)] == ["error"]


def test_a_slice_that_is_missing_or_another_is_refused(tmp_path: Path) -> None:
    write_volume(tmp_path / "v", RECORD)
    (tmp_path / "v/slice_00001.tif").unlink()
    (finding,) = validate(tmp_path / "v")
    assert (finding.severity, "1 of 3 slices" in finding.message) == ("error", True)
    tifffile.imwrite(tmp_path / "v/slice_00001.tif", VALUES[1, :2])
    (finding,) = validate(tmp_path / "v")
    assert "slice 0 has" in finding.message


def test_only_one_slice_is_in_memory_at_a_time() -> None:
    asked = []

    class Data:
        def __getitem__(self, part: slice) -> np.ndarray:
            asked.append((part.start, part.stop))
            return VALUES[part]

    volume = Volume(VALUES, RECORD.volume.grid)
    object.__setattr__(volume, "data", Data())
    assert len(list(Slices(volume, Pixels()))) == 3
    assert asked == [(0, 1), (1, 2), (2, 3)]


@pytest.mark.parametrize(
    ("values", "said"), [(np.full(SHAPE, 2.0), "Every voxel is 2"), (np.where(VALUES > 3, np.nan, VALUES), "NaN")]
)
def test_what_no_volume_should_hold_is_found(tmp_path: Path, values: np.ndarray, said: str) -> None:
    write_volume(tmp_path / "v.tif", replace(RECORD, volume=Volume(values.astype(np.float32), RECORD.volume.grid)))
    assert [said in f.message for f in validate(tmp_path / "v.tif") if f.severity == "error"] == [True]


@pytest.mark.parametrize(("edge", "unit", "spacing"), [(0.25, "mm", 0.25), (1.0, "px", 1.0)])
def test_a_volume_of_the_library_is_a_volume(tmp_path: Path, edge: float, unit: str, spacing: float) -> None:
    """An edge of 1 is that of a pixel whose size the caller did not state."""
    Volume(VALUES, Grid(SHAPE, edge)).save(tmp_path / "v.npz", settings="{}")
    assert volume_format(tmp_path / "v.npz") is not None
    with opened_volume(tmp_path / "v.npz") as read:
        np.testing.assert_array_equal(read.volume.data, VALUES)
        assert (read.length_unit, read.volume.grid.spacing) == (unit, (spacing,) * 3)
    described = describe(tmp_path / "v.npz")
    assert described["format"] == "volume, npz"


def test_an_archive_with_a_single_array_is_a_volume(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "v.npz", VALUES)
    np.savez(tmp_path / "scan.npz", projections=VALUES, angles=np.arange(3.0))
    np.savez(tmp_path / "angles.npz", np.arange(3.0))
    (tmp_path / "no.npz").write_bytes(b"PK\x03\x04")
    assert volume_format(tmp_path / "v.npz") is not None
    for name in ("scan.npz", "angles.npz", "no.npz"):
        assert volume_format(tmp_path / name) is None


def test_a_scan_is_no_volume(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "scan.tif", VALUES, photometric="minisblack")
    np.save(tmp_path / "angles.npy", np.arange(5.0))
    (tmp_path / "text.nrrd").write_text(json.dumps({"format": "x"}))
    (tmp_path / "empty").mkdir()
    for name in ("scan.tif", "angles.npy", "text.nrrd", "empty", "missing.h5"):
        assert volume_format(tmp_path / name) is None
