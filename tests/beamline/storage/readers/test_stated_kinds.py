"""Frame kinds stated by the caller, and scans in several files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.validate import validate
from beamline.storage.readers.open import SourceOptions, open_scan
from drivers.base.frame import FrameKind
from tests.beamline.scans import write_nxtomo
from tests.beamline.storage.readers.foreign_scans import FRAMES, nxtomo
from tests.messages import refused

DARK, FLAT, VIEW, NONE = FrameKind.DARK, FrameKind.FLAT, FrameKind.PROJECTION, FrameKind.INVALID
SHAPE = (4, 6)


@pytest.fixture
def series(tmp_path: Path) -> Path:
    """Ten images numbered through, of which the names of the first three and the last say nothing that is known."""
    folder = tmp_path / "s"
    folder.mkdir()
    for i in range(10):
        what = "ref" if i in (0, 1, 2, 9) else "dark_chocolate"
        tifffile.imwrite(folder / f"s_{i + 5:03d}_{what}.tif", np.full(SHAPE, i, np.uint16))
    return folder


def test_ranges_of_a_numbered_series_are_the_kinds_of_its_frames(series: Path) -> None:
    with open_scan(series) as source:
        assert (source.table.kinds == DARK).sum() == 6  # by their names
    with open_scan(SourceOptions(series, frames="darks=0:1,flats=1:3+9:10", angles=np.arange(6) * 0.5)) as source:
        assert source.table.kinds.tolist() == [DARK, FLAT, FLAT, *[VIEW] * 6, FLAT]
        assert source.read(slice(None))[:, 0, 0].tolist() == list(range(10))
        assert source.quantity == "counts"
        np.testing.assert_allclose(source.table.angles[3:9], np.arange(6) * 0.5)
    with open_scan(SourceOptions(series, frames="darks=:1, flats=1:3, views=3:6")) as source:
        assert source.table.kinds.tolist() == [DARK, FLAT, FLAT, VIEW, VIEW, VIEW, *[NONE] * 4]


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("darks=0:11", "'darks=0:11' is not one of"),
        ("bright=0:1", "'bright=0:1' is not one of darks, flats, views, none with frames of 0:10"),
        ("darks=3:3", "'darks=3:3'"),
        ("darks=0:2,flats=1:3", "names frame 1 twice"),
        ("darks", "'darks'"),
        ("", "''"),
    ],
)
def test_ranges_that_cannot_be_are_refused(series: Path, frames: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        open_scan(SourceOptions(series, frames=frames))


@pytest.mark.parametrize(
    ("frames", "taken"),
    [
        ("0::2", [0, 2, 4, 6, 8, 9, 10, 12, 14, 15]),
        ("1::2", [1, 3, 5, 7, 8, 10, 11, 13, 15]),
        ("2:4", [0, 1, 2, 3, 6, 7, 8, 10, 15]),
        ("darks=0:2, flats=2:4, 0::2", [0, 2, 4, 6, 8, 10, 12, 14]),
        ("-1:, darks=0:3", [0, 1, 2, 15]),
    ],
)
def test_views_are_selected_in_turn_with_their_references(tmp_path: Path, frames: str, taken: list[int]) -> None:
    """Four darks alternate as the views do; three flats, between which views are counted on, cannot."""
    key = np.r_[[2] * 4, [0] * 4, 1, 0, 1, [0] * 4, 1]
    pixels = np.arange(16, dtype=np.uint16)[:, None, None] * np.ones(SHAPE, np.uint16)
    path = write_nxtomo(tmp_path / "s.nxs", pixels, key.tolist(), 10.0 * np.arange(16))
    with open_scan(SourceOptions(path, frames=frames)) as source:
        assert np.flatnonzero(source.table.kinds != NONE).tolist() == taken
        np.testing.assert_array_equal(source.read([3, 9])[:, 0, 0], [3, 9])


def test_angles_are_those_of_all_views_or_of_the_selected_ones(series: Path) -> None:
    kinds = "darks=0:1,flats=1:2,1::2"
    for angles in (np.arange(8.0), np.arange(8)[1::2]):
        with open_scan(SourceOptions(series, frames=kinds, angles=angles)) as source:
            views = source.table.kinds == VIEW
            assert source.read(np.flatnonzero(views))[:, 0, 0].tolist() == [3, 5, 7, 9]
            np.testing.assert_allclose(source.table.angles[views], [1, 3, 5, 7])
    with refused(DataError):
        open_scan(SourceOptions(series, frames="darks=0:1,flats=1:2,8:", angles=np.arange(8.0)))


def test_a_scan_in_several_files_is_read_as_one(tmp_path: Path) -> None:
    """Darks, flats and two halves of the views in files of their own, as Diamond and others write them."""
    paths = []
    for name, key, first in (("d", [2, 2], 0), ("f", [1, 1, 1], 2), ("a", [0, 0], 5), ("b", [0, 0, 0], 7)):
        numbers = np.arange(first, first + len(key), dtype=np.uint16)
        frames = numbers[:, None, None] * np.ones(SHAPE, np.uint16)
        paths.append(write_nxtomo(tmp_path / f"{name}.nxs", frames, key, 10.0 * numbers))
    with open_scan(SourceOptions(paths[0], then=tuple(paths[1:]))) as source:
        assert source.path == paths[0]
        assert source.table.kinds.tolist() == [2, 2, 1, 1, 1, *[0] * 5]
        assert source.read(slice(None))[:, 1, 1].tolist() == list(range(10))
        np.testing.assert_allclose(np.degrees(source.table.angles[5:]), 10.0 * np.arange(5, 10))
        assert source.table.part_starts.tolist() == [0]  # no file is a part that should have flats of its own
    with refused(DataError):
        open_scan(SourceOptions(paths[0], then=(tmp_path / "gone.nxs",)))
    with refused(DataError):
        open_scan(SourceOptions(paths[0], then=(paths[1],)), follow=True)


def test_views_of_two_energies_are_refused_and_one_can_be_chosen(tmp_path: Path) -> None:
    kev = np.r_[np.nan, 20.0, [20, 30, 20, 30, 20]]
    path = nxtomo(tmp_path / "s.nx", ("instrument/beam/incident_energy", kev, "keV"))
    (hit,) = [hit for hit in validate(path) if hit.rule == "energies"]
    assert hit.severity == "error" and "3 at 20 keV, 2 at 30 keV" in hit.message
    with open_scan(SourceOptions(path, frames="energy=20", darks=FRAMES[:2])) as source:
        assert source.energy_kev == 20
        assert source.table.kinds.tolist() == [2, 2, 3, 1, 0, 3, 0, 3, 0]
    assert not [hit for hit in validate(SourceOptions(path, frames="energy=20")) if hit.rule == "energies"]
    with refused(DataError):
        open_scan(SourceOptions(path, frames="energy=25"))
    with refused(DataError):
        open_scan(SourceOptions(nxtomo(tmp_path / "t.nx"), frames="energy=25"))


def test_frames_that_are_left_out_alone_keep_the_kinds_of_the_others(tmp_path: Path) -> None:
    pixels = np.zeros((8, *SHAPE), np.uint16)
    path = write_nxtomo(tmp_path / "s.nxs", pixels, [2, 1, *[0] * 6], 10.0 * np.arange(8))
    with open_scan(SourceOptions(path, frames="none=3:5+7:8")) as source:
        assert source.table.kinds.tolist() == [DARK, FLAT, VIEW, NONE, NONE, VIEW, VIEW, NONE]
    angles = np.array([0, np.nan, 20, 30, np.nan, 50])
    (finding,) = [
        each.message for each in validate(SourceOptions(path, angles=angles)) if "have no angle" in each.message
    ]
    assert "--frames none=3:4+6:7." in finding  # as it is given below
    for given in (angles, angles[np.isfinite(angles)]):  # of all views, or of those that are left
        with open_scan(SourceOptions(path, angles=given, frames="none=3:4+6:7")) as source:
            np.testing.assert_array_equal(source.table.angles[source.table.views], [0, 20, 30, 50])
