"""Each rule against a file that breaks it, and against one that breaks nothing."""

from __future__ import annotations

import re
import shutil
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.monitor.digest import digest
from beamline.storage.describe import describe
from beamline.storage.ingest import ingest
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recover import recover
from beamline.storage.rules.validate import reconstruction_blockers, validate
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.scans import TwoCylinders, seal, write_exchange
from tests.beamline.storage.conftest import INFO, SHAPE, StandingClock

Write = Callable[[list[Frame]], Path]
DETECTOR = "entry/instrument/detector"
ANGLE = "entry/sample/rotation_angle"


def found(path: Path, **how: object) -> set[tuple[str, str]]:
    return {(finding.severity, finding.rule) for finding in validate(SourceOptions(path, **how))}  # type: ignore[arg-type]


def test_a_good_scan_has_no_finding(write: Write, frames: list[Frame]) -> None:
    assert validate(write(frames)) == []


def test_exposures_that_do_not_go_together_are_told(write: Write, frames: list[Frame]) -> None:
    def told(seconds: dict[FrameKind, float], last: float = 0.05) -> list[str]:
        changed = [replace(frame, exposure=seconds.get(frame.kind, 0.05)) for frame in frames]
        changed[-1] = replace(changed[-1], exposure=last)
        path = write(changed)
        said = [finding.message for finding in validate(path) if finding.rule == "exposures"]
        path.unlink()
        return said

    assert told({FrameKind.FLAT: 0.01}) == []
    assert told({FrameKind.DARK: 0.05000001}) == []
    (darks,) = told({FrameKind.DARK: 0.2})
    assert "darks were exposed for 0.2 s and the projections for 0.05 s" in darks
    (views,) = told({}, last=0.1)
    assert "exposed for 0.05 to 0.1 s" in views


def swap(file: h5py.File, path: str, values: object, **attributes: str) -> None:
    """Replace a dataset, also where NXdata links to it."""
    old = file[path]
    attrs = {name: old.attrs[name] for name in old.attrs} | attributes
    name = path.rsplit("/", 1)[1]
    del file[path]
    file[path] = values
    for key, value in attrs.items():
        file[path].attrs[key] = value
    if name in file["entry/data"]:
        del file["entry/data"][name]
        file["entry/data"][name] = file[path]


def no_definition(file: h5py.File) -> None:
    del file["entry/definition"], file["entry"].attrs["definition"]


def float_frames(file: h5py.File) -> None:
    swap(file, f"{DETECTOR}/data", file[f"{DETECTOR}/data"][()].astype(np.float32))


def short_key(file: h5py.File) -> None:
    swap(file, f"{DETECTOR}/image_key", file[f"{DETECTOR}/image_key"][:-2])


def code_seven(file: h5py.File) -> None:
    file[f"{DETECTOR}/image_key"][4] = 7


def short_angles(file: h5py.File) -> None:
    swap(file, ANGLE, file[ANGLE][:-1])


def no_units(file: h5py.File) -> None:
    del file[ANGLE].attrs["units"]


def wrong_units(file: h5py.File) -> None:
    file[ANGLE].attrs["units"] = "mm"


def nan_angle(file: h5py.File) -> None:
    file[ANGLE][8] = np.nan


def one_direction(file: h5py.File) -> None:
    file[ANGLE][5:] = 30.0


def limited(file: h5py.File) -> None:
    file[ANGLE][5:] = np.linspace(0, 90, 9)


def no_target(file: h5py.File) -> None:
    del file[f"{DETECTOR}/data"].attrs["target"]


def false_target(file: h5py.File) -> None:
    file[f"{DETECTOR}/data"].attrs["target"] = "/entry/digest/preview"


def no_link(file: h5py.File) -> None:
    del file["entry/data/image_key"]


def copied_link(file: h5py.File) -> None:
    del file["entry/data/data"]
    file["entry/data/data"] = file[f"{DETECTOR}/data"][()]


