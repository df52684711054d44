"""Runs a trade-off: many reconstructions of one scan, each in its own process, all measured in the same way."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from beamline.core.events import Done, Sink, StateEntered, TradeoffStarted, TrialReached
from beamline.core.files import result_folder
from beamline.core.machine import machine
from beamline.core.sinks import Warnings
from beamline.report.slice_sheet import SliceSheet
from beamline.trials.compared import Several, compared
from beamline.trials.launch import compile_kernels, run_trial
from beamline.trials.opened import ComparedScan, until_stopped
from beamline.trials.report import write_figures, write_table
from beamline.trials.table import TrialTable
from beamline.trials.trial import Outcome, Timed, seconds_left, telling_first
from beamline.trials.varied import Depth
from drivers.base.clock import Clock

_PAGES = 5.0, 0.1  # s of the budget for pictures and page at its end; share of it, at most
_SHOWN = ("method", "parts", "one fit")  # groups of trials whose slices the page shows


@dataclass(frozen=True)
class TradeoffOptions:
    """The scan and the trials to compare.

    Attributes:
        methods: names in `recon.methods`; none: those that suit such a scan.
        several: how the views show several volumes.
        max_seconds: wall time of the whole run, with reading, compiling and the page. A trial that would not fit into
            what is left is not begun, a running one is ended. None: no limit.
        seconds: of each reconstruction, the same for all methods; None: settings are varied.
    """

    scan: ComparedScan
    methods: Sequence[str]
    several: Several = field(default_factory=Several)
    depth: Depth = "quick"
    max_seconds: float | None = None
    seconds: float | None = None
    seed: int = 0
    command: str = ""


def run_tradeoff(
    options: TradeoffOptions,
    sink: Sink,
    clock: Clock,
    now: Callable[[], float] = time.monotonic,
    begun: float | None = None,
) -> TrialTable:
    """Run all trials and write table, pictures and page into the folder. The event `done` names the folder.

    The table is written after every trial, so that an interruption loses at most one. After Ctrl-C the table is
    `stopped`. A folder without results is removed.

    Args:
        begun: by `now`, when the time of the run began; None: it begins here.

    Raises:
        ConfigError, DataError: nothing was written, or the table of the trials that were done.
        KeyboardInterrupt: before the first trial was done; nothing was written.
    """
    folder, started = options.scan.folder, clock.now()
    end = math.inf
    if options.max_seconds is not None:
        end = (
            (now() if begun is None else begun) + options.max_seconds - min(_PAGES[0], _PAGES[1] * options.max_seconds)
        )
    warn = Warnings(sink, clock)
    found = compared(options.scan, options.methods, options.depth, options.several, warn, options.seconds)
    data, trials = found.data, found.trials
    if options.max_seconds is not None:
        trials = telling_first(trials)
    table = TrialTable(
        outcomes=tuple(Outcome(trial, "not run") for trial in trials),
        by="psnr" if data.truth is not None else "residual_held_out",
        length_unit=found.length_unit,
        machine=machine(),
        scan=found.facts,
        command=options.command,
        light=found.light,
    )
    sink(TradeoffStarted(options.scan.source.path, len(trials), table.by, time=clock.now()))
    slices = SliceSheet()
    if data.truth is not None:
        slices.add("truth", data.truth)
    with result_folder(folder) as work:
        data.save(work / "data.npz")
        sink(StateEntered("compiling", "Compiling kernels that are not in the cache", time=clock.now()))
        compile_kernels(trials, work, None if end == math.inf else max(end - now(), 0.0))
        table = until_stopped(table, _each(table, work, slices, options, sink, clock, now, end), folder, write_table)
    write_figures(folder, table, slices)
    summary = {"output": folder, "trials": len(trials), "done": table.n_done, "stopped": table.stopped}
    sink(Done({**summary, "seconds": clock.now() - started}, time=clock.now()))
    return table


def _each(
    table: TrialTable,
    work: Path,
    slices: SliceSheet,
    options: TradeoffOptions,
    sink: Sink,
    clock: Clock,
    now: Callable[[], float],
    end: float,
) -> Iterator[TrialTable]:
    """The table after each trial, and after one that Ctrl-C interrupted; `slices` gets the slices of the baselines.

    `end`: by `now`, when the last trial must be done; inf: no limit.
    """
    begin = now()
    timed: list[Timed] = []
    for index, outcome in enumerate(table.outcomes):
        trial = outcome.trial
        left = None if end == math.inf else end - now()
        needed = seconds_left(timed, [trial]) or 0.0
        if left is not None and needed >= left:
            message = f"not begun: it would take about {needed:.0f} s, of which {left:.0f} s were left"
            message = message if left > 0 else "not begun: no time was left"
            table = table.with_outcome(index, replace(outcome, message=message))
            yield table
            continue
        eta = seconds_left(timed, [other.trial for other in table.outcomes[index:]])
        n, rate = len(table.outcomes), 60 * index / max(now() - begin, 1e-9)
        sink(TrialReached("tradeoff", index, n, trial.label, eta, rate, time=clock.now()))
        started, keep = now(), work / "volume.npy" if trial.group in _SHOWN else None
        try:
            result = run_trial(trial, work, options.seed, left, keep=keep)
        except KeyboardInterrupt:
            yield table.with_outcome(index, Outcome(trial, "interrupted", message="ended before it was done"))
            raise
        if keep is not None and keep.exists():
            slices.add(trial.title, np.load(keep))
            keep.unlink()
        timed.append(Timed.of(result, now() - started))
        table = table.with_outcome(index, result)
        yield table
        sink(replace(table.event(index, result), time=clock.now()))
