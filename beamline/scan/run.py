"""Run: one scan from configuration to file, in its own folder, reported by events, and closed in any case."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from beamline.config.load import Config, resolved_yaml
from beamline.config.monitor import policies
from beamline.core.errors import (
    ConfigError,
    DataError,
    ReferencesError,
    ScanStopped,
    exit_code,
    is_defect,
    leave_traceback,
    user_message,
)
from beamline.core.events import Failed, RunDone, RunStarted, ScanDone, Sink, StateEntered, Warned
from beamline.core.files import CONFIG, EVENTS, RECON, RECON_LOG, REPORT, SCAN, USER_LOG, create_run_folder, new_log
from beamline.core.run_result import RunResult
from beamline.core.sinks import Announcer, JsonLines, UserLog, fan_out
from beamline.core.stop import PauseRequest, ScanAborted, StopRequest
from beamline.core.text import count
from beamline.instrument.connect import ConnectedDevices, connect, enter_pressed
from beamline.plan.choose import Wish
from beamline.plan.plan import Block, Retake, spread_retakes
from beamline.plan.timeline import block_seconds
from beamline.scan.acquisition import Acquisition
from beamline.scan.backlog import prepare_memory
from beamline.scan.control import NEXT, State, StateMachine, verbs_taken
from beamline.scan.decider import Decider
from beamline.scan.flagged import AlarmReaction, FlaggedFrames
from beamline.scan.ledger import LedgerError
from beamline.scan.live_process import LiveCommand, LiveReconstruction, live_should_end, reconstruct
from beamline.scan.preflight import ReadyScan, all_of, preflight
from beamline.scan.recorder import Recorder
from beamline.scan.references import REFERENCES, ReferenceReport
from beamline.scan.resume import ResumableRun
from beamline.scan.runs import record_sink
from beamline.scan.supervision import PAUSE_POLL, BeamLog, Supervision, beam_log
from beamline.scan.watchdog import watched
from beamline.simulate import LabelLog, labels_path, write_labels
from beamline.storage.run_record import RecordFile, RunRecord
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.clock import Clock, SystemClock
from drivers.in_beam import Ask
from drivers.stages.shared import FOUND

SAFE = "Stage stopped, shutter closed; the last frames are being written"  # Message of the state `finishing`

READY_WITHIN = 300.0
"""Real s that a scan waits for its live reconstruction, which compiles once on a machine; see `_Run._wait_for`."""

UNSAFE = (
    "Stage, camera or shutter did not obey at the end: look at the instrument before anybody goes near the beam; "
    "the last frames are being written"
)
"""The same where a device failed while the instrument was made safe; warnings name it."""


def run_scan(
    config: Config,
    runs: Path | ResumableRun | None = None,
    sinks: Sequence[Sink] = (),
    stop: StopRequest | None = None,
    *,
    live: LiveCommand | None = None,
    instrument: ConnectedDevices | None = None,
    ask: Ask | None = None,
    afterwards: LiveCommand | None = None,
) -> RunResult:
    """Run the scan that `config` describes.

    Args:
        runs: the folder in which the run gets its own; the configured one unless given. Or the run that goes on, with
            the configuration that it has.
        sinks: besides events.jsonl and user.log in the run's folder.
        stop: ends the scan from another thread or a signal handler.
        live: gives the command line of a live reconstruction; None: there is none.
        afterwards: gives the command line of a reconstruction of the complete scan; a scan that ends early has none.
        instrument: connected devices, left open at the end; None: those that `config` names, opened and closed here.
        ask: puts a request to the operator, if the shutter or the sample is moved by hand.

    Raises:
        ConfigError: the plan breaks a limit, or the instrument is another than the run began with; nothing has moved.
        DeviceError, InstrumentError: a device failed. ScanStopped, ScanAborted: it was requested.
        ReferencesError: darks or flats cannot be used; no projection was taken.
        DataError: frames are missing (LedgerError), or the disk failed. In all these cases what was acquired is in
            the file; the event `scan_done` says how much, and `failed` why.
    """
    if config.scan.energies is not None:
        raise ConfigError(
            "scan.energies lists several scans, but this call runs one: set scan.energy. Nothing was started."
        )
    began = time.monotonic()
    stop = stop or StopRequest()
    series = runs if isinstance(runs, ResumableRun) else None
    place = runs.run if isinstance(runs, ResumableRun) else runs or Path(config.storage.folder)
    with ExitStack() as connected:
        if instrument is None:
            devices = connect(config, clock=_clock(config, series), ask=ask, check_stop=lambda: _refuse_stop(stop))
            instrument = connected.enter_context(devices)
        instrument.watch_moves(stop.refuse_abort)
        still = series.remaining if series else all_of
        ready = preflight(config, instrument, place, still, check_stop=lambda: _refuse_stop(stop))
        _refuse_stop(stop)
        remarks = [*_settings_before(ready)]
        folder = series.begin(ready) if series else create_run_folder(place, _named(config), SystemClock().now())
        with ExitStack() as stack:
            record, *logs = _logs(config, ready, folder, stack)
            if series is not None:
                series.lock.release()  # that of the part keeps others away from here on
            # The record in a thread of its own: a terminal that takes no event does not hold it up.
            announcers = [Announcer(each, instrument.clock) for each in ([record], [*logs, *sinks])]
            sink = fan_out(*map(stack.enter_context, announcers))
            for sentence in remarks:
                sink(Warned(sentence))
            run = _Run(config, instrument, ready, folder, stop, sink, began, series)
            stack.enter_context(verbs_taken(folder, stop, run.pause, run.decider.answer))
            guarded = stack.enter_context(ExitStack())  # until the instrument is free for another scan
            if config.simulation is None:
                pause = run.pause if config.scan.without_watchdog == "pause" else None
                guarded.enter_context(watched(folder, sink, stop, pause))
            guarded.callback(connected.close)
            return run.go(live, afterwards, release=guarded.close)


def _settings_before(ready: ReadyScan) -> Iterator[str]:
    """What each device had been set to before it was opened, where that was not as it should be."""
    for device, description in ready.info.devices.items():
        if settings := description.get(FOUND):
            yield f"{device}: before it was opened: {settings}."


def _logs(config: Config, ready: ReadyScan, folder: Path, stack: ExitStack) -> tuple[Sink, Sink, Sink]:
    """The run's record, events.jsonl and user.log, open until the stack closes; the configuration is written beside
    them. The events come last: with them the folder is a run."""
    try:
        (folder / CONFIG).write_text(resolved_yaml(config), encoding="utf-8")
        first = RunRecord(State.PREPARING, sample=config.sample.name, planned=ready.timeline.n_frames)
        stack.callback((record := RecordFile(folder, first)).close)
        log = stack.enter_context(new_log(folder / USER_LOG))
        events = stack.enter_context(new_log(folder / EVENTS))
    except OSError as error:
        raise DataError(
            f"{folder} cannot be written to ({error.strerror}). Nothing has moved or was acquired."
        ) from error
    return record_sink(record), JsonLines(events), UserLog(log)


def _named(config: Config) -> str:
    """The end of a run folder's name."""
    energy = config.scan.energy
    return config.sample.name if energy is None else f"{config.sample.name}_{energy:.7g}keV"


