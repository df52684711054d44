"""What accuracy costs in time: many reconstructions of one scan, each in its own process, measured alike."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event, Sink, Warnings
from beamline.core.files import named_on_failure
from beamline.core.machine import machine
from beamline.projections.prepare import PreparedProjections, prepare_projections
from beamline.projections.selection import Selection
from beamline.reconstruct.measure import fit_truth, read_truth
from beamline.reconstruct.options import SourceOptions
from beamline.reconstruct.recon_report import facts_of
from beamline.tradeoff.data import Data
from beamline.tradeoff.launch import compile_kernels, run_trial
from beamline.tradeoff.report import write_figures, write_table
from beamline.tradeoff.table import TrialTable
from beamline.tradeoff.trials import Outcome, Timed, plan, seconds_left
from drivers.clock import Clock
from recon.base.method import Depth
from recon.base.volume import Grid
from recon.splatting.initialise import default_count

_HELD_OUT_SHARE = 8  # one of so many views is kept back where there is nothing else to judge by
_HELD_OUT_VIEWS = 16


@dataclass(frozen=True)
class TradeoffOptions:
    """What to compare.

    Attributes:
        source, selection: the scan and the part of it to use.
        folder: for the results; must not exist.
        methods: names in `recon.methods`.
        depth: how many trials.
        max_seconds: wall time after which no trial is started and the running one is ended; None: no limit.
        truth: FILE or FILE:first:end to compare with.
        seed: of everything random.
        command: that repeats this, for the record.
    """

    source: SourceOptions
    selection: Selection
    folder: Path
    methods: Sequence[str]
    depth: Depth = "quick"
    max_seconds: float | None = None
    truth: str | None = None
    seed: int = 0
    command: str = ""


def run_tradeoff(
    options: TradeoffOptions, sink: Sink, clock: Clock, now: Callable[[], float] = time.monotonic
) -> TrialTable:
    """Make all trials, and leave table, pictures and page in the folder. The event `done` says where.

    The table in the folder is complete after every trial, so that whatever ends this leaves what was measured. Where
    Ctrl-C did, the table is `stopped`; the folder goes where there is nothing in it to keep.

    Raises:
        ConfigError, DataError: with nothing written, or with the table of the trials that could be written.
        KeyboardInterrupt: before the first trial was done, with nothing written.
    """
    folder, started = options.folder, clock.now()
    if folder.exists():
        raise DataError(f"{folder} exists and results are never overwritten. Name another folder, or move it away.")
    if not folder.parent.is_dir():
        raise DataError(f"The folder {folder.parent} does not exist. Create it first.")
    wanted = None if options.truth is None else read_truth(options.truth)
    warn = Warnings(sink, clock)
    with options.source.open() as source:
        facts = facts_of(source)
        prepared = prepare_projections(source, options.selection, warn)
    grid = Grid.matching(prepared.geometry)
    truth = None if wanted is None else fit_truth(wanted, grid, options.selection.binning).data
    data = split(prepared, truth)
    trials = plan(
        options.methods,
        data.geometry.n_views,
        default_count(Grid.of_field(data.geometry, grid.voxel_size)),
        options.depth,
    )
    table = TrialTable(
        outcomes=tuple(Outcome(trial, "not run") for trial in trials),
        by="psnr" if truth is not None else "residual_held_out",
        length_unit=prepared.length_unit,
        machine=machine(),
        scan={**facts.table, "views used": str(data.geometry.n_views), "volume": " × ".join(map(str, grid.shape))},
        command=options.command,
    )
    sink(Event("tradeoff_started", clock.now(), {"file": options.source.path, "trials": len(trials), "by": table.by}))
    folder.mkdir()
    work = folder / "work"
    work.mkdir()
    try:
        with named_on_failure(work / "data.npz"):
            data.save(work / "data.npz")
        said = {"state": "compiling", "message": "Compiling what is not in the cache yet"}
        sink(Event("state", clock.now(), said))
        compile_kernels(trials, work)
        for table in _each(table, work, options, sink, clock, now):  # noqa: B020 - each is the one before and a trial more
            write_table(folder, table)
    except KeyboardInterrupt:
        if table.n_done == 0:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        table = replace(table, stopped=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):  # it would be in the way of the next try
            folder.rmdir()
    write_table(folder, table)
    write_figures(folder, table)
    summary = {"output": folder, "trials": len(trials), "done": table.n_done, "stopped": table.stopped}
    sink(Event("done", clock.now(), {**summary, "seconds": clock.now() - started}))
    return table


def split(prepared: PreparedProjections, truth: Any) -> Data:
    """The views that trials may use, and those that none may: judging by data needs views that no trial has seen.

    Raises:
        ConfigError: too few views to keep some back.
    """
    projections, geometry = prepared.projections.data, prepared.geometry
    if truth is not None or prepared.held_out is not None:
        return Data(projections, geometry, prepared.held_out, truth)
    n = geometry.n_views
    kept_back = min(_HELD_OUT_VIEWS, max(1, n // _HELD_OUT_SHARE))
    if n - kept_back < 2:
        raise ConfigError(f"{n} views leave none to judge by; choose more with --views, or give --truth.")
    # Not the first and last: a view next to nothing is no fair question.
    held = np.unique((np.arange(kept_back) + 0.5) * n // kept_back).astype(np.int64)
    used = np.setdiff1d(np.arange(n), held)
    return Data(projections[used], geometry.select(used), (projections[held], geometry.select(held)), None)


def _each(
    table: TrialTable, work: Path, options: TradeoffOptions, sink: Sink, clock: Clock, now: Callable[[], float]
) -> Iterator[TrialTable]:
    """The table after each trial, and after one that Ctrl-C cut off."""
    begin = now()
    timed: list[Timed] = []
    for index, outcome in enumerate(table.outcomes):
        trial = outcome.trial
        left = None if options.max_seconds is None else options.max_seconds - (now() - begin)
        if left is not None and left <= 0:
            break
        eta = seconds_left(timed, [other.trial for other in table.outcomes[index:]])
        progress = {"stage": "tradeoff", "n": index, "of": len(table.outcomes), "label": trial.label, "eta_s": eta}
        sink(Event("progress", clock.now(), {**progress, "per_min": 60 * index / max(now() - begin, 1e-9)}))
        started = now()
        try:
            result = run_trial(trial, work, options.seed, left)
        except KeyboardInterrupt:
            yield table.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            raise
        timed.append(Timed.of(result, now() - started))
        table = table.with_outcome(index, result)
        yield table
        sink(Event("trial", clock.now(), {"n": index + 1, "of": len(table.outcomes), **table.event_data(result)}))
