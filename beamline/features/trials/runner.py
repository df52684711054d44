"""Runner: opens the scan, runs each trial in a process of its own within the time there is, and writes the table."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.durations import MachineSpeed
from beamline.core.errors import DataError
from beamline.core.events import Done, Event, Sink, StateEntered, TrialReached
from beamline.core.files import refuse_existing
from beamline.core.sinks import Warn, Warnings
from beamline.features.trials.launch import DATA, TrialData, compile_kernels, run_trial, write_reference, write_regions
from beamline.features.trials.layout import TableLayout, event_of, write_page, write_table
from beamline.features.trials.plans import Expected, Timed, expected_seconds, trials_left
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.scan_statistics import Light, LightAsked, light_in
from beamline.projections.selection import Selection
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.outcome import facts_of
from beamline.report.sheets import SliceSheet
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import Clock
from recon.assess import metrics
from recon.base.arrays import F32
from recon.base.volume import Grid
from recon.base.work import Rates

_PAGES = 5.0, 0.1  # s of the budget for pictures and page at its end; share of it, at most
_COMPILING = 0.5  # of the time left, at most: what is missing then is compiled by the trials, cheap ones first
_SHOWN = ("method", "parts", "one fit")  # groups of trials whose slices the page shows


@dataclass(frozen=True)
class ComparedScan:
    """The scan of a trade-off or a study.

    Attributes:
        folder: for the results; must not exist.
        truth: FILE or FILE:first:end to compare with.
        light: what the user knows of it; None: the dose is counted in frames.
    """

    source: SourceOptions
    selection: Selection
    folder: Path
    truth: str | None = None
    light: LightAsked | None = None


@dataclass(frozen=True, eq=False)
class OpenedScan:
    """A scan ready for many reconstructions.

    Attributes:
        facts: for people, by name.
        truth: on `grid`; None where nobody knows it.
        light: of a view; None: not asked for, and the dose is counted in frames.
    """

    facts: Mapping[str, str]
    prepared: PreparedProjections
    grid: Grid
    truth: F32 | None
    light: Light | None


def opened_scan(asked: ComparedScan, warn: Warn) -> OpenedScan:
    """Read and correct the views, after all inputs were checked.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    refuse_existing(asked.folder)
    truth_given = None if asked.truth is None else read_truth(asked.truth)
    with asked.source.open() as source:
        light, facts = light_in(source, asked.light), dict(facts_of(source).table)
        prepared = prepare_projections(source, asked.selection, warn).without_warnings
    grid = Grid.matching(prepared.geometry)
    truth = None if truth_given is None else fit_truth(truth_given, grid, asked.selection.binning).data
    facts["volume"] = " × ".join(map(str, grid.shape))
    if light is not None:
        facts["light"] = "; ".join(light.in_words())
    return OpenedScan(facts, prepared, grid, truth, light)


@dataclass(frozen=True, eq=False)
class Planned:
    """What a comparison will do.

    Attributes:
        table: before any trial is done.
        layout: of the table.
        started: the event that says so.
        references: trials whose volumes others are compared with, in addition to the truth: each with those of its
            method. The first one has the dense and the empty regions.
    """

    table: TrialTable
    layout: TableLayout
    started: Event
    references: tuple[Trial, ...] = ()


@dataclass(frozen=True)
class RunLimits:
    """Where a comparison is written, and when it ends.

    Attributes:
        folder: for the results; must not exist.
        max_seconds: wall time of the whole run, with reading, compiling and the page. A trial that would not fit into
            what is left is not begun, a running one is ended. None: no limit.
    """

    folder: Path
    seed: int = 0
    max_seconds: float | None = None


@dataclass(frozen=True)
class _Rig:
    """Where trials run, and how they report.

    Attributes:
        work: folder with the data.
        end: by `now`, when the last trial must be done; inf: no limit.
    """

    work: Path
    seed: int
    end: float
    now: Callable[[], float]
    emit: Callable[[Event], None]
    expected: Expected

    @property
    def seconds(self) -> float | None:
        """That are left; None: no limit."""
        return None if self.end == math.inf else self.end - self.now()

    def run(self, trial: Trial, seconds: float | None, keep: bool) -> tuple[Outcome, F32 | None]:
        """The outcome within so many seconds, and the volume [z, y, x] if it is kept and there is one."""
        path = self.work / "volume.npy"
        outcome = run_trial(trial, self.work, self.seed, seconds, keep=path if keep else None)
        if not (keep and path.exists()):
            return outcome, None
        volume = np.load(path)
        path.unlink()
        return outcome, volume


