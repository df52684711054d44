"""Run: one scan, from the configuration to the file, in a separate folder. Events report its progress, and the file is
closed in every case."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import cast

from beamline.config.load import Config, resolved_yaml
from beamline.core.errors import (
    ConfigError,
    DataError,
    ScanStopped,
    exit_code,
    is_defect,
    leave_traceback,
    user_message,
)
from beamline.core.events import Failed, RunDone, RunStarted, Sink, StateEntered, Warned
from beamline.core.files import CONFIG, EVENTS, RECON, RECON_LOG, REPORT, SCAN, USER_LOG, create_run_folder, new_log
from beamline.core.machine import free_memory
from beamline.core.process import ChildProcess
from beamline.core.run_result import RunResult
from beamline.core.sinks import Announcer, JsonLines, UserLog, fan_out
from beamline.core.stop import ScanAborted, StopRequest
from beamline.instrument.connect import ConnectedDevices, clock_after, connect
from beamline.scan.control import NEXT, State, StateMachine, commands_taken
from beamline.scan.dry_run import all_of
from beamline.scan.live_plan import live_plan
from beamline.scan.live_process import Commands, LiveCommand, Standby, follow_command, reconstruct
from beamline.scan.measurement import FrameSource, Measurement, Turn
from beamline.scan.preflight import ReadyScan, preflight
from beamline.scan.references import first_state
from beamline.scan.resume import ResumableRun
from beamline.scan.runs import record_sink
from beamline.scan.watchdog import watched
from beamline.storage.run_record import RecordFile, RunRecord
from drivers.base.clock import Clock, SystemClock
from drivers.base.protocols import Devices
from drivers.in_beam import Ask
from drivers.stages.shared import FOUND


def run_scan(
    config: Config,
    runs: Path | ResumableRun | None = None,
    sinks: Sequence[Sink] = (),
    stop: StopRequest | None = None,
    *,
    live: LiveCommand | Commands | None = None,
    instrument: ConnectedDevices | None = None,
    ask: Ask | None = None,
    turn: Turn | None = None,
) -> RunResult:
    """Run the scan that `config` describes.

    Args:
        runs: folder in which the folder of the run is created; default: the configured folder. Or the run that is
            continued, with its own configuration.
        sinks: receive the events, in addition to events.jsonl and user.log in the folder of the run.
        stop: request with which another thread or a signal handler ends the scan.
        live: function that returns the command line of a live reconstruction, or the commands for the scan; None: no
            live reconstruction.
        turn: see `Measurement`; None: the scan begins at once.
        instrument: connected devices, which stay open; None: the devices in `config` are opened, and closed at the end.
        ask: function that asks the operator to move the shutter or the sample by hand.

    Raises:
        ConfigError: the plan exceeds a limit, or the instrument is not the one with which the run began. Nothing has
            moved.
        DeviceError, InstrumentError: a device failed. ScanStopped, ScanAborted: a stop or an abort was requested.
        ReferencesError: darks or flats cannot be used; no projection was taken.
        DataError: frames are missing (LedgerError), or the disk failed. In all of these cases the frames taken so far
            are in the file. The event `scan_done` gives their number, and `failed` gives the reason.
    """
    if config.series:
        one, several = ("energy", "energies") if config.scan.states is None else ("state", "states")
        raise ConfigError(
            f"set scan.{one} instead of scan.{several}, which lists several scans: this call runs one "
            "scan. Nothing was started."
        )
    began = time.monotonic()
    stop = stop or StopRequest()
    series = runs if isinstance(runs, ResumableRun) else None
    runs_folder = runs.run if isinstance(runs, ResumableRun) else runs or Path(config.storage.folder)
    with ExitStack() as connected:
        if instrument is None:
            clock = clock_after(config, series.last_frame_time if series else 0.0)
            devices = connect(config, clock=clock, ask=ask, check_stop=lambda: _refuse_stop(stop))
            instrument = connected.enter_context(devices)
        instrument.watch_moves(stop.refuse_abort)
        remaining = series.remaining if series else all_of
        ready = preflight(config, instrument, runs_folder, remaining, check_stop=lambda: _refuse_stop(stop))
        _refuse_stop(stop)
        folder = (
            series.begin(ready) if series else create_run_folder(runs_folder, _run_name(config), SystemClock().now())
        )
        with ExitStack() as stack:
            sink = _announced_sink(config, ready, folder, instrument.clock, sinks, stack)
            if series is not None:
                series.lock.release()  # from here on the lock of the part keeps other processes away
            first = first_state(config, series.run.parent if series else runs_folder)
            measurement = Measurement(config, instrument, ready, folder, stop, sink, began, series, first_state=first)
            measurement = measurement if turn is None else replace(measurement, turn=turn)
            stack.enter_context(commands_taken(folder, stop, measurement.pause, measurement.decider.answer))
            # held until the instrument is free for another scan
            watchdog_stack = stack.enter_context(_watched(measurement))
            watchdog_stack.callback(connected.close)
            commands = live if isinstance(live, Commands) else Commands(live=live)
            return _run_to_end(measurement, commands, watchdog_stack.close)


def _watched(measurement: Measurement) -> ExitStack:
    """Start a watchdog for the scan of a real instrument. The watchdog ends when the stack is closed."""
    config, watchdog_stack = measurement.config, ExitStack()
    if config.simulation is None:
        pause = measurement.pause if config.scan.on_watchdog_loss == "pause" else None
        watchdog_stack.enter_context(watched(measurement.folder, measurement.sink, measurement.stop, pause))
    return watchdog_stack


def record_scan(
    config: Config,
    ready: ReadyScan,
    source_of: Callable[[Measurement], FrameSource],
    runs: Path,
    sinks: Sequence[Sink],
    stop: StopRequest,
    *,
    live: Standby | None,
) -> RunResult:
    """Record a scan that another program controls, in the folder of a new run, as `run_scan` records a scan of this
    program.

    The scan does not wait for the live reconstruction, no watchdog runs, and no device is operated.

    Args:
        config: configuration, of which the sections sample, storage, monitor, references, recon, scan and
            devices.beam_monitor are used. source_of: function that makes the object that delivers the frames, given the
            measurement that receives them. runs: folder in which the folder of the run is created. live: function that
            returns the command line of a live reconstruction; None: no live reconstruction.

    Raises:
        LedgerError: frames are missing. ScanStopped, ScanAborted: a stop or an abort was requested. DataError: the disk
            failed.
    """
    began = time.monotonic()
    no_devices = ConnectedDevices(cast(Devices, None), SystemClock(), None, lambda: None)  # its devices are never used
    with ExitStack() as stack:
        folder = create_run_folder(runs, config.sample.name, no_devices.clock.now())
        sink = _announced_sink(config, ready, folder, no_devices.clock, sinks, stack)
        child = ChildProcess if live is None else live.start
        measurement = Measurement(config, no_devices, ready, folder, stop, sink, began, None, source_of, child=child)
        stack.enter_context(commands_taken(folder, stop, measurement.pause))
        views = live_plan(ready.timing.shape, ready.plan.angles.size, free_memory())
        commands = Commands(live=follow_command(config, views) if live else None)
        return _run_to_end(measurement, commands, lambda: None)


def _announced_sink(
    config: Config, ready: ReadyScan, folder: Path, clock: Clock, sinks: Sequence[Sink], stack: ExitStack
) -> Sink:
    """One sink for the record of the run, its logs and `sinks`. A thread passes events on to each, until the stack
    closes. The first events state the settings that the devices had before they were opened."""
    record, *logs = _logs(config, ready, folder, stack)
    # The record has a separate thread, so that a blocked terminal does not delay it.
    announcers = [Announcer(each, clock) for each in ([record], [*logs, *sinks])]
    sink = fan_out(*map(stack.enter_context, announcers))
    for device, description in ready.info.devices.items():
        if found_state := description.get(FOUND):
            sink(Warned(f"{device}: this program found the device in this state: {found_state}."))
    return sink


def _logs(config: Config, ready: ReadyScan, folder: Path, stack: ExitStack) -> tuple[Sink, Sink, Sink]:
    """The record of the run, events.jsonl and user.log. They are open until the stack closes. The configuration is
    written next to them.

    events.jsonl is created last, because a folder with this file counts as a run.
    """
    try:
        (folder / CONFIG).write_text(resolved_yaml(config), encoding="utf-8")
        first = RunRecord(State.PREPARING, sample=config.sample.name, planned=ready.timeline.n_frames)
        stack.callback((record := RecordFile(folder, first)).close)
        log = stack.enter_context(new_log(folder / USER_LOG))
        events = stack.enter_context(new_log(folder / EVENTS))
    except OSError as error:
        raise DataError(f"{folder} cannot be written to ({error.strerror}). Nothing was moved or taken.") from error
    return record_sink(record), JsonLines(events), UserLog(log)


def _run_name(config: Config) -> str:
    """The end of a run folder's name."""
    number = "" if config.scan.state is None else f"_state{config.scan.state}"
    return config.sample.name + number + ("" if config.scan.energy is None else f"_{config.scan.energy:.7g}keV")