def dot_axes(file: h5py.File) -> None:
    file["entry/data"].attrs["axes"] = ["rotation_angle", ".", "."]


def turned_axes(file: h5py.File) -> None:
    file["entry/data"].attrs["axes"] = ["y", "x", "rotation_angle"]


def no_name(file: h5py.File) -> None:
    del file["entry/sample/name"]


def german_time(file: h5py.File) -> None:
    file["entry/end_time"][()] = "20.11.2026 5 Uhr"


def ends_first(file: h5py.File) -> None:
    file["entry/end_time"][()] = "2020-01-01T00:00:00+00:00"


def time_back(file: h5py.File) -> None:
    file["entry/frame_log/time"][6] -= 10


def repeated_stamp(file: h5py.File) -> None:
    file["entry/frame_log/framestamp"][9] = 3


def skipped_stamp(file: h5py.File) -> None:
    file["entry/frame_log/framestamp"][9:] += 2


def stuck(file: h5py.File) -> None:
    repaint(file, 9, file[f"{DETECTOR}/data"][8])


def repaint(file: h5py.File, row: int, pixels: np.ndarray) -> None:
    """Other pixels, as if they had been written."""
    file[f"{DETECTOR}/data"][row] = pixels
    file["entry/digest/checksum"][row] = zlib.crc32(pixels.tobytes())


def counted_too_many(file: h5py.File) -> None:
    file["entry/progress/frames_committed"][()] = 99


def not_finished(file: h5py.File) -> None:
    file["entry/progress/finished"][()] = 0


def stopped(file: h5py.File) -> None:
    file["entry/progress/status"][()] = b"stopped"


def lost_triggers(file: h5py.File) -> None:
    file["entry/progress/missing_triggers"].resize(2, 0)


def no_beam(file: h5py.File) -> None:
    darks = file[f"{DETECTOR}/data"][:2]
    for row in (2, 3, 4):
        repaint(file, row, darks[row % 2] + np.uint16(3))


def dead_projections(file: h5py.File) -> None:
    for row in range(5, 14):
        repaint(file, row, np.full(SHAPE, 65535, np.uint16))


def huge_pixels(file: h5py.File) -> None:
    file[f"{DETECTOR}/x_pixel_size"].attrs["units"] = "m"
    file[f"{DETECTOR}/x_pixel_size"][()] = 4.6


@pytest.mark.parametrize(
    ("spoil", "severity", "rule", "said"),
    [
        (no_definition, "warning", "definition", "expected 'NXtomo'"),
        (float_frames, "error", "integer-frames", "float32"),
        (short_key, "error", "key-length", "12 entries for 14 frames"),
        (code_seven, "error", "key-codes", r"\[7\]"),
        (short_angles, "error", "angle-length", "13 angles for 14 frames"),
        (no_units, "error", "angle-units", "no units attribute"),
        (wrong_units, "error", "angle-units", "'mm'"),
        (nan_angle, "error", "angles", "1 of 9 projections .* frame 8"),
        (one_direction, "error", "angle-spread", "All 9 projections are at 30 degrees"),
        (limited, "warning", "angle-spread", "90.00 degrees"),
        (no_target, "warning", "links", "no @target"),
        (false_target, "warning", "links", "something else"),
        (no_link, "warning", "links", "image_key is not there"),
        (copied_link, "warning", "links", "another dataset"),
        (dot_axes, "warning", "axes", "no float dataset"),
        (turned_axes, "warning", "axes", "expected rotation_angle"),
        (no_name, "warning", "names", "sample/name"),
        (german_time, "warning", "iso-times", "not ISO 8601"),
        (ends_first, "warning", "iso-times", "before it starts"),
        (time_back, "error", "time-order", "frame 6, by 9.88 s"),
        (repeated_stamp, "error", "framestamps", "frame 9, framestamp 3 after 3"),
        (skipped_stamp, "warning", "framestamps", "2 frames .* frame 9"),
        (stuck, "warning", "stuck-frames", r"first: 9\)"),
        (counted_too_many, "error", "unfinished", "99 frames .* 14 are there"),
        (not_finished, "warning", "unfinished", "14 frames can be trusted"),
        (stopped, "warning", "unfinished", "'stopped'"),
        (lost_triggers, "warning", "missing-frames", "2 triggers"),
        (no_beam, "error", "bad-references", "Was the shutter open"),
        (dead_projections, "error", "pixels", "is 65535"),
        (huge_pixels, "error", "pixel-size", "4600 mm"),
    ],
)
def test_each_rule_finds_what_it_is_for(
    write: Write, frames: list[Frame], spoil: Callable[[h5py.File], None], severity: str, rule: str, said: str
) -> None:
    path = write(frames)
    with h5py.File(path, "r+") as file:
        spoil(file)
        seal(file)
    hits = [finding for finding in validate(path) if finding.rule == rule]
    assert hits, f"found only {found(path)}"
    assert hits[0].severity == severity
    assert re.search(said, hits[0].message), hits[0].message
    others = {(finding.severity, finding.rule) for finding in validate(path)} - {(severity, rule)}
    assert not {other for other in others if other[0] == "error"} or spoil is float_frames