def run_comparison(
    plan: Callable[[Warn], tuple[TrialData, Planned]],
    limits: RunLimits,
    sink: Sink,
    clock: Clock,
    now: Callable[[], float] = time.monotonic,
    begun: float | None = None,
    rates: Rates | None = None,
) -> TrialTable:
    """Run all trials and write table, pictures and page into the folder. The event `done` names the folder.

    The table is written after every trial, so that an interruption loses at most one. After Ctrl-C the table is
    `stopped`. A folder without results is removed. The views lie in files of the folder while the trials run: this
    process does not keep them.

    Args:
        plan: reads the scan and says which trials to run.
        begun: by `now`, when the time of the run began; None: it begins here.
        rates: of this machine; None: measured, or those kept.

    Raises:
        ConfigError, DataError: nothing was written, or the table of the trials that were done.
        KeyboardInterrupt: before the first trial was done; nothing was written.
    """
    folder, started = limits.folder, clock.now()
    end = math.inf if limits.max_seconds is None else (now() if begun is None else begun) + _usable(limits.max_seconds)

    def emit(event: Event) -> None:
        sink(replace(event, time=clock.now()))

    data, planned = plan(Warnings(sink, clock))
    emit(planned.started)
    table, layout, slices, truth = planned.table, planned.layout, SliceSheet(), data.truth
    expected = expected_seconds(data.geometry, rates or MachineSpeed())
    with _result_folder(folder) as work:
        data.save(work / DATA)
        del data
        rig = _Rig(work, limits.seed, end, now, emit, expected)
        for n, reference in enumerate(planned.references):
            volume = _add_reference(rig, reference, slices)
            if n == 0:
                _add_regions(rig, volume if truth is None else truth)
        if truth is not None:
            slices.add("truth", truth)
        emit(StateEntered("compiling", "Compiling kernels that are not in the cache"))
        seconds = rig.seconds
        trials = [table.outcomes[n].trial for n in table.todo]
        compile_kernels(trials, work, None if seconds is None else max(seconds, 0.0) * _COMPILING)
        table = until_stopped(
            table, _each(table, layout, rig, slices), lambda grown: write_table(folder, grown, layout)
        )
    write_page(folder, table, layout, slices)
    summary = {"output": folder, layout.unit: len(table.todo), "done": table.n_done, "stopped": table.stopped}
    emit(Done({**summary, "seconds": clock.now() - started}))
    return table


def _usable(max_seconds: float) -> float:
    """s of a limit that are not for pictures and page."""
    return max_seconds - min(_PAGES[0], _PAGES[1] * max_seconds)


def _add_reference(rig: _Rig, trial: Trial, slices: SliceSheet) -> F32:
    """Make a volume that trials of its method are compared with.

    Raises:
        DataError: it failed.
    """
    outcome, volume = rig.run(trial, rig.seconds, keep=True)
    if volume is None:
        raise DataError(f"{trial.title}, to compare with, failed: {outcome.message}. Nothing was written.")
    write_reference(rig.work / DATA, trial.method, volume)
    slices.add(f"{trial.choice.label if trial.choice else trial.title}: {trial.method}", volume)
    return volume


def _add_regions(rig: _Rig, volume: F32) -> None:
    """The dense and the empty regions of a volume, if it has contrast."""
    with suppress(ValueError):
        write_regions(rig.work / DATA, metrics.kmeans_mask(metrics.sampled(volume), rig.seed))


def until_stopped(table: TrialTable, grown: Iterable[TrialTable], write: Callable[[TrialTable], None]) -> TrialTable:
    """The last table of `grown`, which is written each time; after Ctrl-C it is `stopped`.

    Raises:
        KeyboardInterrupt: before any trial was done; nothing was written.
    """
    try:
        for table in grown:
            if table.n_done:
                write(table)
    except KeyboardInterrupt:
        if not table.n_done:
            raise
        table = replace(table, stopped=True)
    write(table)
    return table


def _each(table: TrialTable, layout: TableLayout, rig: _Rig, slices: SliceSheet) -> Iterator[TrialTable]:
    """The table after each trial, and after one that Ctrl-C interrupted; `slices` gets those that the page shows."""
    begin, timed, todo = rig.now(), list[Timed](), table.todo
    for n, index in enumerate(todo):
        trial, seconds = table.outcomes[index].trial, rig.seconds
        if seconds is not None and (refusal := _no_time(trials_left(timed, [trial], rig.expected) or 0.0, seconds)):
            table = table.with_outcome(index, Outcome(trial, "not run", message=refusal))
            yield table
            continue
        eta = trials_left(timed, [table.outcomes[other].trial for other in todo[n:]], rig.expected)
        eta = eta if eta is None or seconds is None else min(eta, seconds)
        rate = 60 * n / max(rig.now() - begin, 1e-9)
        rig.emit(TrialReached(layout.name, n, len(todo), trial.label, eta, rate))
        started = rig.now()
        try:
            outcome, volume = rig.run(trial, seconds, keep=trial.group in _SHOWN)
        except KeyboardInterrupt:
            yield table.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            raise
        if volume is not None:
            slices.add(trial.title, volume, *(() if trial.choice is None else (trial.choice.family, trial.method)))
        timed.append(Timed.of(outcome, rig.now() - started))
        table = table.with_outcome(index, outcome)
        yield table
        rig.emit(event_of(table, layout, n + 1, len(todo), outcome))


def _no_time(needed: float, remaining: float) -> str:
    """Why a trial of so many seconds is not begun; empty: there is time."""
    if needed < remaining:
        return ""
    about = f"it would take about {needed:.0f} s, and only {remaining:.0f} s were left"
    return f"not begun: {about if remaining > 0 else 'no time was left'}"


@contextmanager
def _result_folder(folder: Path) -> Iterator[Path]:
    """Make the folder of a result, and a temporary folder in it, which is removed at the end of the block.

    An empty result folder is removed, too, because the next run would refuse it.
    """
    folder.mkdir()
    work = folder / "work"
    work.mkdir()
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
