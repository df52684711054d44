"""Following a growing file: the scan and the fit share one clock of the test's, so that nothing waits for real."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Set
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product
from multiprocessing import get_context
from multiprocessing.synchronize import Event as MpEvent
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import BeamlineError, ConfigError, DataError
from beamline.core.events import Event
from beamline.monitor.check import Flag, Level
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from beamline.projections.flags import UsableViews
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.steps.air import Air
from beamline.projections.steps.flags import Flags
from beamline.reconstruct import axis_search, snapshots
from beamline.reconstruct import follow as follow_module
from beamline.reconstruct import growing as module
from beamline.reconstruct.follow import FollowTiming, follow
from beamline.reconstruct.growing import ScanFollower
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.recon_report import ReconOutcome
from beamline.reconstruct.result import OutputPaths
from beamline.storage.parts import join
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.frame import Frame, FrameKind
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.method import Progress
from recon.base.volume import Volume
from recon.prep.align import AxisEstimate
from recon.prep.correct import Correction, Projections, Transmission
from recon.splatting.r2 import R2
from recon.splatting.stream import StreamingFit
from recon.voxels.direct import Fbp
from recon.voxels.enough_views import Goal
from recon.warm_up import warm_up
from tests.beamline.scans import DARK, TwoCylinders, frames_of

EPOCH = 1.8e9
TICK = 0.02  # s that pass with each look at the clock


class ScanClock:
    """Time passes when it is looked at; what is due by then happens."""

    def __init__(self) -> None:
        self.time = EPOCH
        self.due: list[tuple[float, Callable[[], None]]] = []

    def now(self) -> float:
        self._pass(TICK)
        return self.time

    def sleep(self, seconds: float) -> None:
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self.time += seconds
        while self.due and self.due[0][0] <= self.time:
            self.due.pop(0)[1]()


class StandingClock:
    def now(self) -> float:
        return EPOCH

    def sleep(self, seconds: float) -> None:
        pytest.fail("nobody should wait for this clock")


pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40), pixel_size_mm=0.5)
INTERLACED = replace(SCAN, angles=np.concatenate([SCAN.angles[i::3] for i in (0, 2, 1)]))
RHYTHM = FollowTiming(poll=0.1, slice=0.3, snapshot=0.6, patience=3.0)


def _schedule(
    clock: ScanClock,
    path: Path,
    frames: list[Frame],
    *,
    begin: float = 0.5,
    period: float = 0.1,
    status: str | None = "complete",
    axis_col: float | None = None,
    pause: float = 0.0,
    alarms: Set[int] = frozenset(),
    plan: str = "",
) -> None:
    """The scan: its file appears after `begin` s, takes a frame every `period` s, and is finished `pause` s after the
    last one; status None never finishes it."""
    writers: list[NXtomoWriter] = []
    info = ScanInfo(sample="two cylinders", pixel_size_mm=0.5, axis_col=axis_col, plan=plan)

    def create() -> None:
        writers.append(NXtomoWriter(path, info, frames[0].counts.shape, clock=StandingClock()))

    def append(frame: Frame) -> Callable[[], None]:
        flags = [Flag(CHECKS[0].name, Level.ALARM, frame.index, 1.0, 0.0, "")] if frame.index in alarms else []
        return lambda: writers[0].append(frame, digest(frame.counts), flags)

    start = clock.time + begin
    clock.due.append((start, create))
    clock.due += [(start + period * (i + 1), append(frame)) for i, frame in enumerate(frames)]
    end = start + period * (len(frames) + 1) + pause
    if status is not None:
        clock.due.append((end, lambda: writers[0].close(status)))
    else:
        clock.due.append((end, lambda: writers[0]._lock.release()))  # its program is dead
        # Hours later, so that the file is closed when the test is over.
        clock.due.append((end + 1e5, lambda: writers[0].close("failed")))


FIT = R2(seconds=2.0, gaussians=200)


def _options(tmp_path: Path, **changes: object) -> ReconOptions:
    output = tmp_path / "recon.h5"
    options = ReconOptions(
        source=SourceOptions(tmp_path / "scan.h5"),
        target=OutputPaths(output, None),
        selection=Selection(axis_col=SCAN.axis_col),
        method=FIT,
        command="beamline recon scan.h5 --follow",
    )
    return replace(options, **changes)  # type: ignore[arg-type]


def _close(clock: ScanClock) -> None:
    """Let the rest of the schedule happen."""
    clock.sleep(1e6)


def test_the_volume_grows_with_the_scan(tmp_path: Path) -> None:
    warm_up()  # with kernels to be compiled the scan is over before the first look
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    target = OutputPaths(tmp_path / "recon.h5", tmp_path / "report.html")
    metrics = follow(_options(tmp_path, target=target, method=replace(FIT, seconds=4.0)), events.append, clock, RHYTHM)

    names = [event.event for event in events]
    assert names[0] == "state"
    assert [event.data["state"] for event in events[:3]] == ["warming_up", "ready", "waiting"]
    watch = f"open {tmp_path / 'recon.live.png'}: drawn anew about every {RHYTHM.snapshot:g} s"
    assert watch in str(events[1].data["message"])
    assert '<a href="recon.live.png">' in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert names.count("recon_started") == 1
    assert "snapshot" in names
    assert names[-1] == "done"
    steps = [event.data for event in events if event.event == "progress" and not event.data.get("unit")]
    views = [step["n_views"] for step in steps]  # the sweeps of the finish follow
    assert views == sorted(views)
    assert views[0] < 30  # it began before the scan had ended
    assert views[-1] == 30

    record = read_reconstruction(tmp_path / "recon.h5")
    assert record.parameters["n_views"] == 30
    assert {"ssim_weight", "tv_weight", "rates", "policy_every", "seconds_after_scan", "finish"} <= set(
        record.parameters
    )
    assert record.metrics == pytest.approx(metrics)
    truth = SCAN.truth(record.volume.grid)
    assert psnr(truth, record.volume.data) > 20
    assert metrics["residual"] < 0.1
    np.testing.assert_array_equal(record.history["n_views"], views)
    assert "<html" in (tmp_path / "report.html").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recon.h5", "recon.live.png", "report.html", "scan.h5"]


@pytest.mark.parametrize("use_flags", [True, False])
def test_views_with_an_alarm_never_reach_the_volume(tmp_path: Path, use_flags: bool) -> None:
    clock, events, alarms = ScanClock(), list[Event](), {4 + i for i in range(7, 12)}
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), alarms=alarms)
    selection = Selection(axis_col=SCAN.axis_col, steps=(Flags("use" if use_flags else "ignore"),))
    follow(_options(tmp_path, selection=selection), events.append, clock, RHYTHM)
    parameters = read_reconstruction(tmp_path / "recon.h5").parameters
    assert set(parameters["view_frames"]) == set(range(4, 34)) - (alarms if use_flags else set())  # type: ignore[arg-type]
    assert parameters["views_left_out"] == 5 * use_flags
    assert sum("with an alarm" in str(event.data) or "have an alarm" in str(event.data) for event in events) == 1


@pytest.mark.parametrize("use_flags", [True, False])
def test_a_view_that_was_taken_again_leaves_the_volume(tmp_path: Path, use_flags: bool) -> None:
    """Also where its alarm was ignored, so that the model has learnt from it."""
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(INTERLACED)
    frames.append(replace(frames[12], index=34, replaces=12, time=frames[33].time + 1))
    frames[12] = replace(frames[12], counts=frames[12].counts // 40)
    _schedule(clock, tmp_path / "scan.h5", frames, alarms={12})
    selection = Selection(axis_col=SCAN.axis_col, steps=(Flags("use" if use_flags else "ignore"),))
    metrics = follow(_options(tmp_path, selection=selection), events.append, clock, RHYTHM)
    record = read_reconstruction(tmp_path / "recon.h5")
    assert set(record.parameters["view_frames"]) == set(range(4, 35)) - {12}  # type: ignore[arg-type]
    assert psnr(SCAN.truth(record.volume.grid), record.volume.data) > 20 and metrics["residual"] < 0.1
    anew = [event for event in events if "1 view turned out bad or taken again" in str(event.data.get("message"))]
    assert len(anew) == (not use_flags)


@pytest.mark.parametrize("late", [FrameKind.FLAT, FrameKind.DARK])
def test_references_that_come_after_the_views_are_waited_for(tmp_path: Path, late: FrameKind) -> None:
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(INTERLACED)
    order = [frame for frame in frames if frame.kind is not late] + [frame for frame in frames if frame.kind is late]
    _schedule(clock, tmp_path / "scan.h5", [replace(frame, index=i) for i, frame in enumerate(order)])
    metrics = follow(_options(tmp_path), events.append, clock, RHYTHM)
    waiting = [event.data["message"] for event in events if event.event == "state"]
    assert sum("when the scan has ended" in message for message in waiting) == 1
    assert metrics["residual"] < 0.1
    record = read_reconstruction(tmp_path / "recon.h5")
    assert psnr(SCAN.truth(record.volume.grid), record.volume.data) > 20


def _late_flats(frames: list[Frame], gain: float) -> list[Frame]:
    """The frames, and the flats once more at the end with another beam."""
    bright = [f for f in frames if f.kind is FrameKind.FLAT]
    after = [replace(f, counts=(f.counts * gain).astype(np.uint16)) for f in bright]
    return [replace(frame, index=i) for i, frame in enumerate([*frames, *after])]


_EVERY_PAIR = {
    ("auto", None, 0.0), ("auto", 1.3, 2.0),
    ("none", None, 2.0), ("none", 1.3, 0.0),
    ("3,3", None, 0.0), ("3,3", 1.3, 2.0),
}  # fmt: skip


@pytest.mark.parametrize(
    ("air", "gain", "pause"),
    [
        pytest.param(*three, marks=() if three in _EVERY_PAIR else pytest.mark.slow)
        for three in product(["auto", "none", "3,3"], [None, 1.3], [0.0, 2.0])
    ],
)
def test_the_model_and_its_judge_have_the_line_integrals_of_the_finished_scan_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float | None, air: str, pause: float
) -> None:
    """Also where flats at the end (of a brighter beam) change every view that the model has learnt from."""
    fits: list[StreamingFit] = []
    finish = StreamingFit.finish
    judged: list[PreparedProjections] = []
    write = follow_module.write_result

    def finish_and_keep(self: StreamingFit, *rest: Any) -> Progress:
        fits.append(self)
        return finish(self, *rest)

    def write_and_keep(outcome: ReconOutcome, prepared: PreparedProjections, *rest: Any) -> dict[str, float]:
        judged.append(prepared)
        return write(outcome, prepared, *rest)

    monkeypatch.setattr(StreamingFit, "finish", finish_and_keep)
    monkeypatch.setattr(follow_module, "write_result", write_and_keep)
    clock, events = ScanClock(), list[Event]()
    frames = frames_of(INTERLACED)
    _schedule(clock, tmp_path / "scan.h5", frames if gain is None else _late_flats(frames, gain), pause=pause)
    selection = Selection(axis_col=SCAN.axis_col, steps=(Air(air),))
    follow(_options(tmp_path, selection=selection), events.append, clock, RHYTHM)

    with open_scan(tmp_path / "scan.h5") as source:
        whole = prepare_projections(source, selection, pytest.fail)  # type: ignore[arg-type]
    np.testing.assert_array_equal(judged[0].projections.data, whole.projections.data)
    np.testing.assert_array_equal(judged[0].projections.view_ids, whole.projections.view_ids)
    problem = fits[0]._problem
    assert problem is not None
    np.testing.assert_array_equal(np.stack(problem.images), whole.projections.data / problem.scale)
    again = [event for event in events if event.event == "state" and event.data["state"] == "correcting"]
    if gain is not None:
        assert [event.data["message"].split(",")[0] for event in again] == ["Flats or darks came after views"]
    elif air != "auto":  # air columns that are found may change with the last views; others may not
        assert not again


def _brighter(frame: Frame, index: int) -> Frame:
    """The frame as a beam of 1.3 times the light gives it."""
    counts = frame.counts if frame.kind is FrameKind.DARK else DARK + 1.3 * (frame.counts - DARK)
    return replace(frame, counts=np.round(counts).astype(np.uint16), index=index, time=frame.time + 3600)


def test_a_run_that_goes_on_is_followed_with_the_views_that_it_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The beam changed in between: views are corrected by the flats of their own part, already while they come."""
    frames, clock, events = frames_of(INTERLACED), ScanClock(), list[Event]()
    plan = {"angles_deg": np.degrees(INTERLACED.angles).tolist()}
    plan |= {kind: {"count": 2, "at": "start"} for kind in ("darks", "flats")}
    _schedule(clock, tmp_path / "scan.h5", frames[:16], status="stopped", plan=json.dumps(plan))
    _close(clock)
    later = [_brighter(frame, i) for i, frame in enumerate([*frames[:4], *frames[16:]])]
    _schedule(clock, tmp_path / "rest.h5", later, plan=json.dumps(plan))

    live: list[Projections] = []
    judged: list[PreparedProjections] = []
    again, write = ScanFollower._correct_again, follow_module.write_result

    def as_it_was(self: ScanFollower, usable: UsableViews, why: str) -> None:
        live.append(self._joined())
        again(self, usable, why)

    def write_and_keep(outcome: ReconOutcome, prepared: PreparedProjections, *rest: Any) -> dict[str, float]:
        judged.append(prepared)
        return write(outcome, prepared, *rest)

    monkeypatch.setattr(ScanFollower, "_correct_again", as_it_was)
    monkeypatch.setattr(follow_module, "write_result", write_and_keep)
    selection = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
    source = SourceOptions(tmp_path / "rest.h5", earlier=(tmp_path / "scan.h5",))
    goal = Goal(psnr_loss=0.01)
    follow(_options(tmp_path, source=source, selection=selection, enough=goal), events.append, clock, RHYTHM)

    join([tmp_path / "scan.h5", tmp_path / "rest.h5"], tmp_path / "joined.h5")
    with open_scan(tmp_path / "joined.h5") as joined:
        whole = prepare_projections(joined, selection, lambda said: None)
    assert whole.projections.view_ids.size == 30
    np.testing.assert_array_equal(judged[0].projections.data, whole.projections.data)
    np.testing.assert_array_equal(judged[0].projections.view_ids, whole.projections.view_ids)
    np.testing.assert_array_equal(judged[0].geometry.angles, whole.geometry.angles)
    assert [part.view_ids.size for part in live] == [12, 30]
    np.testing.assert_allclose(live[1].data, whole.projections.data, atol=1e-6)
    states = [event.data for event in events if event.event == "state" and event.data["state"] == "correcting"]
    messages = [data["message"] for data in states]
    assert len(messages) == 2
    assert "next part of the run begin" in messages[0]
    assert "The run has several parts" in messages[1]
    first = next(event for event in events if event.event == "snapshot")
    assert first.data["n_views"] >= 12 and first.time < EPOCH + 1e6 + 60
    warned = [event.data["message"] for event in events if event.event == "warning"]
    assert sum("goes on with a run" in said and "not stopped early" in said for said in warned) == 1
    assert not any("flats of their own" in said or "parts of a scan" in said for said in warned)


