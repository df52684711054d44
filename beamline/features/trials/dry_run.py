"""Dry run: the trials of a comparison, the time and memory that they will take, and what they would write."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from beamline.cli.terminal import answering
from beamline.core.durations import MachineSpeed
from beamline.core.machine import Need, free_memory
from beamline.core.sinks import Warn
from beamline.core.text import count, size
from beamline.features.trials.launch import TrialData
from beamline.features.trials.plans import expected_seconds
from beamline.features.trials.runner import Planned
from beamline.features.trials.trial import Trial
from recon.assess.time_model import duration_text
from recon.base.volume import Grid
from recon.base.work import Rates


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

    @property
    def need(self) -> Need:
        """Of all trials whose time is known; memory of the largest process."""
        return Need.in_turn(self.trials)

    def lines(self) -> list[str]:
        """For people."""
        width = max((len(trial.label) for trial in self.trials), default=5)
        rows = [
            f"{trial.label:<{width}}"
            f"{'–' if trial.seconds is None else f'{trial.seconds:.3g}':>8}"
            f"{'–' if trial.memory is None else f'{trial.memory / 1e6:.0f}':>8}"
            for trial in self.trials
        ]
        unknown = sum(trial.seconds is None for trial in self.trials)
        beside = f", beside {count(unknown, 'trial')} whose time is not known" if unknown else ""
        return [
            f"{'trial':<{width}}{'s':>8}{'MB':>8}",
            *rows,
            "",
            f"{'trials':<10}{len(self.trials)}",
            f"{'time':<10}about {duration_text(self.need.seconds or 0.0)}, with starts of processes{beside}",
            f"{'memory':<10}{size(self.need.memory or 0)} in the largest process; {size(self.allowed)} are free",
            f"{'disk':<10}{size(self.disk)} for the views meanwhile; {size(self.free)} free",
            f"{'output':<10}{self.folder}: {self.stage}.csv, {self.stage}.json, page and pictures (not written now)",
        ]


def dry_run(
    plan: Callable[[Warn], tuple[TrialData, Planned]],
    folder: Path,
    warn: Warn,
    rates: Rates,
    now: Callable[[], float] = time.process_time,
) -> ExpectedRun:
    """Plan a comparison; nothing is written, and nothing is run.

    Args:
        rates: of this machine.
        now: processor time of this process. What it has taken by now is the start of a process.

    Raises:
        ConfigError, DataError: the comparison would be refused.
    """
    start, own_bytes = now(), int(psutil.Process().memory_info().rss)
    data, planned = plan(warn)
    table = planned.table
    trials = [table.outcomes[n].trial for n in table.todo]
    trials = [*planned.references, *trials]

    at_most = expected_seconds(data.geometry, rates)

    def expected(trial: Trial) -> ExpectedTrial:
        seconds = None if (works := at_most(trial)) is None else start + works
        return ExpectedTrial(label=trial.label, seconds=seconds, memory=_memory(trial, data, own_bytes))

    free = shutil.disk_usage(folder.absolute().parent).free
    return ExpectedRun(planned.layout.name, folder, tuple(map(expected, trials)), _bytes(data), free, free_memory())


def print_dry_run(plan: Callable[[Warn], tuple[Any, Any]], folder: Path, as_json: bool) -> None:
    """Print what a comparison will take."""
    with answering(as_json) as answer:
        expected = dry_run(plan, folder, answer.warn, MachineSpeed())
        answer.done(expected, *expected.lines())


def _memory(trial: Trial, data: TrialData, own_bytes: int) -> int:
    """Bytes: of a process that has loaded the libraries, the views twice (in their file and those used), the rest."""
    method = trial.build()
    coarse = data.geometry.binned(trial.binning)
    weighted = data.prepared.ray_factors() is not None
    return own_bytes + 2 * _bytes(data) + method.memory(coarse, Grid.matching(coarse), weighted)


def _bytes(data: TrialData) -> int:
    prepared = data.prepared
    known, unseen = prepared.projections, prepared.held_out
    arrays = (known.data, known.weights, prepared.shares, data.truth, unseen and unseen[0])
    return sum(array.nbytes for array in arrays if array is not None)