def _refuse_stop(stop: StopRequest) -> None:
    """Raise ScanAborted if a stop was requested. (Before anything moves, a stop counts as an abort.)"""
    if stop.stopping:
        raise ScanAborted(f"Interrupted before the first frame: {stop.reason}. Nothing was moved.")


def _run_to_end(measurement: Measurement, commands: Commands, release: Callable[[], None]) -> RunResult:
    """Run the whole scan, and end it by the event `done` or `failed`."""
    states, series, folder, sink = measurement.states, measurement.series, measurement.folder, measurement.sink
    volume, timeline = (series.run if series else folder) / RECON, measurement.ready.timeline  # of all parts
    try:
        states.enter(State.PREPARING, "Preparing" if series is None else series.in_words)
        command = None if commands.live is None else commands.live(folder / SCAN, volume)
        planned = timeline.n_frames, timeline.duration, timeline.total_bytes, timeline.remarks
        sink(RunStarted(folder, folder / SCAN, measurement.config.sample.name, *planned))
        if series is not None:
            _set_aside([volume, volume.with_name(REPORT)], folder.name, states, sink)
        result = measurement.take(command, release, draws=commands.draws)
        if commands.afterwards is not None:  # Ctrl-C ends only the reconstruction
            began = time.monotonic()
            recon_command = commands.afterwards(result.path, volume)
            recon = reconstruct(recon_command, folder / RECON_LOG, sink, measurement.stop)
            result = replace(result, recon=recon, seconds=result.seconds + time.monotonic() - began)
    except BaseException as error:
        if is_defect(error):
            leave_traceback(error, folder)
        stopped = State.ABORTED if isinstance(error, ScanAborted) else State.STOPPED
        allowed = isinstance(error, ScanStopped) and stopped in NEXT[states.state]
        states.enter(stopped if allowed else State.FAILED, "Ended early")
        sink(Failed(user_message(error), exit_code(error), folder))
        if isinstance(error, Exception | KeyboardInterrupt):
            raise
        raise RuntimeError(f"{type(error).__name__}: {error}") from error  # SystemExit(0) would be success
    states.enter(State.DONE, "Finished")
    sink(RunDone(folder, result))
    return result


def _set_aside(files: Sequence[Path], part: str, states: StateMachine, sink: Sink) -> None:
    """Rename the volume and the report that were made from earlier parts of a run, because the volume of all parts gets
    their names.
    """
    for path in filter(os.path.lexists, files):
        renamed = path.with_stem(f"{path.stem}.before-{part}")
        try:
            path.rename(renamed)
            sink(
                StateEntered(
                    states.state, f"{path.name}, the volume of the earlier projections, was renamed to {renamed.name}"
                )
            )
        except OSError as error:  # happens on Windows if a viewer has the file open
            sink(
                Warned(
                    f"There is no volume of all parts of the run, because {path} could not be renamed "
                    f"({error.strerror})."
                )
            )