def test_nothing_is_corrected_twice_where_all_references_came_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corrected: list[int] = []
    line_integrals = Correction.line_integrals

    def count(self: Correction, views: Transmission | None, last: bool = True, *told: Any) -> Projections:
        part = line_integrals(self, views, last, *told)
        corrected.extend(part.view_ids.tolist())
        return part

    monkeypatch.setattr(Correction, "line_integrals", count)
    monkeypatch.setattr(Correction, "provisional", lambda self: None)  # a first look at the newest view apart
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    selection = Selection(axis_col=SCAN.axis_col, steps=(Air("3,3"),))
    follow(_options(tmp_path, selection=selection), lambda event: None, clock, RHYTHM)
    assert len(corrected) == 30 and len(set(corrected)) == 30


def test_the_newest_view_does_not_wait_for_the_next_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, fed, arrived = ScanClock(), dict[int, float](), dict[int, float]()
    add, append = StreamingFit.add_views, NXtomoWriter.append

    def taken(model: StreamingFit, data: np.ndarray, angles: Any) -> None:
        add(model, data, angles)
        fed.update({model.n_views - 1 - k: clock.time for k in range(len(data))})

    def written(writer: NXtomoWriter, frame: Frame, *rest: Any) -> None:
        append(writer, frame, *rest)
        arrived[frame.index - 4] = clock.time

    monkeypatch.setattr(StreamingFit, "add_views", taken)
    monkeypatch.setattr(NXtomoWriter, "append", written)
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), period=2.0)
    follow(_options(tmp_path), lambda event: None, clock, RHYTHM)
    assert max(fed[view] - arrived[view] for view in range(30)) < RHYTHM.slice + RHYTHM.poll + 10 * TICK


