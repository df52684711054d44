"""Runner: opens the scan, runs each trial in a process of its own within the time there is, and writes the table."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from beamline.core.durations import MachineSpeed
from beamline.core.errors import DataError
from beamline.core.events import Done, Event, Sink, StateEntered, TrialReached
from beamline.core.files import refuse_existing, refuse_not_utf8
from beamline.core.machine import machine
from beamline.core.sinks import Warn, Warnings
from beamline.features.trials.forecast import Expected, Timed, expected_seconds, trials_left
from beamline.features.trials.launch import DATA, TrialData, compile_kernels, run_trial, write_array
from beamline.features.trials.layout import Plan, TableLayout, event_of, write_page, write_table
from beamline.features.trials.trial import Outcome, Trial, TrialTable
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

_PAGES = 5.0, 0.1  # s of the budget for pictures and page at its end; share of it, at most
_COMPILING = 0.5  # of the time left, at most: what is missing then is compiled by the trials, cheap ones first
_SHOWN = ("method", "parts", "one fit")  # groups of trials whose slices the page shows


@dataclass(frozen=True)
class ComparedScan:
    """The scan of a trade-off or a study, and what holds for all of its reconstructions.

    Attributes:
        folder: for the results; must not exist.
        methods: names in `recon.methods`; none: those that suit the comparison.
        truth: FILE or FILE:first:end to compare with.
        light: what the user knows of it; None: the dose is counted in frames.
        seconds: of each reconstruction, the same for all methods; None: they end when their work is done.
        max_seconds: wall time of the whole run, with reading, compiling and the page. A trial that would not fit into
            what is left is not begun, a running one is ended. None: no limit.
        command: that repeats this, for the record.
    """

    source: SourceOptions
    selection: Selection
    folder: Path
    methods: Sequence[str] = ()
    truth: str | None = None
    light: LightAsked | None = None
    seconds: float | None = None
    max_seconds: float | None = None
    seed: int = 0
    command: str = ""


def opened_scan(asked: ComparedScan, warn: Warn) -> tuple[TrialData, TrialTable]:
    """Read and correct the views, after all inputs were checked; the table has no trials yet.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    refuse_not_utf8(asked.source.path)
    refuse_existing(asked.folder)
    truth_given = None if asked.truth is None else read_truth(asked.truth)
    with asked.source.open() as source:
        light, facts = light_in(source, asked.light), dict(facts_of(source).table)
        prepared = prepare_projections(source, asked.selection, warn).without_warnings
    grid, truth = Grid.matching(prepared.geometry), None
    if truth_given is not None:
        truth = fit_truth(truth_given, grid, asked.selection.binning).data
    if light is not None:
        facts["light"] = "; ".join(light.in_words())
    return TrialData(prepared, truth), table_of(asked, facts, prepared, light)


def table_of(
    scan: ComparedScan, facts: Mapping[str, str], prepared: PreparedProjections, light: Light | None = None
) -> TrialTable:
    """A table without trials; `facts` are of the scan, by name, `light` of a view."""
    known = {**facts, "volume": " × ".join(map(str, Grid.matching(prepared.geometry).shape))}
    return TrialTable((), "psnr", prepared.length_unit, machine(), known, scan.command, light=light)


@dataclass(frozen=True)
class _Rig:
    """Where trials run, and how they report.

    Attributes:
        work: folder with the data.
        end: by `now`, when the last trial must be done; inf: no limit.
        slices: get those that the page shows.
    """

    work: Path
    seed: int
    end: float
    now: Callable[[], float]
    emit: Callable[[Event], None]
    expected: Expected
    slices: SliceSheet

    @property
    def seconds(self) -> float:
        """That are left; inf: no limit."""
        return self.end - self.now()

    def run(self, trial: Trial, seconds: float, title: str = "") -> tuple[Outcome, F32 | None]:
        """The outcome within so many seconds, and the volume [z, y, x] if its slice has a title and there is one."""
        path, choice = self.work / "volume.npy", trial.choice
        outcome = run_trial(trial, self.work, self.seed, seconds, keep=path if title else None)
        if not (title and path.exists()):
            return outcome, None
        volume = np.load(path)
        path.unlink()
        self.slices.add(title, volume, *(() if choice is None else (choice.family, trial.method)))
        return outcome, volume