def _clock(config: Config, series: ResumableRun | None) -> Clock | None:
    """A clock that goes on where the simulated one of the run stopped, as it starts anew in each process; else None."""
    if series is None or config.simulation is None:
        return None
    from beamline.instrument.simulated import clock_of

    return clock_of(config.simulation.clock, not_before=series.last_frame_time)


def _refuse_stop(stop: StopRequest) -> None:
    """Raise ScanAborted if a stop was requested: before anything moves, a stop is an abort."""
    if stop.stopping:
        raise ScanAborted(f"Interrupted before the first frame: {stop.reason}. Nothing has moved.")


@dataclass(frozen=True, eq=False)
class _Run:
    config: Config
    instrument: ConnectedDevices
    ready: ReadyScan
    folder: Path
    stop: StopRequest
    sink: Sink
    began: float
    series: ResumableRun | None
    pause: PauseRequest = field(default_factory=PauseRequest)

    @property
    def volume(self) -> Path:
        """File of the volume; a resumed run has one, too."""
        return (self.series.run if self.series else self.folder) / RECON

    @cached_property
    def states(self) -> StateMachine:
        return StateMachine(self.sink)

    @cached_property
    def references(self) -> ReferenceReport:
        return ReferenceReport(self.config.references, self.ready.plan.exposure, self.sink)

    @cached_property
    def decider(self) -> Decider:
        scan, timeline, devices = self.config.scan, self.ready.timeline, self.instrument.devices

        def seconds_of(block: Block) -> float:
            return block_seconds(
                block, devices.stage.limits, self.ready.timing, self.ready.plan.settle, devices.stage.position()
            )

        after = timeline.blocks[timeline.blocks.index(timeline.views) :]
        return Decider(
            asks=scan.decide == "ask",
            wish=Wish(**dict(scan.wish)),
            wait=scan.wait_s,
            timeline=timeline,
            seconds_of=seconds_of,
            now=self.instrument.clock.now,
            states=self.states,
            stop=self.stop,
            sink=self.sink,
            seconds=sum(seconds_of(block) for block in after if block.kind in REFERENCES)
            + (self.series.seconds if self.series else 0.0),
            number=len(timeline.plan.choices),
            close_shutter=lambda: None if devices.shutter.by_hand else devices.shutter.close(),
        )

    def go(self, live: LiveCommand | None, afterwards: LiveCommand | None, release: Callable[[], None]) -> RunResult:
        """Run the whole scan, and end it by the event `done` or `failed`."""
        try:
            self.states.enter(State.PREPARING, "Preparing" if self.series is None else self.series.in_words)
            result = self._scan(live, release)
            if afterwards is not None:
                result = self._reconstructed(afterwards, result)
        except BaseException as error:
            if is_defect(error):
                leave_traceback(error, self.folder)
            self.states.enter(self._end_by(error), "Ended early")
            self.sink(Failed(user_message(error), exit_code(error), self.folder))
            if isinstance(error, Exception | KeyboardInterrupt):
                raise
            raise RuntimeError(f"{type(error).__name__}: {error}") from error  # SystemExit(0) would be success
        self.states.enter(State.DONE, "Finished")
        self.sink(RunDone(self.folder, result))
        return result

    def _scan(self, live: LiveCommand | None, release: Callable[[], None]) -> RunResult:
        path = self.folder / SCAN
        command = None if live is None else live(path, self.volume)
        timeline = self.ready.timeline
        planned = timeline.n_frames, timeline.duration, timeline.total_bytes, timeline.remarks
        self.sink(RunStarted(self.folder, path, self.config.sample.name, *planned))
        self._set_volume_aside()
        if sentence := prepare_memory(self.instrument.frame_memory, timeline, self.ready.timing.shape):
            self.sink(StateEntered(self.states.state, sentence))
        writer = self._writer(path)
        with ExitStack() as ending:
            follower = None
            if command is not None:
                log, on_law = self.folder / RECON_LOG, self.decider.add_law
                follower = LiveReconstruction(command, log, self.sink, on_law)
                ending.callback(follower.close)
            return self._acquire_and_follow(writer, follower, release)

    def _wait_for(self, follower: LiveReconstruction | None) -> None:
        """Wait until the live reconstruction has compiled: once on a machine.

        A real scan waits before its first frame, a simulated one, whose references do not age, before its first view.
        """
        if follower is not None:
            follower.wait_ready(READY_WITHIN, lambda: self.stop.stopping)

    def _set_volume_aside(self) -> None:
        """Rename volume and report of the views before, in a run that goes on: that of all parts gets their names."""
        for path in (self.volume, self.volume.with_name(REPORT)):
            if self.series is None or not os.path.lexists(path):
                continue
            aside = path.with_stem(f"{path.stem}.before-{self.folder.name}")
            try:
                path.rename(aside)
                message = f"{path.name}, of the views before, is {aside.name} now"
                self.sink(StateEntered(self.states.state, message))
            except OSError as error:  # Windows, where a viewer holds it open
                self.sink(
                    Warned(
                        f"{path} could not be renamed ({error.strerror}): there is no volume of all parts of the run."
                    )
                )

    def _reconstructed(self, command: LiveCommand, result: RunResult) -> RunResult:
        """The complete scan's result with its volume; Ctrl-C ends the reconstruction alone."""
        began = time.monotonic()
        words = command(result.path, self.volume)
        recon = reconstruct(words, self.folder / RECON_LOG, self.sink, self.stop)
        return replace(result, recon=recon, seconds=result.seconds + time.monotonic() - began)

    def _acquire_and_follow(
        self, writer: NXtomoWriter, follower: LiveReconstruction | None, release: Callable[[], None]
    ) -> RunResult:
        recorder = self._recorder(writer)
        beam = beam_log(self.config.devices.beam_monitor, self.instrument.beam_monitor, self.sink, self.pause)
        acquisition = self._acquisition(recorder, beam, follower)
        labels = LabelLog()
        ended = _Ending(self.sink)
        with ended.kept(), beam:
            self._acquire(acquisition, recorder, labels, follower)
        self.states.enter(State.FINISHING, UNSAFE if acquisition.unsafe else SAFE)
        with ended.kept():
            recorder.finish()
        faults = self.references.faults(recorder.references)
        missing, status, closed = acquisition.missing, ended.status, False
        with ended.kept():
            if not recorder.hangs:  # a write that does not return holds HDF5's lock: closing would wait for it
                writer.close(status, missing, beam.readings, ended.reason)
                closed = True
        with ended.kept():
            if self.instrument.simulated is not None and not recorder.hangs:
                write_labels(labels_path(writer.path), labels.runs(writer.committed), writer.committed)
        for remark in filter(None, (*writer.remarks, recorder.unjudged)):
            self.sink(Warned(remark))
        with ended.kept():
            release()
        path, n_frames = writer.path, writer.committed
        with ended.kept():
            if self.series is not None and n_frames and closed:
                path, n_frames = self.series.join(path)
        result = RunResult(
            path=path,
            n_frames=n_frames,
            missing=tuple(missing),
            flags=recorder.flagged.counts,
            alarmed_frames=len(recorder.flagged.alarmed),
            alarmed_views=len(recorder.flagged.alarmed_views),
            retaken=recorder.flagged.retaken + acquisition.recovered,
            reference_faults=tuple(faults.values()),
            seconds=time.monotonic() - self.began,
            bytes=writer.path.stat().st_size,
            recon=None,
            status=status,
            sample=self.config.sample.name,
        )
        self.sink(ScanDone(result))
        if follower is not None:
            useless = not closed or isinstance(ended.error, ReferencesError)
            recon = follower.finish(live_should_end(self.stop, useless), lambda: self.stop.aborting)
            result = replace(result, recon=recon)
        if ended.error is not None:
            raise ended.error
        return replace(result, seconds=time.monotonic() - self.began)

    def _acquire(
        self, acquisition: Acquisition, recorder: Recorder, labels: LabelLog, follower: LiveReconstruction | None
    ) -> None:
        if self.config.simulation is None:
            self._wait_for(follower)
        # Closing the iterator is what makes the instrument safe when the recorder fails.
        with closing(acquisition.frames()) as frames:
            for frame in frames:
                self.decider.began = min(self.decider.began, frame.time)
                if self.instrument.simulated is not None:
                    labels.add(frame.index, self.instrument.simulated.labels(frame.time))
                recorder.put(frame)

    def _end_by(self, error: BaseException) -> State:
        """The state in which an error ends the run."""
        stopped = State.ABORTED if isinstance(error, ScanAborted) else State.STOPPED
        return stopped if isinstance(error, ScanStopped) and stopped in NEXT[self.states.state] else State.FAILED

    def _writer(self, path: Path) -> NXtomoWriter:
        storage = self.config.storage
        return NXtomoWriter(
            path,
            self.ready.info,
            self.ready.timing.shape,
            clock=self.instrument.clock,
            preview_bin=storage.preview_bin,
            flush_every=storage.flush_every,
        )

    def _recorder(self, writer: NXtomoWriter) -> Recorder:
        monitor = self.config.monitor
        return Recorder(
            writer,
            self.ready.monitor,
            self.ready.timeline,
            preview_bin=self.config.storage.preview_bin,
            sink=self.sink,
            flagged=FlaggedFrames(
                self.sink,
                AlarmReaction(monitor.act_after, policies(monitor), self.stop, self.pause, self.sink),
                monitor.retaken_warnings,
            ),
            pause=self.pause,
            stop=self.stop,
        )

    def _acquisition(self, recorder: Recorder, beam: BeamLog, follower: LiveReconstruction | None) -> Acquisition:
        ready, instrument, decider = self.ready, self.instrument, self.decider
        acquisition = Acquisition(
            instrument.devices, ready.timeline, ready.settings, ready.plan.settle, instrument.clock, self.stop,
            self.sink,
            Supervision(
                lambda: self._refusal(recorder, follower), self.pause, lambda: wait_in_pause(recorder), self.states,
                lambda missing: self._retakes(recorder, missing),
                lambda: beam.wait_for_reading(lambda: self.stop.stopping),
                next_pass=None if self.config.scan.decide == "off" else decider,
                pass_ended=recorder.end_pass,
                n_retakable=lambda missing: len(self._to_retake(recorder, missing)[0]),
            ),
        )  # fmt: skip

        def wait_a_moment() -> bool:
            acquisition.wait_while_paused(reopen=False)
            return wait_in_pause(recorder)

        cone = "" if ready.info.source_distance_mm is None else "the beam is a cone, in which no gain is predicted"
        ended = "no live reconstruction is running"
        decider.unable = lambda: cone or (ended if follower is None or follower.ended else "")
        decider.record, decider.wait_a_moment = recorder.add_decision, wait_a_moment
        return acquisition

    def _refusal(self, recorder: Recorder, follower: LiveReconstruction | None) -> str | None:
        """Why no projection should be taken after these darks and flats; None: no fault, or faults are only logged."""
        recorder.wait()
        if self.config.simulation is not None:
            self._wait_for(follower)
        if self.stop.stopping:
            return None
        blocks = self.ready.timeline.blocks
        faults = self.references.faults(recorder.references, blocks[: blocks.index(self.ready.timeline.views)])
        if not faults or self.config.references.on_fault == "log":
            return None
        return (
            f"Stopped before the first projection, because the references cannot be used. {' '.join(faults.values())} "
            f"The shutter was asked to close; the {recorder.n_frames} darks and flats are in the file. Mend this, look "
            "at a few frames and the exposure with `beamline tune`, and scan again; references.on_fault: log takes the "
            "scan as it is."
        )

    def _retakes(self, recorder: Recorder, missing: Sequence[int]) -> Sequence[Retake]:
        """Views that were flagged for it or gave no frame, which are announced."""
        chosen, n = self._to_retake(recorder, missing)
        if not chosen:
            return ()
        if len(chosen) < n:
            message = (
                f"{n} views were flagged or gave no frame, and {len(chosen)} may be taken again "
                f"(monitor.retake_share): {n - len(chosen)} between them stay as they are."
            )
            self.sink(Warned(message))
        recorder.expect_more(len(chosen), self.ready.timeline.retake_seconds * len(chosen) / self.ready.plan.retakes)
        self.states.enter(State.ACQUIRING, f"Taking {count(len(chosen), 'view')} again")
        return chosen

    def _to_retake(self, recorder: Recorder, missing: Sequence[int]) -> tuple[Sequence[Retake], int]:
        """Views that were flagged or gave no frame, and their number; of more than the plan allows, an even spread."""
        most = self.ready.plan.retakes - recorder.announced
        if not most:
            return (), 0
        recorder.wait()
        lost, n = [Retake(-1, trigger) for trigger in missing], self.ready.plan.angles.size
        once = [
            view for view in recorder.flagged.views_to_retake if view.trigger < n
        ]  # others were taken again already
        bad = sorted([*once, *lost], key=lambda view: view.trigger)
        return ((), 0) if self.stop.stopping else (spread_retakes(bad, most), len(bad))


def wait_in_pause(recorder: Recorder) -> bool:
    """Wait a moment during a pause, and check the disk; returns whether Enter was pressed at the terminal."""
    time.sleep(PAUSE_POLL)
    recorder.check()
    return enter_pressed()


class _Ending:
    """The error that ends a run, raised after everything is closed: any other one before a stop or lost frames, which
    become a warning."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.error: BaseException | None = None

    @contextmanager
    def kept(self) -> Iterator[None]:
        """A step whose failure does not keep the next ones from being taken."""
        try:
            yield
        except BaseException as after:
            if self.error is None or after is self.error:
                self.error = after
                return
            if isinstance(self.error, ScanStopped | LedgerError):
                self.error, after = after, self.error
            self._sink(Warned(str(after)))

    @property
    def status(self) -> str:
        """Status of the scan so far: complete, stopped or failed."""
        if self.error is None:
            return "complete"
        return "stopped" if isinstance(self.error, ScanStopped) else "failed"

    @property
    def reason(self) -> str:
        return "" if self.error is None else user_message(self.error)
