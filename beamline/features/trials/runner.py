"""Runner: reads the scan once, runs each trial, and writes the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from beamline.cli.terminal import answering
from beamline.core.durations import in_turn
from beamline.core.errors import DataError, ScanStopped
from beamline.core.events import Done, Sink
from beamline.core.files import refuse_existing, refuse_not_utf8, write_table
from beamline.core.machine import machine
from beamline.core.recon_events import TrialDone, TrialsStarted
from beamline.core.sinks import Warnings
from beamline.features.trials.run_trial import TrialData, TrialScan, run_trial
from beamline.features.trials.table import text, write_page
from beamline.features.trials.trial import HELD_OUT, MethodTrial, Outcome, TrialTable
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import hold_out
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.scan_facts import facts_of
from beamline.reconstruct.truth import fit_truth, read_truth
from beamline.report.sheets import SliceSheet
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import Clock
from recon.base.arrays import F32
from recon.base.empirical import ONE_IN
from recon.base.volume import Grid, Volume
from recon.judgement import regions_of

_HELD_OUT_VIEWS = 16  # largest number of held-out projections


@dataclass(frozen=True)
class ComparedScan:
    """The scan of a trade-off or a study, and settings that apply to all of its reconstructions.

    Attributes:
        methods: names in `recon.methods`; empty: the default methods of the comparison.
        truth: ground truth for the comparison, as FILE or FILE:first:end.
        seconds: time limit of each reconstruction, the same for all methods; None: no limit.
        command: the command line of this call, which the page states.
    """

    source: SourceOptions
    selection: Selection
    methods: Sequence[str] = ()
    truth: str | None = None
    seconds: float | None = None
    seed: int = 0
    command: str = ""


Run = Callable[[TrialScan, MethodTrial], tuple[Outcome, F32 | None]]
"""Runs a trial of a scan; returns its outcome and the volume [z, y, x], which is None if the trial failed."""


@dataclass(frozen=True, eq=False)
class Planned:
    """What a comparison will do.

    Attributes:
        data: function that returns the data of the scan. It first makes the reconstructions with which trials are
            compared.
        table: the table before any trial is done.
        slices: the sheet of slices before any trial is done.
    """

    data: Callable[[Run], TrialScan]
    table: TrialTable
    slices: SliceSheet = field(default_factory=SliceSheet)


Plan = Callable[[Sink, Clock], Planned]
"""Function that reads and corrects the projections of a scan, and plans the trials. If it raises ConfigError or
DataError, nothing was written."""


def opened_scan(
    compared: ComparedScan, name: str, title: str, sink: Sink, clock: Clock, *, held_out: bool
) -> tuple[TrialData, TrialTable]:
    """Check all inputs, then read and correct the projections. The table has no trials yet.

    Args:
        name, title: name and title of the table.
        held_out: True if all trials are scored with held-out projections when there is no ground truth.

    Raises:
        ConfigError, DataError: nothing was written.
    """
    truth_given = None if compared.truth is None else read_truth(compared.truth)
    with compared.source.open() as source:
        facts = dict(facts_of(source).table)
        prepared = prepare_projections(select(source, compared.selection), Warnings(sink, clock)).without_warnings
    if held_out and truth_given is None:
        prepared = hold_out(prepared, ONE_IN, most=_HELD_OUT_VIEWS, advice="give --truth")
    truth = None
    if truth_given is not None:
        truth = fit_truth(truth_given, Grid.matching(prepared.geometry), compared.selection.binning).data
    measure = HELD_OUT if truth is None else "psnr"
    facts["volume"] = " × ".join(map(str, Grid.matching(prepared.geometry).shape))
    table = TrialTable(name, title, (), measure, machine(), facts, compared.command)
    return TrialData(prepared.views, truth, seed=compared.seed), table


def _run_and_show(slices: SliceSheet, data: TrialScan, trial: MethodTrial) -> tuple[Outcome, F32 | None]:
    """The outcome and the volume [z, y, x] of a trial; None if it failed."""
    outcome, volume = run_trial(trial, data)
    if volume is not None and trial.shown:
        slices.add(trial.shown, volume, "" if trial.choice is None else trial.choice.family, trial.method)
    return outcome, volume


def _run_all(
    table: TrialTable, run: Callable[[MethodTrial], tuple[Outcome, F32 | None]], path: Path, sink: Sink, clock: Clock
) -> TrialTable:
    """Run the trials one after the other, and write the table to a CSV file after each. After Ctrl-C the table is
    `stopped`.

    Args:
        run: function that returns the outcome and the volume [z, y, x] of a trial (None if the trial failed).

    Raises:
        KeyboardInterrupt: before any trial was done; nothing was written.
    """
    trials, todo = [outcome.trial for outcome in table.outcomes], table.todo
    try:
        for n, index in enumerate(
            in_turn(table.name, todo, lambda index_of_trial: trials[index_of_trial].label, sink, clock), 1
        ):
            trial, whole = trials[index], table
            table = whole.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            outcome, _ = run(trial)
            table = whole.with_outcome(index, outcome)
            if table.compared:
                write_table(path, table.records)
            sink(replace(_event_of(table, n, len(todo), outcome), time=clock.now()))
    except KeyboardInterrupt:
        if not table.compared:
            raise
        table = replace(table, stopped=True)
    write_table(path, table.records)
    return table


def _event_of(table: TrialTable, n: int, total: int, outcome: Outcome) -> TrialDone:
    """The event of a trial that has ended, the n-th of all trials. `gaussians` is the number at the start, as in the
    settings of the trial."""
    trial = outcome.trial
    figures = {
        **{name: getattr(trial, name) for name in ("group", "method", "views")},
        **trial.settings,
        "cpu_seconds": outcome.cpu_seconds,
        "gaussians_end": outcome.gaussians,
        **outcome.metrics,
    }
    quality = outcome.quality(table.by)
    return TrialDone(
        n, total, trial.label, outcome.status, outcome.seconds, outcome.message, quality, outcome.peak_bytes, figures
    )


def compare(plan: Plan, file: Path | str, folder: Path, *, as_json: bool) -> TrialTable:
    """Run a comparison, and print its table.

    Raises: ScanStopped: the comparison was stopped after some trials.
    """
    with answering(as_json) as answer:
        table = run_comparison(plan, file, folder, answer.sink, answer.clock)
        answer.lines = text(table), f"\n{'report':<10}{folder / table.page}"
    if table.stopped:
        counts = f"{len(table.compared)} of {len(table.todo)} trials"
        raise ScanStopped(f"The {table.name} was stopped after {counts}. The results are in {folder}.")
    return table


def run_comparison(plan: Plan, file: Path | str, folder: Path, sink: Sink, clock: Clock) -> TrialTable:
    """Run all trials and write table, pictures and page into the folder. The event `done` names the folder.

    The table is written after every trial, so that an interruption loses at most one. After Ctrl-C the table is
    `stopped`. A folder without results is removed.

    Args:
        plan: function that reads the scan and decides which trials to run. file: file of the scan, which the event
            states. folder: new folder; it must not exist.

    Raises:
        ConfigError, DataError: nothing was written; or, if some trials were done, the table with these trials.
        KeyboardInterrupt: before the first trial was done; nothing was written.
    """
    refuse_not_utf8(file)
    refuse_existing(folder)
    began = clock.now()
    planned = plan(sink, clock)
    table, path, run = planned.table, folder / f"{planned.table.name}.csv", partial(_run_and_show, planned.slices)
    todo = len(table.todo)
    sink(TrialsStarted(file, table.name, todo, len(table.outcomes) - todo, table.by, time=clock.now()))
    folder.mkdir()
    try:
        data = planned.data(run)
        if data.truth is not None:
            planned.slices.add("truth", data.truth)
        table = data.concluded(_run_all(table, partial(run, data), path, sink, clock))
    finally:
        with suppress(OSError):  # the folder has results; an empty folder would prevent the next run
            folder.rmdir()
    write_table(path, table.records)
    write_page(folder, table, planned.slices)
    summary = {"output": folder, "trials": todo, "done": len(table.compared), "stopped": table.stopped}
    conclusion = {"best": table.best, "scores": [outcome.metrics.get(table.by) for outcome in table.compared]}
    sink(Done({**summary, **conclusion, "seconds": clock.now() - began}, time=clock.now()))
    return table


def with_references(data: TrialData, references: Sequence[MethodTrial], run: Run) -> TrialData:
    """The data with reference volumes in addition to the ground truth: each trial is compared with the reference of its
    own method. Dense and empty regions come from the ground truth, or else from the first reference.

    Raises:
        DataError: a reference could not be made.
    """
    volumes = dict[str, F32]()
    for reference in references:
        outcome, volume = run(data, reference)
        if volume is None:
            raise DataError(
                f"The reference for the comparison ({reference.label}) failed: {outcome.message}. Nothing was written."
            )
        volumes[reference.method] = volume
    contrast = next(iter(volumes.values())) if data.truth is None else data.truth
    regions = regions_of(Volume(contrast, Grid.matching(data.geometry)), data.seed)
    return replace(data, references=volumes, regions=regions)