def test_a_frame_that_the_camera_counted_is_missed_unless_it_was_taken_again(write: Write, frames: list[Frame]) -> None:
    lost = [replace(frame, index=i) for i, frame in enumerate(frames[:6] + frames[7:])]  # darks have trigger 1, too
    assert ("warning", "framestamps") in found(write(lost))
    again = replace(frames[6], index=len(lost), framestamp=0, time=lost[-1].time + 1)
    assert validate(write([*lost, again], "again.h5")) == []  # type: ignore[call-arg]


def test_missing_references(write: Write, frames: list[Frame]) -> None:
    projections = [replace(frame, index=i) for i, frame in enumerate(frames[5:])]
    hits = [finding for finding in validate(write(projections)) if finding.rule == "references"]
    assert [finding.severity for finding in hits] == ["error", "error"]
    assert "without flats" in hits[0].message
    assert "without darks" in hits[1].message


def test_one_view_is_no_scan(write: Write, frames: list[Frame]) -> None:
    assert ("error", "views") in found(write(frames[:6]))


def test_a_camera_that_was_armed_again_is_no_fault(write: Write, frames: list[Frame]) -> None:
    """Interlaced passes arm the camera once each: the count starts again at 0 within the projections."""
    again = [replace(frame, framestamp=(frame.framestamp % 4)) for frame in frames]
    assert validate(write(again)) == []
    lost = [replace(frame, index=i) for i, frame in enumerate(again[:9] + again[10:])]  # the first of the second pass
    assert [frame.framestamp for frame in lost[5:]] == [0, 1, 2, 3, 1, 2, 3, 0]
    assert validate(write(lost, "lost.h5")) == []  # type: ignore[call-arg]
    back = [replace(frame, trigger=0, framestamp=0) if frame.index == 12 else frame for frame in frames]
    assert ("error", "framestamps") in found(write(back, "back.h5"))  # type: ignore[call-arg]


def test_degrees_that_are_radians(tmp_path: Path, clock: StandingClock, frames: list[Frame]) -> None:
    with NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock) as writer:
        for frame in frames[:5]:
            writer.append(frame, digest(frame.counts))
        for i in range(40):
            frame = replace(frames[5], index=5 + i, framestamp=i, angle=np.radians(i * np.pi / 39))
            frame.counts[0, 0] = i
            writer.append(frame, digest(frame.counts))
    hits = [finding for finding in validate(tmp_path / "s.h5") if finding.rule == "angle-spread"]
    assert "radians" in hits[0].message


