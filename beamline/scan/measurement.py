"""Measurement: runs acquisition, decider, recorder and live reconstruction of one scan until its file is closed."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

from beamline.config.load import Config
from beamline.config.monitor import policies
from beamline.core.errors import ReferencesError, ScanStopped, user_message
from beamline.core.events import ScanDone, Sink, StateEntered, Warned
from beamline.core.files import RECON_LOG, SCAN
from beamline.core.process import ChildProcess
from beamline.core.run_result import RunResult
from beamline.core.stop import PauseRequest, StopRequest
from beamline.instrument.connect import ConnectedDevices, enter_pressed
from beamline.plan.choose import ScanTarget
from beamline.plan.plan import Block
from beamline.plan.timeline import block_seconds
from beamline.scan.acquisition import Acquisition
from beamline.scan.backlog import prepare_memory
from beamline.scan.control import State, StateMachine
from beamline.scan.decider import Decider
from beamline.scan.flagged import AlarmReaction, FlaggedFrames
from beamline.scan.ledger import LedgerError
from beamline.scan.live_process import LiveReconstruction, abort_watch, live_should_end
from beamline.scan.moves import SAFE, UNSAFE, WRITTEN
from beamline.scan.preflight import ReadyScan
from beamline.scan.recorder import Recorder
from beamline.scan.references import REFERENCES, ReferenceReport, recorded_in
from beamline.scan.resume import ResumableRun
from beamline.scan.retakes import Retakes
from beamline.scan.supervision import PAUSE_POLL, BeamLog, Supervision, beam_log
from beamline.simulate import LabelLog, labels_path, write_labels
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame

READY_WITHIN = 300.0
"""Longest real time in s for which a scan waits for its live reconstruction, which compiles its kernels once on a
machine. A scan waits before its first frame. A simulated scan waits before its first projection, because its darks and
flats do not age."""


class FrameSource(Protocol):
    """An object that delivers the frames of a scan, as `Acquisition` does with the devices of this program.

    Attributes, to be read after the last frame: missing: triggers (counted over the whole plan) that gave no frame.
        recovered: number of projections that gave no frame at first, but gave one when they were taken again. unsafe:
        True if a device failed while the instrument was made safe.
    """

    recovered: int
    unsafe: bool

    @property
    def missing(self) -> list[int]: ...

    def frames(self) -> Generator[Frame, None, None]:
        """Yields the frames in the order of the file. Raises LedgerError after the last frame if frames are missing."""


Turn = Callable[["Measurement", Callable[[], bool]], None]


@dataclass(frozen=True, eq=False)
class Measurement:
    """One scan on connected devices, from the first frame to the closed file.

    Attributes:
        began: time at which the run began, on the monotonic clock.
        series: the run that is continued; None: a new run.
        source_of: function that makes the object that delivers the frames, if another program controls the scan. None:
            this program controls the scan with its devices.
        child: function that starts the live reconstruction.
        turn: function that returns when the scan may begin. Its argument `poll` is a function that waits a moment and
            returns whether Enter was pressed.
        first_state: the scan whose darks and flats are copied; None: this scan takes its own.
    """

    config: Config
    instrument: ConnectedDevices
    ready: ReadyScan
    folder: Path
    stop: StopRequest
    sink: Sink
    began: float
    series: ResumableRun | None
    source_of: Callable[[Measurement], FrameSource] | None = None
    child: Callable[..., ChildProcess] = ChildProcess
    pause: PauseRequest = field(default_factory=PauseRequest)
    turn: Turn = lambda measurement, poll: None
    first_state: Path | None = None

    @cached_property
    def states(self) -> StateMachine:
        return StateMachine(self.sink)

    @cached_property
    def references(self) -> ReferenceReport:
        return ReferenceReport(self.config.references, self.ready.plan.exposure, self.sink)

    @cached_property
    def decider(self) -> Decider:
        return _decider_of(self)

    def take(self, command: Sequence[str] | None, release: Callable[[], None], *, draws: bool = False) -> RunResult:
        """Take the scan, and close its file.

        Args:
            command: the command of the live reconstruction.
            release: function that is called when the instrument is free for another scan.
            draws: True if the live reconstruction only draws pictures and ends with the scan.
        """
        storage, shape = self.config.storage, self.ready.timing.shape
        if sentence := prepare_memory(self.instrument.frame_memory, self.ready.timeline, shape):
            self.sink(StateEntered(self.states.state, sentence))
        writer = NXtomoWriter(
            self.folder / SCAN,
            self.ready.info,
            shape,
            clock=self.instrument.clock,
            preview_bin=storage.preview_bin,
            flush_every=storage.flush_every,
        )
        with ExitStack() as ending:
            follower = None
            if command is not None:
                log, on_law = self.folder / RECON_LOG, self.decider.add_law
                follower = LiveReconstruction(command, log, self.sink, on_law, child=self.child)
                ending.callback(follower.close)
            return self._acquire_and_follow(writer, follower, release, draws)

    def _acquire_and_follow(
        self, writer: NXtomoWriter, follower: LiveReconstruction | None, release: Callable[[], None], draws: bool
    ) -> RunResult:
        recorder = self._recorder(writer)
        beam = beam_log(self.config.devices.beam_monitor, self.instrument.beam_monitor, self.sink, self.pause)
        acquisition: FrameSource = (
            self._acquisition(recorder, beam, follower) if self.source_of is None else self.source_of(self)
        )
        labels = LabelLog()
        ending = _Ending(self.sink)
        with ending.kept(), beam:
            self._acquire(acquisition, recorder, labels, follower)
        self.states.enter(
            State.FINISHING, UNSAFE if acquisition.unsafe else SAFE if self.source_of is None else WRITTEN
        )
        with ending.kept():
            recorder.finish()
        faults = self.references.faults(recorder.references)
        missing, closed = acquisition.missing, False
        status, reason = ending.how
        with ending.kept():
            if not recorder.hangs:  # a write that does not return holds the lock of HDF5, and closing would wait for it
                writer.close(status, missing, beam.readings, reason)
                closed = True
        with ending.kept():
            if self.instrument.simulated is not None and not recorder.hangs:
                write_labels(labels_path(writer.path), labels.runs(writer.committed), writer.committed)
        for remark in filter(None, (*writer.remarks, recorder.flagged.unchecked(writer.path))):
            self.sink(Warned(remark))
        with ending.kept():
            release()
        path, n_frames = writer.path, writer.committed
        with ending.kept():
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
        if follower is not None and draws:
            follower.end_shown(lambda: self.stop.aborting or not closed)
        elif follower is not None:
            useless = not closed or isinstance(ending.error, ReferencesError)
            aborting = abort_watch(self.stop, lambda text: self.sink(StateEntered(self.states.state, text)))
            recon = follower.finish(live_should_end(self.stop, useless), aborting)
            result = replace(result, recon=recon)
        if ending.error is not None:
            raise ending.error
        return replace(result, seconds=time.monotonic() - self.began)

    def _acquire(
        self, acquisition: FrameSource, recorder: Recorder, labels: LabelLog, follower: LiveReconstruction | None
    ) -> None:
        if self.config.simulation is None and self.source_of is None:
            _wait_for(follower, self.stop, self.states)
        # If the recorder fails, closing the iterator makes the instrument safe.
        with closing(acquisition.frames()) as frames:
            for frame in frames:
                self.decider.began = min(self.decider.began, frame.time)
                if self.instrument.simulated is not None:
                    labels.add(frame.index, self.instrument.simulated.labels(frame.time))
                recorder.put(frame)

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
        retakes = Retakes(ready.timeline, recorder, decider, self.states, self.stop, self.sink)
        acquisition = Acquisition(
            instrument.devices, ready.timeline, ready.settings, ready.plan.settle, instrument.clock, self.stop,
            self.sink,
            Supervision(
                lambda: self._refusal(recorder, follower), self.pause, lambda: wait_in_pause(recorder), self.states,
                retakes.begin,
                lambda: beam.wait_for_reading(lambda: self.stop.stopping),
                next_pass=None if self.config.scan.decide == "off" else decider,
                pass_ended=recorder.end_pass,
                n_retakable=retakes.n_possible,
                turn=lambda: self.turn(self, lambda: wait_in_pause(recorder)),
                recorded=lambda block: () if self.first_state is None else recorded_in(self.first_state, block),
            ),
        )  # fmt: skip

        def wait_a_moment() -> bool:
            acquisition.wait_while_paused(reopen=False)
            return wait_in_pause(recorder)

        cone = "" if ready.info.source_distance_mm is None else "improvements are not predicted for a cone beam"
        ended = "no live reconstruction is running"
        decider.why_no_law = lambda: cone or (ended if follower is None or follower.ended else "")
        decider.record, decider.wait_a_moment = recorder.add_decision, wait_a_moment
        return acquisition

    def _refusal(self, recorder: Recorder, follower: LiveReconstruction | None) -> str | None:
        """The reason why no projection should be taken after these darks and flats. None: they have no fault, or faults
        are only logged."""
        recorder.wait()
        if self.config.simulation is not None:
            _wait_for(follower, self.stop, self.states)
        if self.stop.stopping:
            return None
        blocks = self.ready.timeline.blocks
        faults = self.references.faults(recorder.references, blocks[: blocks.index(self.ready.timeline.views)])
        if not faults or self.config.references.on_fault == "log":
            return None
        return _stopped_sentence(faults.values(), recorder.n_frames)


def _decider_of(measurement: Measurement) -> Decider:
    """The decider of a scan, before its first frame."""
    scan, timeline, devices = measurement.config.scan, measurement.ready.timeline, measurement.instrument.devices

    def seconds_of(block: Block) -> float:
        return block_seconds(
            block,
            devices.stage.limits,
            measurement.ready.timing,
            measurement.ready.plan.settle,
            devices.stage.position(),
        )

    remaining_blocks = timeline.blocks[timeline.blocks.index(timeline.views) :]
    return Decider(
        asks=scan.decide == "ask",
        target=ScanTarget(**dict(scan.target)),
        wait=scan.wait_s,
        timeline=timeline,
        seconds_of=seconds_of,
        now=measurement.instrument.clock.now,
        states=measurement.states,
        stop=measurement.stop,
        sink=measurement.sink,
        added_seconds=sum(
            seconds_of(block) for block in remaining_blocks if block.kind in REFERENCES and scan.decide != "off"
        )
        + (measurement.series.seconds if measurement.series else 0.0),
        retaken=measurement.series.retaken if measurement.series else 0,
        number=len(timeline.plan.choices),
        close_shutter=lambda: None if devices.shutter.by_hand else devices.shutter.close(),
    )


def _wait_for(follower: LiveReconstruction | None, stop: StopRequest, states: StateMachine) -> None:
    """Wait until the live reconstruction is ready for projections."""
    if follower is not None:
        follower.wait_ready(READY_WITHIN, lambda: stop.stopping, lambda text: states.enter(states.state, text))


def _stopped_sentence(faults: Iterable[str], n_frames: int) -> str:
    """Why no projection was taken, and what to do."""
    fault_text = " ".join(faults)
    return (
        f"Stopped before the first projection, because the darks or flats cannot be used. {fault_text} The shutter "
        f"was told to close; the {n_frames} darks and flats are in the file. Fix the fault, check a few frames and "
        "the exposure with `beamline tune`, and start the scan again. To scan anyway, set references.on_fault: log."
    )


def wait_in_pause(recorder: Recorder) -> bool:
    """Wait a moment during a pause, and check the disk. Returns True if Enter was pressed at the terminal."""
    time.sleep(PAUSE_POLL)
    recorder.check()
    return enter_pressed()


class _Ending:
    """Collects the error that ends a run, and raises it after everything is closed. If there are several errors, other
    errors take precedence over a stop or lost frames, which become a warning.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.error: BaseException | None = None

    @property
    def how(self) -> tuple[str, str]:
        """The status of the file, and the reason for it."""
        if self.error is None:
            return "complete", ""
        return "stopped" if isinstance(self.error, ScanStopped) else "failed", user_message(self.error)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """A step whose failure does not prevent the following steps."""
        try:
            yield
        except BaseException as after:
            if self.error is None or after is self.error:
                self.error = after
                return
            if isinstance(self.error, ScanStopped | LedgerError):
                self.error, after = after, self.error
            self._sink(Warned(str(after)))