def test_the_last_round_can_be_ended_early_with_what_there_is(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))

    @contextmanager
    def at_the_end() -> Iterator[Callable[[], bool]]:
        yield lambda: any(event.data.get("state") == "finishing" for event in events)

    follow(_options(tmp_path, method=replace(FIT, seconds=1e5)), events.append, clock, RHYTHM, at_the_end)
    assert events[-1].event == "done"
    parameters = read_reconstruction(tmp_path / "recon.h5").parameters
    assert parameters["ended_early"] and parameters["n_views"] == 30


@pytest.mark.parametrize("seconds", [1.5, 3.0])
def test_a_stop_while_the_scan_runs_delivers_the_views_so_far_if_they_make_a_volume(
    tmp_path: Path, seconds: float
) -> None:
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))

    @contextmanager
    def soon() -> Iterator[Callable[[], bool]]:
        yield lambda: clock.time > EPOCH + seconds

    options = _options(tmp_path, method=replace(FIT, seconds=1e5))
    if seconds < 2:  # seven views
        with pytest.raises(KeyboardInterrupt):
            follow(options, events.append, clock, RHYTHM, soon)
        assert not options.target.output.exists()
    else:
        follow(options, events.append, clock, RHYTHM, soon)
        parameters = read_reconstruction(tmp_path / "recon.h5").parameters
        n_views = int(parameters["n_views"])
        assert parameters["ended_early"] and 16 <= n_views < 30
        told = [event.data["message"] for event in events if event.event == "warning"]
        assert f"Stopped while the scan runs: the volume is of the first {n_views} views." in told
    _close(clock)


