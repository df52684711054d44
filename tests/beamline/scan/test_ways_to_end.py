"""A scan ends with all frames or with an exit code other than 0; no check or output ends a scan."""

import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.errors import BeamlineError, exit_code
from beamline.core.stop import ScanAborted, StopRequest
from beamline.monitor.check import CheckResult, Flag, Level
from beamline.monitor.field import MassCheck
from beamline.scan import frame_checks
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.errors import DeviceError
from tests.beamline.fakes import SHAPE, FakeInstrument, Faults
from tests.beamline.ran import Ran

FRAMES = 19
ERRORS: tuple[Callable[[], BaseException], ...] = (
    lambda: SystemExit(0), lambda: SystemExit("ended"), KeyboardInterrupt, GeneratorExit, StopIteration, MemoryError,
    lambda: OSError(28, "No space left on device"), lambda: DeviceError("stage", "gone"), lambda: BaseException("odd"),
    lambda: BeamlineError("odd"), ZeroDivisionError,
)  # fmt: skip


def _odd(**fields: Any) -> CheckResult[int]:
    return CheckResult(0, replace(Flag("mass", Level.WARN, 0, 1.0, 1.0, "Look."), **fields))


ANSWERS: tuple[Any, ...] = (
    None, "fine", Flag,
    CheckResult(0, "a flag"),  # type: ignore[arg-type]
    _odd(level="bad"), _odd(check="another"), _odd(frame=99), _odd(frame=-1),
    _odd(frame="0"), _odd(first=5), _odd(score="high"), _odd(advice=None), _odd(region=(1, 2)),
    _odd(region="all"),
)  # fmt: skip
OTHERS = ("check", "answer", "output")  # of other people, which no scan depends on
PLACES = (
    *OTHERS, "next_frame", "arm", "start_move", "position", "disarm", "open", "close", "out", "append", "flush", "file",
)  # fmt: skip


class Broken:
    """Raises one of ERRORS, or returns one of ANSWERS, from a place of a scan, from the n-th call on or only then."""

    def __init__(self, patch: pytest.MonkeyPatch, place: str, which: int, nth: int, once: bool) -> None:
        self._which, self._nth, self._once, self._calls = which, nth, once, 0
        self._usual: Callable[..., Any]
        self.instrument = FakeInstrument()
        devices = self.instrument.devices
        owners: dict[str, Any] = {
            "check": (MassCheck, "look"), "answer": (MassCheck, "look"), "append": (NXtomoWriter, "append"),
            "flush": (NXtomoWriter, "flush"), "file": (NXtomoWriter, "close"), "open": (devices.shutter, "open"),
            "close": (devices.shutter, "close"), "out": (devices.sample, "out"),
            "next_frame": (devices.camera, "next_frame"),
        }  # fmt: skip
        self._place, self._usual = place, lambda event: None
        if place != "output":
            owner, name = owners.get(place, (devices.stage, place))
            self._usual = getattr(owner, name)
            patch.setattr(owner, name, lambda *given: self._call(*given))

    def _call(self, *given: Any) -> Any:
        rehearsed = self._place in OTHERS[:2] and given[2].counts.shape != SHAPE
        self._calls += not rehearsed
        if rehearsed or self._calls <= self._nth or (self._once and self._calls > self._nth + 1):
            return self._usual(*given)
        if self._place == "answer":
            return ANSWERS[self._which % len(ANSWERS)]
        raise ERRORS[self._which % len(ERRORS)]()

    def heard(self, event: object) -> None:
        if self._place == "output":
            self._call(event)


def _ran(runs: Path, place: str, which: int, nth: int, once: bool = False, mode: str = "fly") -> Ran:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_checks, "COMPILES", 600.0)  # on a busy machine
        broken = Broken(patch, place, which, nth, once)
        return Ran(runs, broken.instrument, f"scan.mode={mode}", heard=broken.heard)


def _stored(run: Path | None) -> int:
    try:
        with open_scan((run or Path()) / "scan.h5") as source:
            return len(source.table.kinds) if source.finished else 0
    except (BeamlineError, OSError):
        return 0


def _assert_told(ran: Ran, place: str) -> None:
    n = _stored(ran.folder)
    if place in OTHERS:
        assert (ran.error, n) == (None, FRAMES)
    assert n == FRAMES or ran.error is not None
    if ran.error is not None:
        assert exit_code(ran.error) != 0 and isinstance(ran.error, Exception | KeyboardInterrupt)  # not SystemExit(0)
        if failed := ran.of("failed"):
            assert failed[-1].data["exit_code"] == exit_code(ran.error)


@pytest.mark.slow
def test_a_scan_without_all_its_frames_never_ends_with_exit_code_0() -> None:
    @settings(max_examples=20, deadline=None)
    @given(
        place=st.sampled_from(PLACES), which=st.integers(0, 99), nth=st.integers(0, 24), once=st.booleans(),
        mode=st.sampled_from(("fly", "step")),
    )  # fmt: skip
    def ends(place: str, which: int, nth: int, once: bool, mode: str) -> None:
        with tempfile.TemporaryDirectory() as runs:
            _assert_told(_ran(Path(runs), place, which, nth, once, mode), place)

    ends()


@pytest.mark.parametrize(("place", "which"), [("check", 0), ("check", 2), ("answer", 0), ("answer", 6), ("file", 0)])
def test_what_is_no_exception_and_no_look_ends_no_scan_in_silence(tmp_path: Path, place: str, which: int) -> None:
    ran = _ran(tmp_path, place, which, 0 if place == "file" else 8)
    _assert_told(ran, place)
    if place in OTHERS:
        assert ["the check mass failed at frame 8" in event.data["message"] for event in ran.of("warning")] == [True]
    else:
        assert isinstance(ran.error, RuntimeError) and "SystemExit" in str(ran.error)


@pytest.mark.parametrize("aborted", [False, True])
def test_a_check_that_hangs_costs_no_frame_and_holds_up_no_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, aborted: bool
) -> None:
    """Its frame and those that wait behind it are stored; what was not judged is said."""
    for name in ("CHECKS", "ABORTED"):
        monkeypatch.setattr(frame_checks, name, 0.05 if (name == "ABORTED") is aborted else 600.0)
    monkeypatch.setattr(frame_checks, "SLICE", 0.02)
    stop, free, look = StopRequest(), threading.Event(), MassCheck.look

    def hangs(check: MassCheck, state: Any, frame: Any, *rest: Any) -> Any:
        if frame.index == 7:
            free.wait(60)
        return look(check, state, frame, *rest)

    monkeypatch.setattr(MassCheck, "look", hangs)
    instrument = FakeInstrument(Faults(), on_frame=lambda n: stop.abort() if aborted and n == 11 else None)
    began = time.monotonic()
    try:
        ran = Ran(tmp_path, instrument, stop=stop)
    finally:
        free.set()
    assert time.monotonic() - began < 30
    ran.assert_safe()
    n = 12 if aborted else FRAMES
    assert type(ran.error) is (ScanAborted if aborted else type(None))
    ran.assert_good_file(n, "stopped" if aborted else "complete")
    off, unjudged = ran.warnings
    assert "its check mass has not finished frame 7" in off
    assert f"The monitor did not check {n - 7} frames (7-{n - 1})" in unjudged