@pytest.mark.parametrize(
    ("theta", "severity", "said"),
    [
        (np.arange(0, 180, 3.0), "warning", "28.2 turns, or 177 in radians: are these degrees"),
        (np.linspace(-90, 90, 61), "warning", "28.6 turns, or 180 in radians"),
        (np.arange(0, 360, 360 / 61), "warning", "under a label of radians"),
        (2.399963229728653 * np.arange(200), "", ""),  # golden angles
        (np.radians(np.arange(0, 7200, 1.8)), "", ""),  # twenty turns
        (np.linspace(0, 1.8e4, 60), "error", "up to 1.03e+06 degrees; expected at most 1e+06"),
        (np.linspace(0, 1e300, 60), "error", "Are their units right"),
    ],
)
def test_radians_that_are_degrees(tmp_path: Path, theta: np.ndarray, severity: str, said: str) -> None:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["exchange/data"] = np.random.default_rng(0).integers(1, 900, (theta.size, 4, 5)).astype(np.uint16)
        file["exchange/theta"] = theta
        file["exchange/theta"].attrs["units"] = "rad"
    hits = [finding for finding in validate(tmp_path / "s.h5") if finding.rule == "angle-spread"]
    assert [hit.severity for hit in hits] == [severity] * bool(severity)
    assert not hits or said in hits[0].message


