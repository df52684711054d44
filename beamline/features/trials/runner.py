"""Runner: runs each trial in a process of its own within the time there is, and writes the table; a dry run says how
long that takes, by those that are done or by the work of each."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil

from beamline.core.errors import DataError
from beamline.core.events import Done, Event, Sink, StateEntered, TrialReached
from beamline.core.machine import Need, free_memory
from beamline.core.sinks import Warn, Warnings
from beamline.core.text import count, size
from beamline.features.trials.launch import DATA, ComparedScan, compile_kernels, run_trial, write_array
from beamline.features.trials.layout import Plan, TableLayout, event_of, write_page, write_table
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.report.sheets import SliceSheet
from drivers.base.clock import Clock
from recon.assess import metrics
from recon.assess.time_model import duration_text
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.forecast import forecast
from recon.warm_up import warm_up

_PAGES = 5.0, 0.1  # s of the budget for pictures and page at its end; share of it, at most
_COMPILING = 0.5  # of the time left, at most: what is missing then is compiled by the trials, cheap ones first
_SHOWN = ("method", "parts", "one fit")  # groups of trials whose slices the page shows


def size_of(trial: Trial) -> float:
    """Work of a trial, in a unit that all trials of its method share: steps x views x voxels."""
    method = trial.build()
    steps = getattr(method, "iterations", None) or getattr(method, "planned_steps", None) or 1
    return float((1 + trial.halves) * steps * trial.views / trial.binning**3)


def trials_left(done: Sequence[Outcome], trials: Sequence[Trial]) -> float | None:
    """s that the trials to come will take, from those done; None before the first.

    Starting and measuring take the same time in each trial. The rest is as that of the finished trials of the same
    method, by their sizes; of a method of which none is finished, as that of all.
    """
    if not done:
        return None
    total = len(trials) * sum(each.wall - each.working for each in done) / len(done)
    for trial in trials:
        same = [each for each in done if each.trial.method == trial.method and each.working > 0]
        if trial.seconds_asked is not None:
            total += trial.seconds_asked
        elif same:
            total += size_of(trial) * sum(o.working for o in same) / sum(size_of(o.trial) for o in same)
        else:
            total += sum(each.working for each in done) / len(done)
    return total


@dataclass(frozen=True)
class _Rig:
    """Where trials run, and how they report.

    Attributes:
        work: folder with the data.
        end: by `now`, when the last trial must be done; inf: no limit.
        slices: gets those that the page shows.
    """

    work: Path
    seed: int
    end: float
    now: Callable[[], float]
    emit: Callable[[Event], None]
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
    with _result_folder(scan.folder) as work:
        planned.data.save(work / DATA)
        del planned
        rig = _Rig(work, scan.seed, end, now, emit, slices)
        contrast = truth
        for reference in references:
            outcome, volume = rig.run(reference, rig.seconds, reference.title)
            if volume is None:
                raise DataError(f"{reference.title}, to compare with, failed: {outcome.message}. Nothing was written.")
            write_array(work / DATA / f"reference.{reference.method}.npy", volume)
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
    summary = {
        "output": scan.folder,
        layout.unit: len(table.todo),
        "done": len(table.compared),
        "stopped": table.stopped,
    }
    emit(Done({**summary, "seconds": clock.now() - started}))
    return table


def _run_all(table: TrialTable, layout: TableLayout, rig: _Rig, folder: Path) -> TrialTable:
    """Run the trials in turn, and write the table after each; after Ctrl-C it is `stopped`.

    Raises:
        KeyboardInterrupt: before any trial was done; nothing was written.
    """
    begin, timed, todo = rig.now(), list[Outcome](), table.todo
    try:
        for n, index in enumerate(todo):
            trial, seconds = table.outcomes[index].trial, rig.seconds
            if refusal := _no_time(trials_left(timed, [trial]) or 0.0, seconds):
                table = table.with_outcome(index, Outcome(trial, "not run", message=refusal))
                continue
            eta = trials_left(timed, [table.outcomes[other].trial for other in todo[n:]])
            rate = 60 * n / max(rig.now() - begin, 1e-9)
            rig.emit(TrialReached(layout.name, n, len(todo), trial.label, eta and min(eta, seconds), rate))
            started, whole = rig.now(), table
            table = whole.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            outcome, _ = rig.run(trial, seconds, trial.title * (trial.group in _SHOWN))
            timed.append(replace(outcome, wall=rig.now() - started))
            table = whole.with_outcome(index, timed[-1])
            if table.compared:
                write_table(folder, table, layout)
            rig.emit(event_of(table, layout, n + 1, len(todo), outcome))
    except KeyboardInterrupt:
        if not table.compared:
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


@dataclass(frozen=True, kw_only=True)
class ExpectedTrial(Need):
    """What a trial will take, with the start of its process."""

    label: str


@dataclass(frozen=True)
class ExpectedRun:
    """What a comparison will take.

    Attributes:
        folder: that it would write.
        disk, free: bytes for the views while it runs, and bytes on that disk.
        allowed: bytes of memory that are free.
    """

    stage: str
    folder: Path
    trials: tuple[ExpectedTrial, ...]
    disk: int
    free: int
    allowed: int

    def lines(self) -> list[str]:
        """For people."""
        rows = [("trial", "s", "MB")]
        for trial in self.trials:
            seconds = "–" if trial.seconds is None else f"{trial.seconds:.3g}"
            rows.append((trial.label, seconds, "–" if trial.memory is None else f"{trial.memory / 1e6:.0f}"))
        width = max(len(label) for label, *_ in rows)
        need, unknown = Need.in_turn(self.trials), sum(trial.seconds is None for trial in self.trials)
        beside = f", beside {count(unknown, 'trial')} whose time is not known" if unknown else ""
        return [
            *(f"{label:<{width}}{seconds:>8}{memory:>8}" for label, seconds, memory in rows),
            "",
            f"{'trials':<10}{len(self.trials)}",
            f"{'time':<10}about {duration_text(need.seconds or 0.0)}, with starts of processes{beside}",
            f"{'memory':<10}{size(need.memory or 0)} in the largest process; {size(self.allowed)} are free",
            f"{'disk':<10}{size(self.disk)} for the views meanwhile; {size(self.free)} free",
            f"{'output':<10}{self.folder}: {self.stage}.csv, {self.stage}.json, page and pictures (not written now)",
        ]


def _paces(trials: Sequence[Trial], geometry: Geometry) -> dict[str, float | None]:
    """s of the first trial of each method over its size, by the method's name, from a few iterations of it.

    None: not known before it is tried, also where its method refuses the views, which the trial will report.
    """
    paces: dict[str, float | None] = {}
    for trial in trials:
        if trial.method not in paces:
            paces[trial.method] = None
            with suppress(ValueError):
                method = trial.build()
                warm_up(method, geometry)
                expected = forecast(method, geometry, Grid.matching(geometry), time.perf_counter)
                whole = replace(trial, views=geometry.n_views, binning=1, halves=False)
                paces[trial.method] = expected and expected.most / size_of(whole)
    return paces


def dry_run(plan: Plan, folder: Path, warn: Warn) -> ExpectedRun:
    """Plan a comparison; nothing is written, and a few iterations of each method are run.

    Raises:
        ConfigError, DataError: the comparison would be refused.
    """
    start, own_bytes = time.process_time(), int(psutil.Process().memory_info().rss)  # of a process that has begun
    planned = plan(warn)
    data, prepared = planned.data, planned.data.prepared
    arrays = (
        prepared.projections.data, prepared.projections.weights, prepared.shares, data.truth,
        prepared.held_out and prepared.held_out[0],
    )  # fmt: skip
    disk, weighted = sum(array.nbytes for array in arrays if array is not None), prepared.ray_factors() is not None

    trials = [*planned.references, *(planned.table.outcomes[n].trial for n in planned.table.todo)]
    paces = _paces(trials, data.geometry)

    def expected(trial: Trial) -> ExpectedTrial:
        coarse, pace = data.geometry.binned(trial.binning), paces[trial.method]
        works = trial.seconds_asked or (pace and pace * size_of(trial))
        # of a process that has loaded the libraries, the views twice (in their file and those used), the rest
        memory = own_bytes + 2 * disk + trial.build().memory(coarse, Grid.matching(coarse), weighted)
        return ExpectedTrial(label=trial.label, seconds=None if works is None else start + works, memory=memory)

    free = shutil.disk_usage(folder.absolute().parent).free
    return ExpectedRun(planned.layout.name, folder, tuple(map(expected, trials)), disk, free, free_memory())