def test_a_stop_does_not_wait_for_all_views_of_a_scan_that_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    _close(clock)
    monkeypatch.setattr(module, "_BATCH", 8)

    @contextmanager
    def at_once() -> Iterator[Callable[[], bool]]:
        yield lambda: True

    follow(_options(tmp_path), events.append, clock, RHYTHM, at_once)
    assert events[-1].event == "done"
    n_views = int(read_reconstruction(tmp_path / "recon.h5").parameters["n_views"])
    assert 16 <= n_views < 30
    told = [event.data["message"] for event in events if event.event == "warning"]
    assert f"Stopped: the volume is of the first {n_views} of 30 views." in told


def test_a_scan_that_waits_is_waited_for_as_long_as_its_writer_lives(tmp_path: Path) -> None:
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), pause=5 * RHYTHM.patience)
    follow(_options(tmp_path), lambda event: None, clock, RHYTHM)
    assert read_reconstruction(tmp_path / "recon.h5").parameters["n_views"] == 30


def test_one_of_so_many_views_feeds_the_volume(tmp_path: Path) -> None:
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), alarms={12})
    follow(_options(tmp_path, selection=Selection("every:2", axis_col=SCAN.axis_col)), [].append, clock, RHYTHM)
    n_views = int(read_reconstruction(tmp_path / "recon.h5").parameters["n_views"])
    assert n_views in (14, 15)  # of 30, one of them or of the others with an alarm


