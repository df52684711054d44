"""The writer: the content of its files, and its errors."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.monitor.digest import digest
from beamline.plan.passes import Choice
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.frame import Frame, FrameKind
from tests.beamline.storage.conftest import INFO, SHAPE, append
from tests.clock import SteppedClock
from tests.messages import refused

Write = Callable[[list[Frame]], Path]


def test_paths_types_and_units_of_nxtomo(path: Path, frames: list[Frame]) -> None:
    with h5py.File(path) as file:
        entry = file["entry"]
        assert entry["definition"][()] == b"NXtomo"
        assert entry["title"][()] == b"a test"
        data = entry["instrument/detector/data"]
        assert data.dtype == np.dtype("<u2")
        assert data.chunks == (1, *SHAPE)
        np.testing.assert_array_equal(data[()], [frame.counts for frame in frames])
        np.testing.assert_array_equal(entry["instrument/detector/image_key"][()], [2, 2, 1, 1, 1, *[0] * 9])
        angle = entry["sample/rotation_angle"]
        assert angle.attrs["units"] == "degree"
        np.testing.assert_allclose(angle[5:], np.linspace(0, 180, 9))
        assert np.isnan(angle[:5]).all()
        for name, value, unit in (
            ("instrument/detector/x_pixel_size", 0.0046, "mm"),
            ("instrument/detector/y_pixel_size", 0.0046, "mm"),
            ("instrument/detector/distance", 100.0, "mm"),
            ("instrument/beam/incident_energy", 25.0, "keV"),
            ("record/axis_col", 7.25, "pixel"),
        ):
            assert (entry[name][()], entry[name].attrs["units"]) == (value, unit)
        classes = {name: item.attrs["NX_class"] for name, item in entry.items() if isinstance(item, h5py.Group)}
        assert classes["instrument"] == "NXinstrument"
        assert classes["sample"] == "NXsample"
        assert classes["data"] == "NXdata"
        assert entry["instrument/devices/stage/counts_per_turn"][()] == 360000
        assert entry["record/plan"][()] == b'{"views": 9}'


def test_nxdata_holds_hard_links_that_name_their_target(path: Path) -> None:
    with h5py.File(path) as file:
        nxdata = file["entry/data"]
        assert nxdata.attrs["signal"] == "data"
        assert list(nxdata.attrs["axes"]) == ["rotation_angle", "y", "x"]
        for name in ("data", "rotation_angle", "image_key"):
            assert isinstance(nxdata.get(name, getlink=True), h5py.HardLink)
            assert file[nxdata[name].attrs["target"]] == nxdata[name]
        np.testing.assert_allclose(nxdata["x"][()], np.arange(SHAPE[1]) * 0.0046)
        assert nxdata["y"].shape == (SHAPE[0],)


def test_text_is_readable_while_the_file_grows(tmp_path: Path, clock: SteppedClock) -> None:
    """Variable-length text written under SWMR is not (h5py issue 1273); ours is all made before, or of fixed length."""
    writer = NXtomoWriter(tmp_path / "s.h5", replace(INFO, sample="Prüfkörper µ"), SHAPE, clock=clock)
    look = (
        "import h5py, sys\n"
        "found = []\n"
        "with h5py.File(sys.argv[1], 'r', swmr=True) as file:\n"
        "    def see(name, item):\n"
        "        found.extend(str(value) for value in item.attrs.values())\n"
        "        if isinstance(item, h5py.Dataset) and item.shape == ():\n"
        "            found.append(item.asstr()[()] if h5py.check_string_dtype(item.dtype) else str(item[()]))\n"
        "    file.visititems(see)\n"
        "sys.stdout.buffer.write(chr(10).join(found).encode())"
    )
    done = subprocess.run([sys.executable, "-c", look, str(tmp_path / "s.h5")], capture_output=True, timeout=60)
    said = done.stdout.decode().splitlines()
    assert done.returncode == 0, done.stderr.decode()
    assert {"Prüfkörper µ", "NXtomo", "running", "NXentry", "degree", "PM16C"} <= set(said)
    writer.close()


def test_ends_of_passes_and_decisions_are_there_while_the_file_grows(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame]
) -> None:
    path, decided = tmp_path / "s.h5", {"number": 1, "choice": Choice.AGAIN, "reason": "Prüfkörper µ", "gained": None}
    with NXtomoWriter(path, replace(INFO, decides=True), SHAPE, clock=clock, flush_every=100) as writer:
        append(writer, *frames[:8])
        with open_scan(path, follow=True) as source:
            assert (source.table.pass_ends.tolist(), source.decisions) == ([], ())
            writer.end_pass()
            assert (source.refresh(), source.table.pass_ends.tolist()) == (8, [8])
            writer.add_decision(decided)
            append(writer, *frames[8:])
            writer.end_pass()
            assert (source.refresh(), source.table.pass_ends.tolist()) == (len(frames), [8, len(frames)])
            assert source.decisions == (decided,)


def test_a_file_that_cannot_be_laid_out_is_not_left_half_made(tmp_path: Path, clock: SteppedClock) -> None:
    info = replace(INFO, devices={"stage": {"model": object()}})  # type: ignore[dict-item]
    with pytest.raises(TypeError):
        NXtomoWriter(tmp_path / "s.h5", info, SHAPE, clock=clock)
    assert list(tmp_path.iterdir()) == []
    NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock).close()


def test_digest_and_preview_are_stored_beside_the_frame(path: Path, frames: list[Frame]) -> None:
    with h5py.File(path) as file:
        for i, frame in enumerate(frames):
            expected = digest(frame.counts)
            np.testing.assert_array_equal(file["entry/digest/preview"][i], expected.preview)
            for name in ("minimum", "maximum", "mean", "variance", "sum_abs", "entropy", "checksum"):
                assert file[f"entry/digest/{name}"][i] == getattr(expected, name)


def test_exchange_view_shows_the_same_frames_and_moves_with_the_file(
    write: Write, frames: list[Frame], tmp_path: Path
) -> None:
    frames = [*frames, replace(frames[2], index=14, trigger=0, framestamp=0)]  # a flat at the end: two runs of flats
    path = write(frames)
    (tmp_path / "elsewhere").mkdir()
    path = path.rename(tmp_path / "elsewhere" / "moved.h5")
    with h5py.File(path) as file:
        for name, kind in (
            ("data", FrameKind.PROJECTION),
            ("data_white", FrameKind.FLAT),
            ("data_dark", FrameKind.DARK),
        ):
            assert file["exchange"][name].is_virtual
            expected = [frame.counts for frame in frames if frame.kind is kind]
            np.testing.assert_array_equal(file["exchange"][name][()], expected)
        np.testing.assert_allclose(file["exchange/theta"][()], np.linspace(0, 180, 9))
        assert file["exchange/theta"].attrs["units"] == "deg"
        assert file["implements"][()] == b"exchange"


def test_a_stopped_scan_has_a_view_of_the_rows_that_exist(
    writer: NXtomoWriter, tmp_path: Path, clock: SteppedClock, frames: list[Frame]
) -> None:
    append(writer, *frames[:7])
    clock.sleep(10)
    writer.close("stopped", missing=[7, 9])
    writer.close("complete")  # the second close changes nothing
    assert writer.remarks == []
    with h5py.File(tmp_path / "s.h5") as file:
        assert file["exchange/data"].shape == (2, *SHAPE)
        assert file["entry/progress/status"][()] == b"stopped"
        assert file["entry/progress/missing_triggers"][()].tolist() == [7, 9]
        assert file["entry/progress/frames_committed"][()] == 7
    with open_scan(tmp_path / "s.h5") as source:
        assert (source.attributes["status"], source.attributes["missing_triggers"]) == ("stopped", 2)


def test_an_empty_scan_is_still_a_file(tmp_path: Path, clock: SteppedClock) -> None:
    NXtomoWriter(tmp_path / "s.h5", ScanInfo("nothing"), SHAPE, clock=clock).close("failed")
    with open_scan(tmp_path / "s.h5") as source:
        assert source.refresh() == 0
        assert source.read(slice(None)).shape == (0, *SHAPE)
        assert source.pixel_size_mm is None


@pytest.mark.parametrize("kind", [kind for kind in FrameKind if kind is not FrameKind.INVALID])
def test_a_frame_that_was_taken_again_is_not_taken_for_damaged(
    write: Write, frames: list[Frame], kind: FrameKind
) -> None:
    """As flats and views on the way back are after a time without beam."""
    first = replace(frames[-1], index=14, kind=kind)
    path = write([*frames, first, replace(first, index=15, replaces=14)])
    logged = max(kind, FrameKind.ALIGNMENT)  # a wide view is one by its translation, which this file lacks
    with open_scan(path) as source:
        assert not source.table.altered.any() and source.table.kinds[14:].tolist() == [FrameKind.INVALID, logged]


def test_an_alignment_frame_is_no_view_to_those_who_do_not_know_it(write: Write, frames: list[Frame]) -> None:
    path = write([*frames, replace(frames[-1], index=14, kind=FrameKind.ALIGNMENT)])
    with h5py.File(path) as file:
        assert file["entry/instrument/detector/image_key"][14] == 3
        assert file["entry/instrument/detector/image_key_control"][14] == -1
        assert file["exchange/data"].shape[0] == 9
        assert file["entry/instrument/detector/image_key_control"] == file["entry/frame_log/kind"]
    with open_scan(path) as source:
        assert source.table.kinds[14] == FrameKind.ALIGNMENT


@pytest.mark.parametrize("planned", [True, False])
@pytest.mark.parametrize(
    ("turn", "axis", "field"),
    [(180.0, None, b"Full"), (360.0, 7.5, b"Full"), (360.0, 11.0, b"Half"), (360.0, None, None)],
)
def test_what_the_programs_of_esrf_know_an_nxtomo_by(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame], turn: float, axis: float | None, field: bytes | None,
    planned: bool,
) -> None:  # fmt: skip
    """While the file grows, too. A plan without angles and an axis that is not known leave the field of view out."""
    path, views = tmp_path / "s.h5", frames[5:]
    angles = turn * np.arange(len(views)) / len(views)
    plan = json.dumps({"angles_deg": angles.tolist()} if planned else {})
    with NXtomoWriter(path, replace(INFO, axis_col=axis, plan=plan), SHAPE, clock=clock) as writer:
        for i, frame in enumerate(views):
            writer.append(replace(frame, index=i, angle=np.radians(angles[i])), digest(frame.counts))
        for swmr in (True, False):
            with h5py.File(path, "r", swmr=swmr) as file:
                detector, entry = file["entry/instrument/detector"], file["entry"]
                assert (entry.attrs["definition"], entry.attrs["version"]) == ("NXtomo", 1.5)
                assert detector["image_key_control"] == file["entry/frame_log/kind"]
                if planned or not swmr:
                    known = planned or axis is not None
                    assert (detector["field_of_view"][()] if "field_of_view" in detector else None) == (
                        field if known else None
                    )
            writer.close()


def test_an_exception_inside_leaves_a_failed_but_readable_file(
    tmp_path: Path, clock: SteppedClock, frames: list[Frame]
) -> None:
    with (
        refused(RuntimeError),
        NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock) as writer,
    ):
        append(writer, frames[0])
        raise RuntimeError("camera unplugged")
    with open_scan(tmp_path / "s.h5") as source:
        assert source.attributes["status"] == "failed"
        np.testing.assert_array_equal(source.read([0])[0], frames[0].counts)


def test_never_overwrites(tmp_path: Path, clock: SteppedClock) -> None:
    path = tmp_path / "s.h5"
    path.write_bytes(b"precious")
    with refused(DataError):
        NXtomoWriter(path, INFO, SHAPE, clock=clock)
    assert path.read_bytes() == b"precious"
    with refused(DataError):
        NXtomoWriter(tmp_path / "no" / "folder.h5", INFO, SHAPE, clock=clock)


def test_wrong_frames_are_refused_and_nothing_is_written(
    writer: NXtomoWriter, tmp_path: Path, frames: list[Frame]
) -> None:
    append(writer, frames[0])
    good = frames[1]
    for bad, said in (
        (replace(good, counts=good.counts[:-1]), r"uint16 \(11, 16\); expected uint16 \(12, 16\)"),
        (replace(good, counts=good.counts.astype(np.float32)), "float32"),
        (replace(good, counts=good.counts.astype(np.int16)), "int16"),
        (replace(good, index=2), "index of the frame is 2; expected 1"),
        (replace(good, index=0), "index of the frame is 0; expected 1"),
    ):
        with pytest.raises(DataError, match=said):
            writer.append(bad, digest(good.counts))
    with refused(DataError):
        writer.append(good, digest(good.counts, preview_bin=2))
    with refused(ValueError):
        writer.close("splendid")
    assert (writer.rows, writer.committed) == (1, 1)
    writer.close()
    with refused(DataError):
        writer.append(good, digest(good.counts))
    with h5py.File(tmp_path / "s.h5") as file:
        assert {file[path].shape[0] for path in layout.COLUMNS} == {1}
        assert file["entry/instrument/detector/data"].shape[0] == 1
