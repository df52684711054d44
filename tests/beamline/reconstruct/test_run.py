"""Time limit of a call: how much the fit gets, what is said if that is too little, and what is then left out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.reconstruct.run import fit_within
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import SystemClock
from recon.base.geometry import Geometry
from recon.splatting.r2 import R2
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.clock import SteppedClock

pytestmark = pytest.mark.usefixtures("one_thread")

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 32, endpoint=False), (4, 40))


def _within(seconds: float, spent: float, report: bool = True) -> tuple[float, float, list[str]]:
    """What the fit gets, what report and writing get, and what was said."""
    said: list[str] = []
    target = OutputPaths(Path("out.h5"), Path("out.html") if report else None)
    started = 100.0, time.process_time() - spent  # all of the machine is ours
    method, before_report = fit_within(
        R2(seconds=seconds), seconds, VIEWS, target, started, SteppedClock(100.0 + spent), said.append
    )
    assert method.time_limit is not None
    return method.time_limit, 100.0 + seconds - before_report.deadline, said


def test_a_fit_gets_the_time_that_reading_measuring_and_writing_leave() -> None:
    left, after, said = _within(100.0, spent=20.0)
    measuring = 5  # a twentieth
    assert left + 20 + measuring + after == pytest.approx(100)
    assert 5 <= after <= 20 and said == []
    without_report, _, _ = _within(100.0, spent=20.0, report=False)
    assert without_report == pytest.approx(100 - 20 - measuring, abs=0.1)


def test_too_few_seconds_are_told_before_the_fit_with_what_it_will_take() -> None:
    left, _, said = _within(12.0, spent=9.0)
    assert left == 0
    assert len(said) == 1 and "12 s is not enough" in said[0] and "correction took 9 s" in said[0]


def _told(
    folder: Path, method: R2, clock: SteppedClock | SystemClock, stop: Callable[[], bool] = lambda: False
) -> tuple[list[Event], list[str]]:
    """Events of a reconstruction, and its phases."""
    events: list[Event] = []
    options = ReconOptions(
        source=SourceOptions(write_exchange(folder / "scan.h5", TwoCylinders(shape=(2, 40), pixel_size_mm=0.5))),
        target=OutputPaths(folder / "out.h5", folder / "out.html"),
        selection=Selection(),
        method=method,
    )

    @contextmanager
    def scope() -> Iterator[Callable[[], bool]]:
        yield stop

    reconstruct_file(options, events.append, clock, scope)
    return events, list(events[-1].data["times"])


def test_a_call_with_too_few_seconds_says_so_before_the_fit_and_leaves_out_what_it_can(tmp_path: Path) -> None:
    events, phases = _told(tmp_path, R2(seconds=2.0, gaussians=50), SteppedClock(tick=0.1))
    said = [str(event.data.get("message", "")) for event in events]
    fit = next(n for n, event in enumerate(events) if event.data.get("stage") == "recon")
    assert any("2 s is not enough" in text for text in said[:fit])
    assert "FBP for comparison" not in phases and "fbp" not in events[-1].data
    remark = next(text for text in said[fit:] if text.startswith("These checks were left out, because the time limit"))
    assert remark in (tmp_path / "out.html").read_text()


def test_who_stops_a_fit_waits_for_no_comparison(tmp_path: Path) -> None:
    events, phases = _told(tmp_path, replace(R2(gaussians=50), steps=100), SystemClock(), stop=lambda: True)
    assert events[-1].data["ended_early"] and "FBP for comparison" not in phases
    assert any("the reconstruction was stopped" in str(event.data.get("message")) for event in events)