def test_snapshots_are_whole_volumes_while_the_scan_runs(tmp_path: Path) -> None:
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    seen: list[tuple[int, float]] = []
    unlearnt: list[float] = []

    def look(event: Event) -> None:
        if event.event == "snapshot":
            record = read_reconstruction(Path(event.data["path"]))
            assert record.parameters["n_views"] == event.data["n_views"]
            picture = Path(event.data["picture"])
            assert picture == tmp_path / "recon.live.png" and picture.read_bytes().startswith(b"\x89PNG")
            unlearnt.append(event.data["unlearnt"])
            seen.append((event.data["n_views"], psnr(SCAN.truth(record.volume.grid), record.volume.data)))

    follow(_options(tmp_path), look, clock, RHYTHM)
    assert len(seen) >= 3
    assert seen[-1][0] > seen[0][0]
    assert max(quality for _, quality in seen) > 18
    known = [u for u in unlearnt if np.isfinite(u)]
    assert known[-1] < known[0] < 1  # of views that no step had seen
    assert (tmp_path / "recon.live.png").exists()  # the report links it
    assert not (tmp_path / "recon.snapshot.h5").exists()  # the volume is there


def _write_and_wait(path: Path, frames: list[Frame], written: MpEvent, close: MpEvent) -> None:
    writer = NXtomoWriter(path, ScanInfo(sample="two cylinders"), frames[0].counts.shape, clock=StandingClock())
    for frame in frames:
        writer.append(frame, digest(frame.counts), [])
    written.set()
    close.wait(60)
    writer.close("complete")


