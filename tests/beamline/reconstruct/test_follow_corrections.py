"""Line integrals during a scan equal those of the finished scan: flags, late flats and darks, parts of a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct import live_end, live_steps, pipeline
from beamline.reconstruct.live_states import Feeds, LiveScan
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.reconstruct.record import write_result
from beamline.reconstruct.scan_facts import MadeVolume
from beamline.storage.parts import join
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.frame import Frame, FrameKind
from recon.assess.metrics import psnr
from recon.base.method import Progress
from recon.prep.projections import Projections
from recon.splatting.stream import StreamingFit
from recon.splatting.stream_states import Growing
from tests.beamline.reconstruct.growing_scan import (
    BRIEF,
    EPOCH,
    INTERLACED,
    SCAN,
    ScanClock,
    alarms,
    close,
    options,
    schedule,
)
from tests.beamline.scans import DARK, TwoCylinders, frames_of
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> list[PreparedProjections]:
    """The views that volumes are judged by."""
    seen: list[PreparedProjections] = []
    write = write_result

    def write_and_keep(made: MadeVolume, *rest: Any) -> ReconRecord:
        seen.append(made.prepared)
        return write(made, *rest)

    monkeypatch.setattr(pipeline, "write_result", write_and_keep)
    return seen


@pytest.mark.slow
def test_views_with_an_alarm_never_reach_the_volume(tmp_path: Path) -> None:
    clock, events, bad = ScanClock(), list[Event](), range(11, 16)
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), flags=alarms(*bad))
    selection = Selection(axis_col=SCAN.axis_col, steps=(Preparation("use"),))
    reconstruct_file(options(tmp_path, selection=selection, method=BRIEF), events.append, clock)
    parameters = read_reconstruction(tmp_path / "recon.h5").parameters
    assert set(np.ravel(parameters["view_frames"])) == set(range(4, 34)) - set(bad)
    assert parameters["views_left_out"] == 5
    assert sum("with an alarm" in str(event.data) or "have an alarm" in str(event.data) for event in events) == 1


@pytest.mark.slow
def test_a_view_that_was_taken_again_leaves_the_volume(tmp_path: Path) -> None:
    """Its alarm was ignored, so that the model has learnt from it."""
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(INTERLACED)
    frames.append(replace(frames[12], index=34, replaces=12, time=frames[33].time + 1))
    frames[12] = replace(frames[12], counts=frames[12].counts // 40)
    schedule(clock, tmp_path / "scan.h5", frames, flags=alarms(12))
    selection = Selection(axis_col=SCAN.axis_col, steps=(Preparation("ignore"),))
    metrics = reconstruct_file(options(tmp_path, selection=selection), events.append, clock).metrics
    record = read_reconstruction(tmp_path / "recon.h5")
    assert set(np.ravel(record.parameters["view_frames"])) == set(range(4, 35)) - {12}
    assert psnr(SCAN.truth(record.volume.grid), record.volume.data) > 20 and metrics["residual"] < 0.1
    said = "The fit continues without 1 projection that the monitor has flagged meanwhile"
    anew = [event for event in events if said in str(event.data.get("message"))]
    assert len(anew) == 1


@pytest.mark.slow
def test_references_that_come_after_the_views_are_waited_for(tmp_path: Path) -> None:
    late = FrameKind.DARK
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(INTERLACED)
    order = [frame for frame in frames if frame.kind is not late] + [frame for frame in frames if frame.kind is late]
    schedule(clock, tmp_path / "scan.h5", [replace(frame, index=i) for i, frame in enumerate(order)])
    metrics = reconstruct_file(options(tmp_path), events.append, clock).metrics
    waiting = [event.data["message"] for event in events if event.event == "state"]
    assert sum("The reconstruction starts after the scan" in message for message in waiting) == 1
    assert metrics["residual"] < 0.1
    record = read_reconstruction(tmp_path / "recon.h5")
    assert psnr(SCAN.truth(record.volume.grid), record.volume.data) > 20


def _late_flats(frames: list[Frame], gain: float) -> list[Frame]:
    """The frames, and the flats once more at the end with another beam."""
    bright = [f for f in frames if f.kind is FrameKind.FLAT]
    after = [replace(f, counts=(f.counts * gain).astype(np.uint16)) for f in bright]
    return [replace(frame, index=i) for i, frame in enumerate([*frames, *after])]


@pytest.mark.parametrize(
    ("air", "gain", "pause", "scan"),
    others_slow(
        [
            ("auto", 1.3, 2.0, INTERLACED),
            ("none", 1.3, 0.0, SCAN),  # in even steps: the flats at the end alone outdate the correction
            ("3,3", None, 2.0, INTERLACED),
        ]
    ),
)
def test_the_model_and_its_judge_have_the_line_integrals_of_the_finished_scan_to_the_bit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    judged: list[PreparedProjections],
    gain: float | None,
    air: str,
    pause: float,
    scan: TwoCylinders,
) -> None:
    """Also where flats at the end (of a brighter beam) change every view that the model has learnt from."""
    fits: list[StreamingFit] = []
    finish = StreamingFit.finish

    def finish_and_keep(self: StreamingFit, *rest: Any) -> Progress:
        fits.append(self)
        return finish(self, *rest)

    monkeypatch.setattr(StreamingFit, "finish", finish_and_keep)
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(scan)
    schedule(clock, tmp_path / "scan.h5", frames if gain is None else _late_flats(frames, gain), pause=pause)
    selection = Selection(axis_col=SCAN.axis_col, steps=(Air(air),))
    reconstruct_file(options(tmp_path, selection=selection, method=BRIEF), events.append, clock)

    told = list[str]()
    with open_scan(tmp_path / "scan.h5") as source:
        whole = prepare_projections(select(source, selection), told.append)
    # Flats of another light that no air corrects are told of.
    assert not told or ((air, gain) == ("none", 1.3) and all("in line integral" in each for each in told))
    np.testing.assert_array_equal(judged[0].seen.data, whole.seen.data)
    np.testing.assert_array_equal(judged[0].ids, whole.ids)
    model = fits[0]._stage
    assert isinstance(model, Growing)
    problem = model.problem
    np.testing.assert_array_equal(np.stack(problem.images), whole.seen.data / problem.scale)
    again = [event for event in events if event.event == "state" and event.data["state"] == "correcting"]
    assert [event.data["message"].split(",")[0] for event in again] == ["Correcting all projections again"]


def _brighter(frame: Frame, index: int) -> Frame:
    """The frame as a beam of 1.3 times the light gives it."""
    counts = frame.counts if frame.kind is FrameKind.DARK else DARK + 1.3 * (frame.counts - DARK)
    return replace(frame, counts=np.round(counts).astype(np.uint16), index=index, time=frame.time + 3600)


@pytest.mark.slow
def test_a_run_that_goes_on_is_followed_with_the_views_that_it_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, judged: list[PreparedProjections]
) -> None:
    """The beam changed in between: views are corrected by the flats of their own part, already while they come."""
    frames, clock, events = frames_of(INTERLACED), ScanClock(), list[Event]()
    plan = {"angles_deg": np.degrees(INTERLACED.angles).tolist()}
    plan |= {kind: {"count": 2, "at": "start"} for kind in ("darks", "flats")}
    schedule(clock, tmp_path / "scan.h5", frames[:16], status="stopped", plan=json.dumps(plan))
    close(clock)
    later = [_brighter(frame, i) for i, frame in enumerate([*frames[:4], *frames[16:]])]
    schedule(clock, tmp_path / "rest.h5", later, plan=json.dumps(plan))

    live: list[Projections] = []
    again = live_steps.corrected_again

    def as_it_was(scan: LiveScan, state: Feeds, *given: Any) -> Feeds:
        live.append(live_steps.joined(state))
        return again(scan, state, *given)

    for module in (live_steps, live_end):
        monkeypatch.setattr(module, "corrected_again", as_it_was)
    selection = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
    source = SourceOptions(tmp_path / "rest.h5", earlier=(tmp_path / "scan.h5",))
    wanted = options(tmp_path, source=source, selection=selection, method=BRIEF)
    reconstruct_file(wanted, events.append, clock)

    join([tmp_path / "scan.h5", tmp_path / "rest.h5"], tmp_path / "joined.h5")
    with open_scan(tmp_path / "joined.h5") as joined:
        whole = prepare_projections(select(joined, selection), lambda said: None)
    assert whole.ids.size == 30
    np.testing.assert_array_equal(judged[0].seen.data, whole.seen.data)
    np.testing.assert_array_equal(judged[0].ids, whole.ids)
    np.testing.assert_array_equal(judged[0].geometry.angles, whole.geometry.angles)
    assert [part.view_ids.size for part in live] == [12, 30]
    np.testing.assert_allclose(live[1].data, whole.seen.data, atol=1e-6)
    states = [event.data for event in events if event.event == "state" and event.data["state"] == "correcting"]
    begins, has_parts = [data["message"] for data in states]
    assert "the next part of the run starts" in begins and "the run has several parts" in has_parts
    first = next(event for event in events if event.event == "snapshot")
    assert first.data["n_views"] >= 12 and first.time < EPOCH + 1e6 + 60
    warned = [event.data["message"] for event in events if event.event == "warning"]
    assert not any("no usable flats" in said or "parts of a scan" in said for said in warned)
