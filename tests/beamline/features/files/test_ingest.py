"""ingest: the file is complete or absent, and only a few frames are in memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import validate
from beamline.monitor.digest import digest
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.writers.rows import Rows
from drivers.base.frame import FrameKind
from tests.beamline.cli.small_scan import left
from tests.beamline.storage.readers.foreign_scans import CONE, VIEWS, nxtomo

SHAPE = (24, 32)
N = 9


@pytest.fixture
def stack(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, np.ndarray]:
    """A float32 BigTIFF of line integrals with NaN and no-data pixels; and its pixels."""
    pages = rng.normal(1, 0.2, (N, *SHAPE)).astype(np.float32)
    pages[2, 3, 4] = np.nan
    pages[5, :2] = -999
    pages[7] = np.nan
    tifffile.imwrite(tmp_path / "lab.tif", pages, bigtiff=True, photometric="minisblack")
    return tmp_path / "lab.tif", pages


ANGLES = np.linspace(0, np.pi, N)


def test_a_float_stack_keeps_its_pixels_and_gets_statistics(stack: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    tif, pages = stack
    seen: list[tuple[int, int]] = []
    done = ingest(
        SourceOptions(tif, angles=ANGLES, quantity="line_integrals"),
        tmp_path / "out.h5",
        pixel_size_mm=0.01,
        no_data=-999,
        progress=lambda i, n: seen.append((i, n)),
    )
    assert seen == [(i + 1, N) for i in range(N)]
    assert (done.frames, done.invalid_frames, done.pixel_bytes) == (N, 1, pages.nbytes)
    assert done.definition == "splatline_float_projections"
    with open_scan(tmp_path / "out.h5") as source:
        assert (source.format, source.dtype, source.quantity) == ("float_projections", np.float32, "line_integrals")
        assert (source.pixel_size_mm, source.attributes["no_data"]) == (0.01, -999.0)
        np.testing.assert_array_equal(source.read(slice(None)), pages)
        np.testing.assert_allclose(source.table.angles, ANGLES, rtol=1e-15)
    with h5py.File(tmp_path / "out.h5") as file:
        for i, page in enumerate(pages):
            expected = digest(page, no_data=-999)
            for name in ("minimum", "maximum", "mean", "variance", "sum_abs", "invalid_fraction", "entropy"):
                np.testing.assert_equal(file[f"entry/digest/{name}"][i], getattr(expected, name))
        assert file["entry/digest/invalid_fraction"][5] == pytest.approx(2 / 24)
        np.testing.assert_array_equal(file["exchange/data"][()], pages)
        assert file["exchange/data"].attrs["units"] == "line_integrals"


def test_an_integer_stack_becomes_a_valid_nxtomo(tmp_path: Path, rng: np.random.Generator) -> None:
    pages = rng.poisson(500, (N, *SHAPE)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "raw.tif", pages, photometric="minisblack")
    flats, darks = np.full((2, *SHAPE), 1000, np.uint16), np.full((1, *SHAPE), 100, np.uint16)
    done = ingest(
        SourceOptions(tmp_path / "raw.tif", angles=ANGLES, flats=flats, darks=darks),
        tmp_path / "out.h5",
        pixel_size_mm=0.01,
        sample="rock",
    )
    assert done.definition == "NXtomo"
    with open_scan(tmp_path / "out.h5") as source:
        assert source.table.kinds.tolist() == [2, 1, 1, *[0] * N]
        assert (source.quantity, source.attributes["sample"]) == ("counts", "rock")
        np.testing.assert_array_equal(source.read(slice(3, None)), pages)
    told = {finding.rule for finding in validate(tmp_path / "out.h5")}
    assert told == {"constant-darks"}  # flats and darks are of one number


@pytest.mark.parametrize(
    ("raised", "seen"), [(OSError(28, "No space left"), DataError), (KeyboardInterrupt(), KeyboardInterrupt)]
)
def test_an_end_halfway_leaves_nothing(
    stack: tuple[Path, np.ndarray], tmp_path: Path, raised: BaseException, seen: type[BaseException]
) -> None:
    def fail(i: int, _: int) -> None:
        if i == 5:
            raise raised

    with pytest.raises(seen, match=str(raised.args[-1]) if raised.args else None):
        ingest(SourceOptions(stack[0], angles=ANGLES), tmp_path / "out.h5", progress=fail)
    assert left(tmp_path) == {"lab.tif"}


def test_a_full_disk_is_one_sentence_however_hdf5_tells_of_it(
    stack: tuple[Path, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """HDF5 cannot close what the disk did not take: h5py then raises once more, of another class."""

    def no_room(*_: object) -> None:
        raise RuntimeError("file write failed: errno = 28, error message = 'No space left on device', buf = 0x5")

    monkeypatch.setattr(h5py.File, "close", no_room)
    monkeypatch.setattr(Rows, "write", no_room)
    with pytest.raises(DataError) as error:
        ingest(SourceOptions(stack[0], angles=ANGLES), tmp_path / "out.h5")
    out = tmp_path / "out.h5"
    why = "No space left on device"
    assert (
        str(error.value) == f"{out} could not be written ({why}). Check the disk; no incomplete file was left behind."
    )
    assert left(tmp_path) == {"lab.tif"}


def test_memory_does_not_grow_with_the_stack(tmp_path: Path, rng: np.random.Generator) -> None:
    page = rng.normal(size=(256, 256)).astype(np.float32)
    peaks = []
    for n in (8, 64):
        with tifffile.TiffWriter(tmp_path / f"{n}.tif", bigtiff=True) as tif:
            for _ in range(n):
                tif.write(page, contiguous=True, photometric="minisblack")
        tracemalloc.start()
        ingest(SourceOptions(tmp_path / f"{n}.tif", angles=np.linspace(0, 3, n)), tmp_path / f"{n}.h5")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + page.nbytes  # 64 pages are 16.8 MB
    assert peaks[1] < 16 * page.nbytes


def test_kinds_and_order_come_through(tmp_path: Path) -> None:
    """A series with its own darks and flats, by name."""
    (tmp_path / "scan").mkdir()
    for name, value in (("dark_1", 10), ("flat_1", 900), ("raw_2", 502), ("raw_10", 510)):
        tifffile.imwrite(tmp_path / "scan" / f"{name}.tif", np.full(SHAPE, value, np.uint16))
    ingest(SourceOptions(tmp_path / "scan", angles=[0.0, 1.0]), tmp_path / "out.h5")
    with open_scan(tmp_path / "out.h5") as source:
        assert source.read(slice(None))[:, 0, 0].tolist() == [10, 900, 502, 510]
        assert source.table.kinds.tolist() == [FrameKind.DARK, FrameKind.FLAT, 0, 0]


COPIED: dict[str, list[tuple[str, Any, str | None]]] = {
    "a cone": [*CONE, ("instrument/beam/incident_energy", 25.0, "keV")],
    "a distance": [("detector/distance", 0.2, "m")],
    "mirrored": [("detector/x_flipped", True, None), ("detector/y_flipped", True, None)],
}


@pytest.mark.parametrize("changes", COPIED.values(), ids=COPIED.keys())
def test_a_copy_of_ours_states_the_same(tmp_path: Path, changes: list[tuple[str, Any, str | None]]) -> None:
    path = nxtomo(tmp_path / "s.nx", *changes)
    assert ingest(path, tmp_path / "copy.h5").doubts == ()
    with open_scan(path) as source, open_scan(tmp_path / "copy.h5") as copy:
        for name in ("cone", "pixel_size_mm", "energy_kev", "row_pitch_mm"):
            assert getattr(copy, name) == pytest.approx(getattr(source, name)), name
        assert copy.attributes.get("distance_mm") == source.attributes.get("distance_mm")
        np.testing.assert_array_equal(copy.read(slice(None)), source.read(slice(None)))


def test_what_a_copy_cannot_state_is_refused_or_named(tmp_path: Path) -> None:
    path = nxtomo(tmp_path / "s.nx", ("detector/y_pixel_size", 2.0, "um"))
    with pytest.raises(DataError, match=r"0\.001 x 0\.002"):
        ingest(path, tmp_path / "copy.h5")
    assert not (tmp_path / "copy.h5").exists()
    climbs = ("sample/z_translation", np.r_[0, 0, np.arange(VIEWS)] * 1e-6, "m")
    (doubt,) = ingest(nxtomo(tmp_path / "t.nx", climbs), tmp_path / "copy.h5").doubts
    assert "sample/z_translation, 0 to 4e-06 m, which is not used" in doubt
