"""Series: takes scans of one sample, one scan at each energy or of each state, in one folder. A series can be continued
later.

Each scan has an ordinary run folder within the folder of the series, so that every program that reads runs can read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from beamline.config.load import Config, changed, each_scan, load, override_of, resolved_yaml
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, RunDone, Sink, StateEntered, Warned
from beamline.core.files import CONFIG, RECON, RECON_LOG, SCAN, create_run_folder, run_of, write_whole
from beamline.core.run_result import RunResult
from beamline.core.sinks import Warn, fan_out
from beamline.core.stop import StopRequest
from beamline.instrument.connect import clock_after, connect
from beamline.scan.control import State
from beamline.scan.dry_run import dry_run, refuse_violations
from beamline.scan.live_process import Commands, reconstruct
from beamline.scan.measurement import Measurement
from beamline.scan.resume import (
    NoFrame,
    NothingMissing,
    NotJoined,
    ResumableRun,
    open_for_resume,
    recover_run,
)
from beamline.scan.run import run_scan
from beamline.scan.runs import describe
from beamline.scan.waits import SLICE
from beamline.storage.interrupted import scan_file
from drivers.base.clock import SystemClock
from drivers.in_beam import Ask

CommandsOf = Callable[[Config, ResumableRun | None], Commands]


@dataclass(frozen=True)
class SeriesRun:
    """A finished series.

    Attributes:
        folder: folder of the series.
        scans: the scan file of each energy (keV), or of each state (number).
        results: results of the scans that were taken now, not earlier.
    """

    folder: Path
    scans: tuple[tuple[float, Path], ...]
    results: tuple[RunResult, ...]


def is_series(folder: Path) -> bool:
    """True if a folder contains a series of scans."""
    if not (folder / CONFIG).is_file() or (folder / SCAN).exists():
        return False
    return bool(load(folder / CONFIG, environment={}).series)


def scans_in(folder: Path, warn: Warn) -> list[Path]:
    """The scan files of a series, by energy or number of the state, in the order of the configuration.

    Args:
        warn: function that gets a sentence about scans that are incomplete or do not exist.

    Raises:
        DataError: the series contains no scan.
    """
    config = load(folder / CONFIG, environment={})
    runs = _runs(folder, config)
    files = [scan_file(run) for run in runs if run is not None]
    whole = [run for run in runs if run is not None and describe(run).state == State.DONE]
    if files and len(whole) < len(runs):
        warn(
            f"{folder}: only {len(whole)} of {len(runs)} {_kind(config)} have a complete scan. "
            f"Scans with frames that are used: {len(files)}. `beamline scan --resume {folder}` takes the missing scans."
        )
    if not files:
        raise DataError(
            f"{folder} has no scan yet: `beamline scan --resume {folder}` takes the scans. Nothing was written."
        )
    return files


def scans_of(paths: Iterable[Path], warn: Warn) -> tuple[Path, ...]:
    """The scans at these paths. The folder of a series is replaced by its scans, see `scans_in`."""
    return tuple(scan for path in paths for scan in (scans_in(path, warn) if is_series(path) else [scan_file(path)]))


def run_series(
    config: Config,
    place: Path | None,
    sinks: Sequence[Sink],
    stop: StopRequest,
    commands: CommandsOf,
    *,
    series: Path | None = None,
    ask: Ask | None = None,
) -> SeriesRun:
    """Run the scans of a series one after the other. Devices stay connected.

    Args:
        place: folder in which the folder of the series is created; None: the configured folder.
        stop: request that ends the current scan and with it the series. `sinks`, `ask`: as in `run_scan`, for all
            scans.
        commands: function that returns the commands for the reconstruction of a scan. If a volume needs the complete
            scan of a state, it is made after the last state, so that the next state need not wait for it.
        series: folder of a series that is continued. Complete scans are kept, and a scan that ended early is continued.

    Raises:
        ConfigError: a limit is exceeded at one of the scans; nothing has moved. Also raises the errors of `run_scan`:
            the scans before the error are complete, and a warning names the folder with which the series can be
            continued.
    """
    configs, send = each_scan(config), fan_out(*sinks)
    with ExitStack() as resources:
        jobs = [None] * len(configs) if series is None else [_job(run, resources) for run in _runs(series, config)]
        complete = [(_value(each), job) for each, job in zip(configs, jobs, strict=True) if isinstance(job, Path)]
        if series is not None and len(complete) == len(configs):
            if config.scan.states:
                paths = [path for _, path in complete]
                _volumes([(path, commands(each, None)) for each, path in zip(configs, paths, strict=True)], stop, sinks)
            return SeriesRun(series, tuple(complete), ())
        planned = dry_run(config, series or place, complete=[value for value, _ in complete])
        refuse_violations(planned.timeline)
        last_frame_time = max((job.last_frame_time for job in jobs if isinstance(job, ResumableRun)), default=0.0)
        clock = clock_after(config, last_frame_time)
        instrument = resources.enter_context(connect(config, clock=clock, ask=ask, check_stop=stop.refuse_abort))
        folder = series or _new_folder(config, place or Path(config.storage.folder))
        turns = _Turns(config.scan.states.every_s if config.scan.states else None)
        seconds = {needs.state: needs.duration for needs in planned.states}
        scans, results, without_volume = list[tuple[float, Path]](), list[RunResult](), list[tuple[Path, Commands]]()
        for n, (scan_config, job) in enumerate(zip(configs, jobs, strict=True), 1):
            if isinstance(job, Path):
                scans.append((_value(scan_config), job))
                without_volume.append((job, commands(scan_config, None) if config.scan.states else Commands()))
                continue
            number = f"{n} of {len(configs)}"
            which = f"State {number}" if config.scan.states else f"Energy {number}: {_value(scan_config):.7g} keV"
            _send(StateEntered(_kind(config), which), sinks)
            for warning in job.left_out if job else ():
                _send(Warned(warning), sinks)
            try:
                scan_commands = commands(_with_time_limit(scan_config, seconds.get(n)), job)
                if scan_commands.remark:
                    _send(StateEntered(_kind(config), scan_commands.remark), sinks)
                result = run_scan(
                    scan_config, job or folder,
                    [lambda event: None if isinstance(event, RunDone) else send(event)],  # more scans follow
                    stop, live=replace(scan_commands, afterwards=None) if config.scan.states else scan_commands,
                    instrument=instrument, turn=turns.wait if config.scan.states else None,
                )  # fmt: skip
            except BaseException:
                _after_failure(folder, _scan_name(scan_config), len(configs), sinks)
                raise
            results.append(result)
            scans.append((_value(scan_config), result.path))
            without_volume.append((result.path, scan_commands if config.scan.states else Commands()))
    _volumes(without_volume, stop, sinks)
    return SeriesRun(folder, tuple(scans), tuple(results))


@dataclass
class _Turns:
    """Decides when each state begins: `interval` s after the beginning of the state before, or (None) when `beamline
    resume` is sent. The first state begins at once.
    """

    interval: float | None
    last_begin: float | None = field(default=None, init=False)

    def wait(self, measurement: Measurement, poll: Callable[[], bool]) -> None:
        """Wait until the scan may begin. A stop ends the wait, and a pause makes it longer."""
        clock, stop, pause, states = (
            measurement.instrument.clock, measurement.stop, measurement.pause, measurement.states,
        )  # fmt: skip
        name, due = _scan_name(measurement.config), clock.now()
        if self.last_begin is not None and self.interval is not None:
            due, lateness = self.last_begin + self.interval, due - self.last_begin - self.interval
            if lateness > SLICE:
                measurement.sink(
                    Warned(f"{name} begins {lateness:.0f} s late, because the scan of the state before took longer.")
                )
                due = clock.now()
            else:
                states.enter(states.state, f"{name} begins in {-lateness:.0f} s")
            while (remaining := due - clock.now()) > 0 and not stop.stopping:
                clock.sleep(min(SLICE, remaining))
        elif self.last_begin is not None:
            pause.pause(f"{name} waits for its trigger")
        if self.last_begin is not None and pause.reason and not stop.stopping:
            poll()  # ignore earlier input
            states.enter(State.PAUSED, f"Paused before the first frame: {pause.reason}")
            while pause.reason and not stop.stopping:
                if poll():
                    pause.resume()
            due = clock.now()
        self.last_begin = due


def _with_time_limit(config: Config, seconds: float | None) -> Config:
    """The configuration of a state, changed so that its live volume is finished before the next state begins."""
    interval_s = config.scan.states.every_s if config.scan.states else None
    if interval_s is None or seconds is None:
        return config
    spare = max(interval_s - seconds, _LEAST_SECONDS)
    return changed(config, [override_of("recon.seconds", min(config.recon.seconds, spare))])


_LEAST_SECONDS = 1.0  # s for the last fit of a live volume


def _volumes(scans: Sequence[tuple[Path, Commands]], stop: StopRequest, sinks: Sequence[Sink]) -> None:
    """Make the volumes that need complete scans, unless they exist already."""
    for path, commands in scans:
        run = run_of(path.parent)
        if commands.afterwards is not None and not (run / RECON).exists() and not stop.stopping:
            _send(StateEntered("states", f"Reconstructing {run.name}"), sinks)
            reconstruct(commands.afterwards(path, run / RECON), run / RECON_LOG, fan_out(*sinks), stop)


def _kind(config: Config) -> str:
    return "states" if config.scan.states else "energies"


def _value(config: Config) -> float:
    """The energy in keV, or the number of the state."""
    return config.scan.state or config.scan.energy or 0.0


def _scan_name(config: Config) -> str:
    return f"State {config.scan.state}" if config.scan.states else f"Energy {config.scan.energy or 0.0:.7g} keV"


def _new_folder(config: Config, place: Path) -> Path:
    folder = create_run_folder(place, f"{config.sample.name}_{_kind(config)}", SystemClock().now())
    write_whole(folder / CONFIG, resolved_yaml(config))  # --resume uses this
    return folder


def _runs(series: Path, config: Config) -> list[Path | None]:
    """The newest run folder of each scan of a series; None for a scan without a run."""
    if not is_series(series):
        raise ConfigError(f"{series} is not the folder of a series of scans. Nothing was changed.")
    run_of_value = dict[float, Path]()
    for run in sorted(path.parent for path in series.glob(f"*/{SCAN}")):
        run_of_value[_value(load(run / CONFIG, environment={}))] = run
    return [run_of_value.get(value) for value in config.series]


def _job(run: Path | None, resources: ExitStack) -> Path | ResumableRun | None:
    """What must still be done for a scan. Its scan file: nothing, because it is complete. A run: the rest of this run.
    None: a new scan.
    """
    if run is None:
        return None
    try:
        return resources.enter_context(open_for_resume(run))
    except NoFrame:
        return None
    except (NotJoined, NothingMissing):
        recover_run(run)  # sets the final state in the record of a run whose process was killed in its last fit
    except DataError as error:
        raise DataError(
            f"{error} If {run} cannot be recovered, move it to another place: --resume then takes this scan again."
        ) from None
    return scan_file(run)


def _send(event: Event, sinks: Sequence[Sink]) -> None:
    fan_out(*sinks)(replace(event, time=SystemClock().now()))


def _after_failure(folder: Path, name: str, of: int, sinks: Sequence[Sink]) -> None:
    """Report how the series can be continued; remove its folder if it contains no scan."""
    if any(path.is_dir() for path in folder.iterdir()):
        scan = f"{name[0].lower()}{name[1:]}"
        sentence = f"The series of {of} scans ended at {scan}. `beamline scan --resume {folder}` continues it."
        _send(Warned(sentence), sinks)
        return
    (folder / CONFIG).unlink()
    folder.rmdir()