def run_comparison(
    plan: Plan,
    scan: ComparedScan,
    sink: Sink,
    clock: Clock,
    now: Callable[[], float] = time.monotonic,
    begun: float | None = None,
) -> TrialTable:
    """Run all trials and write table, pictures and page into the folder. The event `done` names the folder.

    The table is written after every trial, so that an interruption loses at most one. After Ctrl-C the table is
    `stopped`. A folder without results is removed. The views lie in files of the folder while the trials run: this
    process does not keep them.

    Args:
        plan: reads the scan and says which trials to run.
        begun: by `now`, when the time of the run began; None: it begins here.

    Raises:
        ConfigError, DataError: nothing was written, or the table of the trials that were done.
        KeyboardInterrupt: before the first trial was done; nothing was written.
    """
    started, end = clock.now(), math.inf
    if (limit := scan.max_seconds) is not None:
        end = (now() if begun is None else begun) + limit - min(_PAGES[0], _PAGES[1] * limit)

    def emit(event: Event) -> None:
        sink(replace(event, time=clock.now()))

    planned, slices = plan(Warnings(sink, clock)), SliceSheet()
    emit(planned.started)
    table, layout, references, truth = planned.table, planned.layout, planned.references, planned.data.truth
    expected = expected_seconds(planned.data.geometry, MachineSpeed())
    with _result_folder(scan.folder) as work:
        planned.data.save(work / DATA)
        del planned
        rig = _Rig(work, scan.seed, end, now, emit, expected, slices)
        contrast = truth
        for reference in references:
            volume = _add_reference(rig, reference)
            contrast = volume if contrast is None else contrast
        if contrast is not None and "snr" in layout.figures:
            with suppress(ValueError):  # it has no dense and empty regions
                dense = metrics.kmeans_mask(metrics.sampled(contrast), rig.seed)
                write_array(work / DATA / "data.regions.npy", dense)
        if truth is not None:
            slices.add("truth", truth)
        emit(StateEntered("compiling", "Compiling kernels that are not in the cache"))
        trials = [table.outcomes[n].trial for n in table.todo]
        compile_kernels(trials, work, max(rig.seconds, 0.0) * _COMPILING)
        table = _run_all(table, layout, rig, scan.folder)
    write_page(scan.folder, table, layout, slices)
    summary = {"output": scan.folder, layout.unit: len(table.todo), "done": table.n_done, "stopped": table.stopped}
    emit(Done({**summary, "seconds": clock.now() - started}))
    return table


def _add_reference(rig: _Rig, trial: Trial) -> F32:
    """Make a volume that trials of its method are compared with.

    Raises:
        DataError: it failed.
    """
    outcome, volume = rig.run(trial, rig.seconds, trial.title)
    if volume is None:
        raise DataError(f"{trial.title}, to compare with, failed: {outcome.message}. Nothing was written.")
    write_array(rig.work / DATA / f"reference.{trial.method}.npy", volume)
    return volume


def _run_all(table: TrialTable, layout: TableLayout, rig: _Rig, folder: Path) -> TrialTable:
    """Run the trials in turn, and write the table after each; after Ctrl-C it is `stopped`.

    Raises:
        KeyboardInterrupt: before any trial was done; nothing was written.
    """
    begin, timed, todo = rig.now(), list[Timed](), table.todo
    try:
        for n, index in enumerate(todo):
            trial, seconds = table.outcomes[index].trial, rig.seconds
            if refusal := _no_time(trials_left(timed, [trial], rig.expected) or 0.0, seconds):
                table = table.with_outcome(index, Outcome(trial, "not run", message=refusal))
                continue
            eta = trials_left(timed, [table.outcomes[other].trial for other in todo[n:]], rig.expected)
            rate = 60 * n / max(rig.now() - begin, 1e-9)
            rig.emit(TrialReached(layout.name, n, len(todo), trial.label, eta and min(eta, seconds), rate))
            started, whole = rig.now(), table
            table = whole.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            outcome, _ = rig.run(trial, seconds, trial.title * (trial.group in _SHOWN))
            table = whole.with_outcome(index, outcome)
            timed.append(Timed.of(outcome, rig.now() - started))
            if table.n_done:
                write_table(folder, table, layout)
            rig.emit(event_of(table, layout, n + 1, len(todo), outcome))
    except KeyboardInterrupt:
        if not table.n_done:
            raise
        table = replace(table, stopped=True)
    write_table(folder, table, layout)
    return table


def _no_time(needed: float, remaining: float) -> str:
    """Why a trial of so many seconds is not begun; empty: there is time."""
    about = f"it would take about {needed:.0f} s, and only {remaining:.0f} s were left"
    return "" if needed < remaining else f"not begun: {about if remaining > 0 else 'no time was left'}"


@contextmanager
def _result_folder(folder: Path) -> Iterator[Path]:
    """Make the folder of a result, and a temporary folder in it, which is removed at the end of the block.

    An empty result folder is removed, too, because the next run would refuse it.
    """
    folder.mkdir()
    try:
        with TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as work:
            yield Path(work)
    finally:
        with suppress(OSError):  # it has results
            folder.rmdir()