def test_float_frames_that_are_all_nan(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["exchange/data"] = np.full((4, 5, 6), np.nan, np.float32)
        file["exchange/theta"] = [0.0, 60, 120, 180]
    assert ("error", "pixels") in found(tmp_path / "s.h5", quantity="line_integrals")
    assert ("error", "quantity") in found(tmp_path / "s.h5")


def test_what_cannot_be_opened_is_a_finding(tmp_path: Path) -> None:
    (tmp_path / "s.h5").write_bytes(b"no HDF5")
    assert found(tmp_path / "s.h5") == {("error", "readable")}
    assert found(tmp_path / "nowhere.h5") == {("error", "readable")}
    with h5py.File(tmp_path / "empty.h5", "w"):
        pass
    assert found(tmp_path / "empty.h5") == {("error", "readable")}


def test_a_growing_file_can_be_validated(tmp_path: Path, clock: StandingClock, frames: list[Frame]) -> None:
    writer = NXtomoWriter(tmp_path / "s.h5", INFO, SHAPE, clock=clock)
    for frame in frames:
        writer.append(frame, digest(frame.counts))
    assert found(tmp_path / "s.h5") == {("warning", "unfinished")}
    writer.close()


def test_describe(write: Write, frames: list[Frame]) -> None:
    said = describe(write(frames))
    assert said["format"] == "nxtomo"
    assert said["kinds"] == {"projection": 9, "flat": 3, "dark": 2}
    assert (said["first_angle_deg"], said["last_angle_deg"]) == (0, pytest.approx(180))
    assert said["step_deg"] == pytest.approx(22.5)
    assert (said["quantity"], said["exposure_s"], said["missing_triggers"]) == ("counts", 0.05, 0)
    assert said["findings"] == []
    assert said["reconstructable"] is True


def test_the_beamless_scan_is_refused(shared_data: Path) -> None:
    with open_scan(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx") as source:
        blockers = reconstruction_blockers(source)
    assert [finding.rule for finding in blockers] == ["bad-references"]
    assert "must not be reconstructed" in blockers[0].message
    assert describe(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx")["reconstructable"] is False


def test_real_scans_can_be_reconstructed(shared_data: Path) -> None:
    for name, how in (
        ("diamond_24737_parallel_91x135x160.h5", {}),
        ("diamond_24737_tiff_series.zip", {"angle_rows": "10:101"}),
        ("aps2bm_tooth_181x2x640.h5", {}),
        ("walnut_parallel_rebinned_240x96x256.h5", {"quantity": "line_integrals"}),
    ):
        with open_scan(SourceOptions(shared_data / name, **how)) as source:  # type: ignore[arg-type]
            assert reconstruction_blockers(source) == [], name
            assert int((source.image_key == FrameKind.PROJECTION).sum()) >= 91


def flip(path: Path, at: int, bit: int) -> None:
    """Flip one bit of a file, as a disk or a memory does."""
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def test_a_flipped_bit_of_any_pixel_is_found_in_its_frame(
    write: Write, frames: list[Frame], rng: np.random.Generator
) -> None:
    path = write(frames)
    with h5py.File(path) as file:
        offsets = [file[f"{DETECTOR}/data"].id.get_chunk_info_by_coord((row, 0, 0)).byte_offset for row in range(14)]
    for row in range(14):
        at, bit = offsets[row] + int(rng.integers(2 * SHAPE[0] * SHAPE[1])), int(rng.integers(8))
        flip(path, at, bit)
        told: list[tuple[int, int]] = []
        (hit,) = [hit for hit in validate(path, deep=lambda n, of: told.append((n, of))) if hit.rule == "checksums"]  # noqa: B023
        assert hit.severity == "error"
        assert f"1 of 14 frames differ from the checksums that were written with them: {row}." in hit.message
        assert told == [(n, 14) for n in range(1, 15)]
        flip(path, at, bit)
    assert validate(path, deep=lambda n, of: None) == []


def test_frames_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders())
    assert [hit.rule for hit in validate(path, deep=lambda n, of: None)] == ["checksums"]  # it has none
    with h5py.File(path, "r+") as file:
        data = file["exchange/data"][()]
        del file["exchange/data"]
        packed = file.create_dataset("exchange/data", data=data, chunks=(1, *data.shape[1:]), compression="gzip")
        offset = packed.id.get_chunk_info(30).byte_offset
    flip(path, offset + 8, 3)
    (hit,) = [hit for hit in validate(path, deep=lambda n, of: None) if hit.rule == "unreadable"]
    assert hit.message.startswith("1 frame cannot be read: 34. Frame 30 of /exchange/data in ")


def test_frames_of_big_endian_files_are_as_written_when_ingested(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders(), {"data": TwoCylinders().counts().astype(">u2")})
    ingest(path, tmp_path / "ours.h5")

    def differ() -> list[str]:
        return [hit.message for hit in validate(tmp_path / "ours.h5", lambda n, of: None) if hit.rule == "checksums"]

    assert differ() == []


def test_a_damaged_scan_is_not_ingested(write: Write, frames: list[Frame], tmp_path: Path) -> None:
    path = write(frames)
    with h5py.File(path, "r+") as file:
        file[f"{DETECTOR}/data"][6, 0, 0] ^= 8
    with pytest.raises(DataError, match=r"Frame 6 of .* checksum differs"):
        ingest(path, tmp_path / "copy.h5")
    assert [left.name for left in tmp_path.iterdir()] == ["scan.h5"]


ALTERATIONS = {
    "a null dataspace": h5py.Empty("f4"),
    "a text": "words",
    "other dimensions": np.zeros((3, 3, 3, 3)),
    "a link in a circle": None,
    "nothing": np.zeros(0),
    "a negative number": np.int64(-5),
    "a huge number": np.int64(2**62),
    "nested lists": "[" * 3000,
}


@pytest.mark.parametrize(
    "where",
    ["instrument/detector/image_key", "frame_log/flags", "progress/frames_committed", "progress/status", "record/plan"],
)
def test_altered_files_are_described_or_refused_in_words(
    write: Write, frames: list[Frame], where: str, tmp_path: Path
) -> None:
    whole = write(frames)
    for what, value in ALTERATIONS.items():
        path = tmp_path / f"{what}.h5"
        shutil.copy(whole, path)
        with h5py.File(path, "r+") as file:
            del file["entry"][where]
            file["entry"][where] = h5py.SoftLink(f"/entry/{where}") if value is None else value
        assert isinstance(validate(path, deep=lambda n, of: None), list)
        for ask in (describe, recover, partial(ingest, out=tmp_path / f"copy of {what}.h5")):
            with suppress(DataError):
                ask(path)
