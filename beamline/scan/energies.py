"""Energies: a series of scans of one sample, one scan per energy, in one folder. The series can be continued later.

Each scan has an ordinary run folder within the folder of the series, so that every program that reads runs can read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from beamline.config.load import Config, at_energies, load, resolved_yaml
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, RunDone, Sink, StateEntered, Warned
from beamline.core.files import CONFIG, SCAN, create_run_folder, write_whole
from beamline.core.run_result import RunResult
from beamline.core.sinks import Warn, fan_out
from beamline.core.stop import StopRequest
from beamline.instrument.connect import clock_after, connect
from beamline.scan.control import State
from beamline.scan.live_process import Commands
from beamline.scan.preflight import dry_run, refuse_violations
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
from beamline.storage.interrupted import scan_file
from drivers.base.clock import SystemClock
from drivers.in_beam import Ask


@dataclass(frozen=True)
class SeriesRun:
    """A finished series of energies.

    Attributes:
        folder: folder of the series. scans: energy in keV and scan file of each scan. results: results of the scans
            that were taken now.
    """

    folder: Path
    scans: tuple[tuple[float, Path], ...]
    results: tuple[RunResult, ...]


def is_series(folder: Path) -> bool:
    """True if a folder contains a series of energies."""
    if not (folder / CONFIG).is_file() or (folder / SCAN).exists():
        return False
    return load(folder / CONFIG, environment={}).scan.energies is not None


def scans_in(folder: Path, warn: Warn) -> list[Path]:
    """The scan files of a series, for each energy that has one, in the order of the configuration.

    Args:
        warn: function that gets a sentence on energies whose scan is incomplete or does not exist.

    Raises:
        DataError: no energy has a scan.
    """
    runs = _runs(folder, load(folder / CONFIG, environment={}))
    files = [scan_file(run) for run in runs if run is not None]
    whole = [run for run in runs if run is not None and describe(run).state == State.DONE]
    if files and len(whole) < len(runs):
        warn(
            f"{folder}: {len(whole)} of {len(runs)} energies have a complete scan; {len(files)} with frames are "
            f"used. `beamline scan --resume {folder}` takes the missing scans."
        )
    if not files:
        raise DataError(
            f"{folder} has no scan yet: `beamline scan --resume {folder}` takes the scans. Nothing was written."
        )
    return files


def scans_of(paths: Iterable[Path], warn: Warn) -> tuple[Path, ...]:
    """The scans at these paths. The folder of a series stands for all of its scans, see `scans_in`."""
    return tuple(scan for path in paths for scan in (scans_in(path, warn) if is_series(path) else [scan_file(path)]))


def run_energies(
    config: Config,
    place: Path | None,
    sinks: Sequence[Sink],
    stop: StopRequest,
    commands: Callable[[Config, ResumableRun | None], Commands],
    *,
    series: Path | None = None,
    ask: Ask | None = None,
) -> SeriesRun:
    """Run a scan at each of `scan.energies`, one after the other. The devices stay connected.

    Args:
        place: folder in which the folder of the series is created; None: the configured folder. stop: request that ends
            the current scan and the series. `sinks`, `ask`: as in `run_scan`, for all scans. commands: commands for the
            reconstruction of each scan. series: folder of a series to continue. Complete scans are kept, and a scan
            that ended early is continued.

    Raises:
        ConfigError: a limit is exceeded at one of the energies; nothing has moved. All errors of `run_scan`: the
            earlier scans are complete, and a warning names the folder with which the series can be continued.
    """
    each, send = at_energies(config), fan_out(*sinks)
    with ExitStack() as held:
        jobs = [None] * len(each) if series is None else [_job(run, held) for run in _runs(series, config)]
        complete = [(one.scan.energy or 0.0, job) for one, job in zip(each, jobs, strict=True) if isinstance(job, Path)]
        if series is not None and len(complete) == len(each):
            return SeriesRun(series, tuple(complete), ())
        refuse_violations(dry_run(config, series or place, whole=[energy for energy, _ in complete]).timeline)
        last = max((job.last_frame_time for job in jobs if isinstance(job, ResumableRun)), default=0.0)
        clock = clock_after(config, last)
        instrument = held.enter_context(connect(config, clock=clock, ask=ask, check_stop=stop.refuse_abort))
        folder = series or _new_folder(config, place or Path(config.storage.folder))
        scans, results = list[tuple[float, Path]](), list[RunResult]()
        for n, (one, job) in enumerate(zip(each, jobs, strict=True), 1):
            energy = one.scan.energy or 0.0
            if isinstance(job, Path):
                scans.append((energy, job))
                continue
            _tell(StateEntered("energies", f"Energy {n} of {len(each)}: {energy:.7g} keV"), sinks)
            for warning in job.left_out if job else ():
                _tell(Warned(warning), sinks)
            try:
                how = commands(one, job)
                if how.remark:
                    _tell(StateEntered("energies", how.remark), sinks)
                taken = run_scan(
                    one, job or folder,
                    [lambda event: None if isinstance(event, RunDone) else send(event)],  # more scans follow
                    stop, live=how.live, afterwards=how.afterwards, instrument=instrument,
                )  # fmt: skip
            except BaseException:
                _after_failure(folder, n, len(each), sinks)
                raise
            results.append(taken)
            scans.append((energy, taken.path))
    return SeriesRun(folder, tuple(scans), tuple(results))


def _new_folder(config: Config, place: Path) -> Path:
    folder = create_run_folder(place, f"{config.sample.name}_energies", SystemClock().now())
    write_whole(folder / CONFIG, resolved_yaml(config))  # used by --resume
    return folder


def _runs(series: Path, config: Config) -> list[Path | None]:
    """The folder of the newest run at each energy of a series; None: there is no run."""
    if not is_series(series):
        raise ConfigError(f"{series} is not the folder of an energy series. Nothing was changed.")
    run_of_energy = dict[float | None, Path]()
    for run in sorted(path.parent for path in series.glob(f"*/{SCAN}")):
        run_of_energy[load(run / CONFIG, environment={}).scan.energy] = run
    return [run_of_energy.get(energy) for energy in config.scan.energies or ()]


def _job(run: Path | None, held: ExitStack) -> Path | ResumableRun | None:
    """The remaining work for an energy: nothing (the scan file is returned), the rest of a run, or a new scan
    (None)."""
    if run is None:
        return None
    try:
        return held.enter_context(open_for_resume(run))
    except NoFrame:
        return None
    except (NotJoined, NothingMissing):
        recover_run(run)  # sets the final state in the record of a run whose process was killed during the final fit
    except DataError as error:
        raise DataError(
            f"{error} If {run} cannot be recovered, move it to another place: --resume then takes this scan again."
        ) from None
    return scan_file(run)


def _tell(event: Event, sinks: Sequence[Sink]) -> None:
    fan_out(*sinks)(replace(event, time=SystemClock().now()))


def _after_failure(folder: Path, n: int, of: int, sinks: Sequence[Sink]) -> None:
    """Report how the series can be continued. If the folder contains no scan, remove it."""
    if any(path.is_dir() for path in folder.iterdir()):
        _tell(Warned(f"The series ended at energy {n} of {of}. `beamline scan --resume {folder}` continues it."), sinks)
        return
    (folder / CONFIG).unlink()
    folder.rmdir()
