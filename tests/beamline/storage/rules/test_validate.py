"""Each rule, with a file that breaks it and with a file that breaks none."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamline.features.files.validate import describe, source_findings, validate
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.readers.stacks import FrameStack, StacksSource
from beamline.storage.rules import Finding
from beamline.storage.rules.angles import angles_spread, degrees_without_projection
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from tests.beamline.closable import Closable
from tests.beamline.scans import seal
from tests.beamline.storage.conftest import EPOCH, SHAPE, append

Write = Callable[[list[Frame]], Path]
DETECTOR = "entry/instrument/detector"
FRAMES = f"{DETECTOR}/data"
ANGLE = "entry/sample/rotation_angle"


def found(path: Path, **how: object) -> set[tuple[str, str]]:
    return {(finding.severity, finding.rule) for finding in validate(SourceOptions(path, **how))}  # type: ignore[arg-type]


def with_theta(folder: Path, theta: np.ndarray, units: str | None = None, cols: int = 5) -> Path:
    """Noise under these angles."""
    with h5py.File(folder / "s.h5", "w") as file:
        file["exchange/data"] = np.random.default_rng(0).integers(1, 900, (theta.size, 4, cols)).astype(np.uint16)
        file["exchange/theta"] = theta
        if units is not None:
            file["exchange/theta"].attrs["units"] = units
    return folder / "s.h5"


def angles_told(scan: SourceOptions) -> list[Finding]:
    return [finding for finding in validate(scan) if finding.rule == "angle-spread"]


def test_a_good_scan_has_no_finding(path: Path) -> None:
    assert validate(path) == []


Spoil = Callable[[h5py.File], None]


def put(name: str, value: object, where: object = ()) -> Spoil:
    """A file whose dataset has another value there."""
    return lambda file: file[name].__setitem__(where, value)


def without(name: str) -> Spoil:
    return lambda file: file.__delitem__(name)


def attribute(name: str, **values: object) -> Spoil:
    """A file whose object says something else, or nothing for None."""

    def spoil(file: h5py.File) -> None:
        for key, value in values.items():
            del file[name].attrs[key]
            if value is not None:
                file[name].attrs[key] = value

    return spoil


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


def shorter(name: str, n: int) -> Spoil:
    """A file whose dataset lacks so many values at its end."""
    return lambda file: swap(file, name, file[name][:-n])


def repainted(rows: Iterable[int], pixels: Callable[[h5py.Dataset, int], np.ndarray]) -> Spoil:
    """A file with other pixels in these rows, as if they had been written."""

    def spoil(file: h5py.File) -> None:
        for row in rows:
            file[FRAMES][row] = image = pixels(file[FRAMES], row)
            file["entry/digest/checksum"][row] = zlib.crc32(image.tobytes())

    return spoil


def huge_pixels(file: h5py.File) -> None:
    file[f"{DETECTOR}/x_pixel_size"].attrs["units"] = "m"
    file[f"{DETECTOR}/x_pixel_size"][()] = 4.6


@pytest.mark.parametrize(
    ("spoil", "severity", "rule", "said"),
    [
        (shorter(f"{DETECTOR}/image_key", 2), "error", "readable", "unexpected structure"),
        (shorter(ANGLE, 1), "error", "readable", r"float64 and the shape \(13,\); expected .* 14 rows"),
        (attribute(ANGLE, units=None), "error", "readable", "no attribute units"),
        (attribute(ANGLE, units="mm"), "error", "readable", "'mm'"),
        (put(ANGLE, np.nan, 8), "error", "angles", "1 projection of 9 .* frame 8"),
        (put(ANGLE, 30.0, slice(5, None)), "error", "angle-spread", "9 projections have the same angle, 30 degrees"),
        (put(ANGLE, np.linspace(0, 90, 9), slice(5, None)), "warning", "angle-spread", "90.00 degrees"),
        (put("entry/frame_log/time", EPOCH - 9.28, 6), "error", "time-order", "frame 6, by 9.88 s"),
        (put("entry/frame_log/framestamp", 3, 9), "error", "framestamps", "frame 9, framestamp 3 after 3"),
        (put("entry/frame_log/framestamp", range(6, 11), slice(9, None)), "warning", "framestamps", "2 frames .*me 9"),
        (put("entry/progress/frames_committed", 99), "error", "readable", "14 frames; expected 99"),
        (put("entry/progress/finished", 0), "warning", "unfinished", "14 frames can be trusted"),
        (put("entry/progress/status", b"stopped"), "warning", "unfinished", "'stopped'"),
        (lambda file: file["entry/progress/missing_triggers"].resize(2, 0), "warning", "missing-frames", "2 triggers"),
        (
            repainted(range(2, 5), lambda frames, row: frames[row % 2] + np.uint16(3)),
            "error", "bad-references", "Was the shutter open",
        ),
        (repainted(range(5, 14), lambda *_: np.full(SHAPE, 65535, np.uint16)), "error", "pixels", "is 65535"),
        (huge_pixels, "error", "pixel-size", "4600 mm"),
        (put(f"{DETECTOR}/x_pixel_size", 0.0), "error", "pixel-size", "size of 0 mm is impossible"),
    ],
)  # fmt: skip
def test_each_rule_finds_what_it_is_for(
    path: Path, frames: list[Frame], spoil: Spoil, severity: str, rule: str, said: str
) -> None:
    with h5py.File(path, "r+") as file:
        spoil(file)
        seal(file)
    findings = validate(path)
    hits = [finding for finding in findings if finding.rule == rule]
    assert hits, f"found only {findings}"
    assert hits[0].severity == severity
    assert re.search(said, hits[0].message), hits[0].message
    others = {(finding.severity, finding.rule) for finding in findings} - {(severity, rule)}
    assert not {other for other in others if other[0] == "error"}


def test_a_frame_that_the_camera_counted_is_missed_unless_it_was_taken_again(write: Write, frames: list[Frame]) -> None:
    lost = [replace(frame, index=i) for i, frame in enumerate(frames[:6] + frames[7:])]  # darks have trigger 1, too
    assert ("warning", "framestamps") in found(write(lost))
    again = replace(frames[6], index=len(lost), framestamp=0, time=lost[-1].time + 1)
    assert validate(write([*lost, again], "again.h5")) == []  # type: ignore[call-arg]


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


DEGREES = np.arange(0, 180, 2.0)


@pytest.mark.parametrize(
    ("theta", "said"),
    [
        (DEGREES * 1000, "0 to 178000 degrees in steps of 2000, a whole turn or more. These values look like"),
        (-DEGREES * 1000 + 7e4, "-108000 to 70000 degrees in steps of 2000"),
        (DEGREES[np.random.default_rng(0).permutation(90)] * 1000, "look like counts of an encoder"),
        (DEGREES * 65536 / 360, "0 to 32403.9 degrees in steps of 364.1"),
        (np.arange(90) * 360.0, "0 to 32040 degrees in steps of 360"),
        (
            np.radians(DEGREES),
            "span only 3.107 degrees, so the angles look like radians, in which 180 degrees are 3.1416",
        ),
        (np.radians(2 * DEGREES), "radians, in which 360 degrees are 6.2832"),
        (np.radians(np.linspace(-90, 90, 9)), "radians, in which 180 degrees are 3.1416"),
        (DEGREES / 360, "span only 0.4944 degrees, so the angles look like radians or turns"),
        (np.radians(DEGREES) * 0.7, "the angles look like radians or turns"),
    ],
)
def test_angles_that_cannot_be_degrees(tmp_path: Path, theta: np.ndarray, said: str) -> None:
    (tmp_path / "a.txt").write_text("\n".join(map(str, theta)))
    path = with_theta(tmp_path, np.full(theta.size, np.nan))
    (hit,) = angles_told(SourceOptions(path, angles=tmp_path / "a.txt"))
    assert hit.severity == "error" and said in hit.message and "--angles FILE" in hit.message


@pytest.mark.parametrize(
    ("views", "turns", "said"),
    [(30, 1, "30 projections show only 15 directions"), (60, 5, "show only 6 directions"), (31, 1, ""), (60, 1, "")],
)
def test_opposite_views_of_a_few_are_one_direction(tmp_path: Path, views: int, turns: int, said: str) -> None:
    path = with_theta(tmp_path, np.arange(views) * turns * 360 / views, cols=64)
    assert [said in hit.message for hit in angles_told(SourceOptions(path))] == [True] * bool(said)


@given(
    views=st.integers(6, 400),
    turns=st.sampled_from([0.25, 0.5, 1.0, 2.0, 20.0]),
    start=st.floats(-400, 400),
    sign=st.sampled_from([-1, 1]),
    order=st.sampled_from(["even", "golden", "random"]),
)
def test_angles_of_any_plan_are_no_counts_and_no_radians(
    views: int, turns: float, start: float, sign: int, order: str
) -> None:
    share = {
        "even": np.arange(views) / views,
        "golden": np.mod(0.618034 * np.arange(views), 1),
        "random": np.random.default_rng(views).random(views),
    }[order]
    source = StacksSource(
        Path("none"), Closable(), [FrameStack(FrameKind.PROJECTION, "views", np.ones((views, 2, 2)))],
        format="", facts={},
    )  # fmt: skip
    turns = min(turns, views / 2 if order == "even" else 1.0)  # no stage turns on by whole turns
    source.table.angles[:] = np.radians(start + sign * 360 * turns * share)
    assert all(hit.severity != "error" for hit in angles_spread(ScanEvidence(source)))


def test_float_frames_that_are_all_nan(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "s.h5", "w") as file:
        file["exchange/data"] = np.full((4, 5, 6), np.nan, np.float32)
        file["exchange/theta"] = [0.0, 60, 120, 180]
    assert ("error", "pixels") in found(tmp_path / "s.h5", quantity="line_integrals")
    assert ("error", "quantity") in found(tmp_path / "s.h5")


def test_a_growing_file_can_be_validated(writer: NXtomoWriter, tmp_path: Path, frames: list[Frame]) -> None:
    append(writer, *frames)
    assert found(tmp_path / "s.h5") == {("warning", "unfinished")}
    writer.close()


def test_the_beamless_scan_is_refused(shared_data: Path) -> None:
    with open_scan(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx") as source:
        blockers = [found for found in source_findings(ScanEvidence(source)) if found.severity == "error"]
    assert [finding.rule for finding in blockers] == ["bad-references"]
    assert "Do not reconstruct" in blockers[0].message
    assert describe(shared_data / "fixtures" / "esrf_bm05_nxtomo_20x16x16.nx")["reconstructable"] is False


def test_real_scans_can_be_reconstructed(shared_data: Path) -> None:
    for name, how in (
        ("diamond_24737_parallel_91x135x160.h5", {}),
        ("diamond_24737_tiff_series.zip", {"angle_rows": "10:101"}),
        ("aps2bm_tooth_181x2x640.h5", {}),
        ("walnut_parallel_rebinned_240x96x256.h5", {"quantity": "line_integrals"}),
    ):
        with open_scan(SourceOptions(shared_data / name, **how)) as source:  # type: ignore[arg-type]
            assert all(found.severity != "error" for found in source_findings(ScanEvidence(source))), name
            assert source.table.views.size >= 91


@pytest.mark.parametrize("views", [12, 45, 180, 721])
def test_uneven_angles_over_half_a_turn_are_no_limited_angle(views: int) -> None:
    rng, even = np.random.default_rng(views), np.arange(views)
    whole = {
        "half a turn": np.linspace(0, 180, views),
        "a turn": np.linspace(0, 360, views, endpoint=False),
        "golden": (even * 111.246) % 180,
        "golden over a turn": (even * 137.508) % 360,
        "denser at one end": 180 * np.linspace(0, 1, views) ** 1.3,
        "with jitter": np.linspace(0, 180, views) + rng.normal(0, 0.02, views),
        "some twice": np.repeat(np.linspace(0, 180, views), 2),
        "from -90": np.linspace(-90, 90, views, endpoint=False),
    }
    for name, degrees in whole.items():
        assert degrees_without_projection(np.radians(degrees)) == 0, name
    for lost in (40, 60, 90):
        kept = np.linspace(0, 180 - lost, views)
        for degrees in (kept, kept + 70, np.where(kept > 40, kept + lost, kept), np.where(kept > 40, kept + 180, kept)):
            step = (180 - lost) / (views - 1)
            assert degrees_without_projection(np.radians(degrees)) == pytest.approx(lost, abs=step + 1e-6)
    for degrees in (np.r_[0:40:0.5, 90:130:0.5], np.r_[0:20:0.5, 90:110:0.5]):  # twice the same gap
        assert degrees_without_projection(np.radians(degrees)) == pytest.approx(180 - degrees.size / 2, abs=0.1)