@pytest.mark.slow  # a process starts
def test_the_report_has_the_facts_of_the_closed_file(tmp_path: Path) -> None:
    """A writer of another process writes texts anew when it closes the file, which the follower has open."""
    spawn = get_context("spawn")
    written, close = spawn.Event(), spawn.Event()
    arguments = (tmp_path / "scan.h5", frames_of(INTERLACED), written, close)
    writer = spawn.Process(target=_write_and_wait, args=arguments)
    writer.start()
    assert written.wait(60)

    def look(event: Event) -> None:
        if event.event == "snapshot" and not close.is_set():
            close.set()
            writer.join(60)

    target = OutputPaths(tmp_path / "recon.h5", tmp_path / "report.html")
    follow(_options(tmp_path, target=target), look, ScanClock(), RHYTHM)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"end_time</th><td>{datetime.fromtimestamp(EPOCH, UTC).isoformat(timespec='milliseconds')}</td>" in page


def test_enough_views_are_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    golden = np.pi * (np.arange(60) * (5**0.5 - 1) / 2 % 1)
    scan = replace(SCAN, angles=golden)
    asked: list[tuple[int, int]] = []

    def predicted(data: np.ndarray, planned: Geometry, rng: np.random.Generator, n: int) -> list[float]:
        np.testing.assert_allclose(planned.angles, golden, atol=1e-6)
        asked.append((len(data), planned.n_views))
        return [4.0 / len(data)] * n

    monkeypatch.setattr("beamline.reconstruct.enough.predicted_gains", predicted)
    clock, events = ScanClock(), list[Event]()
    plan = json.dumps({"angles_deg": np.degrees(golden).tolist()})
    _schedule(clock, tmp_path / "scan.h5", frames_of(scan), plan=plan)
    follow(_options(tmp_path, enough=Goal(psnr_loss=0.2)), events.append, clock, RHYTHM)
    (enough,) = [event.data for event in events if event.event == "enough"]
    assert 24 < enough["n_views"] < 60 == enough["planned"]
    assert enough["high"] <= 0.2 and enough["low"] <= enough["mean"] <= enough["high"]
    assert asked[0][0] >= 24 and asked[-1][0] == enough["n_views"]


def test_where_the_plan_is_not_known_no_views_are_enough(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    scan = replace(INTERLACED, angles=np.radians(np.arange(0, 180, 3.0))[np.argsort(np.arange(60) * 0.618 % 1)])
    _schedule(clock, tmp_path / "scan.h5", frames_of(scan))
    follow(_options(tmp_path, enough=Goal(psnr_loss=9.0)), events.append, clock, RHYTHM)
    assert sum("does not say which views are planned" in str(e.data.get("message")) for e in events) == 1
    assert "enough" not in [event.event for event in events]


def test_the_file_s_axis_is_taken_and_a_finished_scan_followed(tmp_path: Path) -> None:
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(SCAN), begin=0.0, period=0.0, axis_col=20.25)
    clock.sleep(1.0)
    events: list[Event] = []
    follow(_options(tmp_path, selection=Selection()), events.append, clock, RHYTHM)
    assert events[-1].data["axis_col"] == 20.25


def test_the_axis_is_found_while_the_views_come(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    follow(_options(tmp_path, selection=Selection()), events.append, clock, RHYTHM)
    started = [event.data for event in events if event.event == "recon_started"]
    assert started[0]["n_views"] < 30
    assert events[-1].data["axis_col"] == pytest.approx(SCAN.axis_col, abs=0.3)


def test_a_better_axis_begins_the_fit_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locate(source: object, corrector: object, frames: np.ndarray, warn: object) -> tuple[float, AxisEstimate]:
        value = 18.0 if frames.size < 20 else 20.7
        return value, AxisEstimate(value, np.arange(3.0), np.arange(3.0), True, "pair")

    monkeypatch.setattr(axis_search, "locate_axis", locate)
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    metrics = follow(
        _options(tmp_path, selection=Selection(), method=replace(FIT, seconds=4.0)), events.append, clock, RHYTHM
    )
    assert [e.data["axis_col"] for e in events if e.event == "recon_started"] == [18.0, 20.7]
    assert events[-1].data["axis_col"] == 20.7
    assert [e.data["again"] for e in events if e.event == "recon_started"] == [False, True]
    history = read_reconstruction(tmp_path / "recon.h5").history
    assert history["n_views"][-1] == 30
    assert np.all(np.diff(history["seconds"]) > 0)  # one time, though the second fit began later
    assert metrics["residual"] < 0.1


def test_an_axis_without_a_clear_optimum_waits_for_the_end_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "beamline.projections.axis.find_axis",
        lambda data, angles: AxisEstimate(20.7, np.arange(3.0), np.arange(3.0), False, "pair"),
    )
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    follow(_options(tmp_path, selection=Selection()), events.append, clock, RHYTHM)
    (started,) = [event.data for event in events if event.event == "recon_started"]
    assert started["n_views"] == 30
    assert any(e.event == "warning" and "not a clear optimum" in e.data["message"] for e in events)


