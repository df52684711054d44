"""The monitor gives the same flags on a file as during the scan, and also checks files that it has not seen."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.monitor.check import CheckResult, Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.monitor.frames import SaturationCheck
from beamline.projections.replay import by_kind, counts_of, judged_flags, replay, verdict
from beamline.projections.replayed_frames import context_of
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame
from tests.beamline.array_source import ArraySource
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import Ran
from tests.beamline.scans import BEAM, DARK, TwoCylinders, frames_of, write_exchange
from tests.slow_cases import others_slow

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(8, 40))


@pytest.mark.parametrize("passes", others_slow([3, 1]))
def test_a_file_gets_the_flags_that_the_scan_gave_it(tmp_path: Path, passes: int) -> None:
    angles = f"scan.angles={{scheme: interlaced, views: 12, passes: {passes}, start_deg: 0, span_deg: 180}}"
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9, 10}, lost={12})), angles, "scan.period_s=1.5")
    path = ran.of("scan_done")[0].data["path"]
    with open_scan(path) as source:
        written = source.table.flags
        assert written is not None and written.flagged.sum() == 2  # the repeats; a lost frame marks no other
        np.testing.assert_array_equal(judged_flags(source).bits, written.bits)
        assert context_of(source).period == pytest.approx(1.5, rel=0.01)


def test_a_foreign_file_is_judged(tmp_path: Path) -> None:
    """Data Exchange without flags, exposures or times: a view without beam is found, and nothing else."""
    counts = SCAN.counts()
    rng = np.random.default_rng(3)
    counts = rng.poisson(counts).astype(np.uint16)
    counts[20] = rng.poisson(np.full(SCAN.shape, DARK))
    path = write_exchange(tmp_path / "s.h5", SCAN, {"data": counts})
    with open_scan(path) as source:
        assert source.table.flags is None
        found = judged_flags(source)
    assert np.flatnonzero(found.alarmed).tolist() == [24]  # two darks and two flats come before the views


def test_foreign_byte_orders_and_floats_of_16_bits_are_judged_as_the_same_numbers() -> None:
    data = np.r_[np.full((2, *SCAN.shape), DARK), np.full((2, *SCAN.shape), BEAM), SCAN.counts()]
    data = data.astype("u2") // 32 * 32  # float16 holds these as they are
    data[20, 3, :5] = 0
    key, angles = [2, 2, 1, 1] + [0] * 30, np.r_[np.zeros(4), SCAN.angles]
    sources = [ArraySource(data.astype(dtype), key, angles) for dtype in ("f4", ">u2", "f2")]
    flags, *others = [[each.flags for each in replay(source)] for source in sources]
    assert any(flags)
    assert others == [flags, flags]


@pytest.mark.parametrize(
    ("dtype", "value", "rows"),
    others_slow(
        [
            *(("f8", math.inf, rows) for rows in ("view", "dark", "flat", "half a view", "an angle", "all")),
            *(("i8", 2**60, rows) for rows in ("view", "all darks")),
            *(("f8", -1e300, rows) for rows in ("flat", "all")),
        ],
        3,
    ),
)
def test_pixels_and_angles_that_are_no_measurement_are_named_and_nothing_else_fails(
    dtype: str, value: float, rows: str
) -> None:
    views = SCAN.counts().astype(dtype)
    data = np.concatenate([np.full((2, *SCAN.shape), DARK), np.full((2, *SCAN.shape), BEAM), views]).astype(dtype)
    data += np.arange(8)[:, None].astype(dtype)
    angles = np.r_[np.zeros(4), SCAN.angles]
    own: dict[str, Any] = {"dark": 1, "flat": 3, "view": 20, "all darks": slice(2), "all": slice(None)}
    if rows == "an angle":
        angles[20] = value
    elif rows == "half a view":
        data[20, :4] = value
    else:
        data[own[rows]] = value
    source = ArraySource(data, [2, 2, 1, 1] + [0] * 30, angles)
    judged = list(replay(source))
    found = verdict(source, judged)
    flags = [flag for each in judged for flag in each.flags]
    assert all(math.isfinite(flag.score) for flag in flags)
    said = [*(flag.advice for flag in flags), *found.references]
    assert not [each for each in said if re.search(r"\bnan\b|\binf\b", each)]  # NaN and infinite are words of ours
    blank = [flag.frame for flag in flags if flag.check == "pixels" and flag.level is Level.ALARM]
    assert blank == ([] if rows in ("an angle", "half a view") else np.arange(34)[own[rows]].reshape(-1).tolist())


def test_line_integrals_are_judged_as_counts_of_a_beam_and_nothing_is_said_of_light() -> None:
    views = SCAN.line_integrals().astype(np.float32) + np.float32(0.1)
    views[17] += 3.0
    source = ArraySource(views, [0] * 30, SCAN.angles)
    source.quantity = "line_integrals"
    flags = [flag for each in replay(source) for flag in each.flags]
    assert {17} == {flag.frame for flag in flags if flag.level is Level.ALARM}
    advice = [flag.advice for flag in flags if flag.check == "beam"]
    assert any("Line integrals are wrong by +0.1, compared with 0 in air" in text for text in advice)
    assert not any("light" in text or "intensity" in text or "flats" in text for text in advice)


def _grow(path: Path, frames: list[Frame], close: bool) -> Iterator[int]:
    """Write the frames one by one; yields before each, and once more at the end."""
    writer = NXtomoWriter(path, ScanInfo("s"), SCAN.shape, clock=SystemClock())
    for frame in frames:
        yield frame.index
        writer.append(frame, digest(frame.counts))
    yield len(frames)
    if close:
        writer.close()


class Waits:
    """A clock whose every sleep lets the scan take a frame."""

    def __init__(self, scan: Iterator[int]) -> None:
        self.scan, self.n = scan, 0

    def now(self) -> float:
        return 20.0 * self.n

    def sleep(self, seconds: float) -> None:
        self.n += 1
        next(self.scan, None)


@pytest.mark.parametrize("close", others_slow([False, True]))
def test_a_growing_file_is_followed_to_its_end(tmp_path: Path, close: bool) -> None:
    frames = frames_of(SCAN)
    frames[9] = replace(frames[9], counts=frames[8].counts)
    scan = _grow(tmp_path / "s.h5", frames, close)
    next(scan), next(scan)
    clock = Waits(scan)
    rows, flagged = [], []
    with open_scan(tmp_path / "s.h5", follow=True) as source:
        try:
            for judged in replay(source, follow=clock):
                rows.append(judged.row)
                flagged += [judged.row] * any(flag.level is Level.ALARM for flag in judged.flags)
        except DataError as error:
            assert not close and "34 frames" in str(error)
        else:
            assert close
    assert rows == list(range(34))
    assert 9 in flagged
    assert clock.n >= 32


def test_flags_are_gathered_by_check_and_level() -> None:
    def flag(check: str, level: Level, view: int, score: float) -> Flag:
        return Flag(check, level, view, score, 0.5, "")

    found = by_kind(
        [flag("a", Level.WARN, i, i) for i in range(5)]
        + [flag("b", Level.WARN, 7, -9.0)]
        + [flag("a", Level.ALARM, 9, 4.0)]
        + [flag("c", Level.INFO, 1, 4.0)]
    )
    assert [(kind.check, kind.level, kind.frames) for kind in found] == [
        ("a", Level.ALARM, (9,)), ("a", Level.WARN, (0, 1, 2, 3, 4)), ("b", Level.WARN, (7,)), ("c", Level.INFO, (1,)),
    ]  # fmt: skip
    assert found[1].worst.frame == 4
    assert counts_of(found) == {"a": {"alarm": 1, "warn": 5}, "b": {"warn": 1}, "c": {"info": 1}}


class Fails(SaturationCheck):
    """A check of another package, which returns what is no `CheckResult` from one frame on."""

    name = "fails"
    bit = 40

    def look(self, state: Any, frame: Frame, digest: Any, context: Any) -> Any:
        return CheckResult(state) if frame.index < 6 else None


def test_a_check_that_fails_is_off_and_named_and_the_others_go_on() -> None:
    counts = np.r_[np.full((2, *SCAN.shape), DARK), np.full((2, *SCAN.shape), BEAM), SCAN.counts()]
    counts[20] = DARK
    key, angles = [2, 2, 1, 1] + [0] * 30, np.r_[np.zeros(4), SCAN.angles]
    source: Any = ArraySource(counts.astype(np.uint16), key, angles)
    alone, beside = (verdict(source, list(replay(source, checks))) for checks in (CHECKS, (*CHECKS, Fails())))
    assert beside.kinds == alone.kinds and alone.alarmed == (20,)
    assert [text for text in beside.aside if text not in alone.aside] == [
        "the check fails failed at frame 6 and is switched off; the other checks continue: "
        "TypeError('the check returned None; expected a CheckResult with a Flag or None')"
    ]
