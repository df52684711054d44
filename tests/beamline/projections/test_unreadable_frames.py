"""A frame that cannot be read is left out and named, for projections, flats and darks, in any format."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import DataError
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import validate
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import BEAM, DARK, TwoCylinders
from tests.slow_cases import others_slow

SCAN = TwoCylinders()
REFERENCES = [np.full((3, *SCAN.shape), level, np.uint16) for level in (DARK, DARK + BEAM)]
FRAMES = np.concatenate([*REFERENCES, SCAN.counts()])
KEYS = np.repeat([2, 1, 0], [3, 3, len(SCAN.angles)])
SELECTION = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))


def nxtomo(folder: Path, spoilt: list[int]) -> SourceOptions:
    path = folder / "s.nx"
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        data = detector.create_dataset("data", data=FRAMES, chunks=(1, *SCAN.shape), fletcher32=True)
        detector["image_key"] = KEYS
        file["entry/sample/rotation_angle"] = np.degrees(np.concatenate([np.zeros(6), SCAN.angles]))
        file["entry/sample/rotation_angle"].attrs["units"] = "deg"
        places = [data.id.get_chunk_info_by_coord((row, 0, 0)).byte_offset for row in spoilt]
    _spoil(path, places)
    return SourceOptions(path)


def exchange(folder: Path, spoilt: list[int]) -> SourceOptions:
    path, places = folder / "s.h5", []
    with h5py.File(path, "w") as file:
        for name, first, end in (("data_dark", 0, 3), ("data_white", 3, 6), ("data", 6, len(FRAMES))):
            data = file.create_dataset(
                f"exchange/{name}", data=FRAMES[first:end], chunks=(1, *SCAN.shape), fletcher32=True
            )
            of = [row - first for row in spoilt if first <= row < end]
            places += [data.id.get_chunk_info_by_coord((row, 0, 0)).byte_offset for row in of]
        file["exchange/theta"] = np.degrees(SCAN.angles)
    _spoil(path, places)
    return SourceOptions(path)


def series(folder: Path, spoilt: list[int]) -> SourceOptions:
    path = folder / "s"
    path.mkdir()
    for i, (frame, key) in enumerate(zip(FRAMES, KEYS, strict=True)):
        name = {2: "dark", 1: "flat", 0: "view"}[int(key)]
        tifffile.imwrite(path / f"{name}_{i:03d}.tif", frame)
        if i in spoilt:
            (path / f"{name}_{i:03d}.tif").write_bytes(b"II*\0 no more")
    return SourceOptions(path, angles=SCAN.angles)


def _spoil(path: Path, places: list[int]) -> None:
    with path.open("r+b") as file:
        for place in places:
            file.seek(place)
            file.write(b"\xaa" * 16)


@pytest.mark.parametrize(("write", "flags"), others_slow([(nxtomo, "use"), (exchange, "ignore"), (series, "use")]))
def test_views_and_references_that_cannot_be_read_are_left_out_and_named(
    tmp_path: Path, write: object, flags: str
) -> None:
    spoilt = [1, 4, 9, 20, 21]
    scan: SourceOptions = write(tmp_path, spoilt)  # type: ignore[operator]
    with scan.open() as source:
        prepared, told = prepare(source, SELECTION.with_steps(Preparation(flags)))
    views = np.setdiff1d(np.arange(6, len(FRAMES)), spoilt)
    assert prepared.ids.tolist() == views.tolist()
    np.testing.assert_allclose(prepared.seen.data, SCAN.line_integrals()[views - 6], atol=1e-3)
    said = " ".join(told)
    assert "frames cannot be read and are left out: 9, 20-21." in said and "are left out: 1, 4." in said
    with pytest.raises(DataError, match="cannot be read"):
        ingest(scan, tmp_path / "copy.h5")
    assert not (tmp_path / "copy.h5").exists()
    findings = validate(scan, lambda n, of: None)
    assert any(finding.rule == "unreadable" and "9, 20-21" in finding.message for finding in findings)


@pytest.mark.parametrize("write", [nxtomo, exchange])
def test_a_scan_whose_frames_all_cannot_be_read_is_refused_with_the_reason(tmp_path: Path, write: object) -> None:
    scan: SourceOptions = write(tmp_path, list(range(6, len(FRAMES))))  # type: ignore[operator]
    with scan.open() as source, pytest.raises(DataError, match=r"Frame \d+ of .*cannot be read"):
        prepare(source, SELECTION)