def _no_scan(clock: ScanClock, path: Path) -> None:
    pass


def _dies(clock: ScanClock, path: Path) -> None:
    _schedule(clock, path, frames_of(INTERLACED)[:16], status=None)


def _ends_without_views(clock: ScanClock, path: Path) -> None:
    _schedule(clock, path, frames_of(INTERLACED)[:4], status="stopped")


def _ends_with_one_view(clock: ScanClock, path: Path) -> None:
    _schedule(clock, path, frames_of(INTERLACED)[:5], status="stopped")


def _has_no_flats(clock: ScanClock, path: Path) -> None:
    frames = [f for f in frames_of(INTERLACED) if f.kind != 1]
    _schedule(clock, path, [replace(f, index=i) for i, f in enumerate(frames)])


SO_FAR = ("recon.snapshot.h5", "recon.live.png")


@pytest.mark.parametrize(
    ("scan", "said", "left"),
    [
        (_no_scan, "No scan began in .* within 3 s", set()),
        (_dies, "has not grown for 3 s and is not finished.*12 views", {"scan.h5", *SO_FAR}),
        (_ends_without_views, "0 projections", {"scan.h5"}),
        (_ends_with_one_view, "1 projections", {"scan.h5"}),
        (_has_no_flats, "without flats", {"scan.h5"}),
    ],
)
def test_scans_that_make_no_volume(
    tmp_path: Path, scan: Callable[[ScanClock, Path], None], said: str, left: set[str]
) -> None:
    clock = ScanClock()
    scan(clock, tmp_path / "scan.h5")
    with pytest.raises(DataError, match=said):
        follow(_options(tmp_path), lambda event: None, clock, RHYTHM)
    assert {p.name for p in tmp_path.iterdir()} == left
    _close(clock)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"method": Fbp()}, ConfigError),
        ({"selection": Selection(views="fixed:5")}, ConfigError),
        ({"method": R2(steps=10)}, ConfigError),
        ({"truth": "missing.npz"}, ConfigError),
    ],
)
def test_what_cannot_be_followed_is_refused_at_once(
    tmp_path: Path, changes: dict[str, object], error: type[BeamlineError]
) -> None:
    with pytest.raises(error):
        follow(_options(tmp_path, **changes), lambda event: None, ScanClock(), RHYTHM)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_result_stays(tmp_path: Path) -> None:
    (tmp_path / "recon.h5").write_text("precious")
    with pytest.raises(DataError, match="never overwritten"):
        follow(_options(tmp_path), lambda event: None, ScanClock(), RHYTHM)
    assert (tmp_path / "recon.h5").read_text() == "precious"


def test_snapshots_a_viewer_holds_open_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = snapshots.write_reconstruction

    def write(path: Path, record: object, *, replace: bool = False) -> None:
        if "snapshot" in path.name:
            raise DataError("the file is in use")
        real(path, record, replace=replace)  # type: ignore[arg-type]

    monkeypatch.setattr(snapshots, "write_reconstruction", write)
    clock, events = ScanClock(), list[Event]()
    _schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    follow(_options(tmp_path), events.append, clock, RHYTHM)
    assert any("snapshot was left out" in str(e.data.get("message")) for e in events)
    assert "snapshot" not in [e.event for e in events]
    assert h5py.is_hdf5(tmp_path / "recon.h5")


def test_volume_is_of_the_whole_selection(tmp_path: Path) -> None:
    clock = ScanClock()
    _schedule(clock, tmp_path / "scan.h5", frames_of(replace(INTERLACED, shape=(4, 40))))
    selection = Selection(rows=(1, 3), binning=2, axis_col=SCAN.axis_col)
    follow(_options(tmp_path, selection=selection), lambda event: None, clock, RHYTHM)
    volume: Volume = read_reconstruction(tmp_path / "recon.h5").volume
    assert volume.grid.shape == (1, 20, 20)
    assert volume.grid.voxel_size == pytest.approx(1.0)
