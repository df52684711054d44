"""Forecast: the time that trials take, of those to come by those that are done, and what a dry run says of all."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import psutil

from beamline.core.machine import Need, free_memory
from beamline.core.sinks import Warn
from beamline.core.text import count, size
from beamline.features.trials.layout import Plan
from beamline.features.trials.trial import Outcome, Trial
from recon.assess.time_model import duration_text
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.base.work import Rates, costs_of, seconds_of
from recon.methods import by_name

Expected = Callable[[Trial], float | None]
"""s of a trial; None: not known."""

_WITH_HALVES = 3  # the half-set resolution takes two more reconstructions


@dataclass(frozen=True)
class Timed:
    """A finished trial, and how its time was spent.

    Attributes:
        wall: s, from before its process began to after its end.
        working: s of these that it reconstructed, which grow with the work; the rest is the same for all.
    """

    trial: Trial
    wall: float
    working: float

    @classmethod
    def of(cls, outcome: Outcome, wall: float) -> Timed:
        """The times of a trial that has ended; one without figures has 0 s of work."""
        seconds = outcome.seconds * (_WITH_HALVES if outcome.trial.halves else 1)
        return cls(outcome.trial, wall, min(wall, seconds) if math.isfinite(seconds) else 0.0)


def expected_seconds(geometry: Geometry, rates: Rates) -> Expected:
    """s that a trial on some of these views reconstructs, at most.

    None: not known before it is tried; that is also where its method refuses the views, which the trial will report.
    """

    @cache
    def of_trial(trial: Trial) -> float | None:
        limit, views = trial.seconds_asked, np.arange(trial.views)
        if limit is not None and not by_name(trial.method).traits.own_length:
            return limit
        with suppress(ValueError):
            method, coarse = (
                trial.build(),
                geometry.select(views * geometry.n_views // views.size).binned(trial.binning),
            )
            parts = [coarse.select(part) for part in np.array_split(views, trial.parts)]
            if trial.halves:
                parts += [coarse.select(slice(first, None, 2)) for first in (0, 1)]
            costs = [costs_of(method, [(part, Grid.matching(part))]) for part in parts]
            seconds = [seconds_of(each, rates).most for each in costs if each is not None]
            return min(sum(seconds), limit or math.inf) if seconds else None
        return None

    return of_trial


def trials_left(done: Sequence[Timed], trials: Sequence[Trial], expected: Expected) -> float | None:
    """s that the trials to come will take, from those done; None before the first.

    Each takes the same time to start and measure, and what is expected of it, at the pace of its method's trials that
    are done, or of all. One of which nothing is expected takes what those of its method did, or all.
    """
    if not done:
        return None
    total = len(trials) * sum(each.wall - each.working for each in done) / len(done)
    # a direct method is over too soon to tell how fast this machine is
    pace = _pace([each for each in done if not by_name(each.trial.method).traits.direct], expected) or 1.0
    for trial in trials:
        same = [each for each in done if each.trial.method == trial.method and each.working > 0]
        if trial.seconds_asked is not None:
            total += trial.seconds_asked
        elif (seconds := expected(trial)) is not None:
            total += seconds * (_pace(same, expected) or pace)
        else:
            total += sum(each.working for each in same or done) / len(same or done)
    return total


def _pace(done: Sequence[Timed], expected: Expected) -> float | None:
    """What trials took over what was expected of them; None where nothing was."""
    told = [(seconds, each.working) for each in done if each.working > 0 and (seconds := expected(each.trial))]
    return sum(taken for _, taken in told) / sum(seconds for seconds, _ in told) if told else None


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
        width = max((len(trial.label) for trial in self.trials), default=5)
        rows = [
            f"{trial.label:<{width}}"
            f"{'–' if trial.seconds is None else f'{trial.seconds:.3g}':>8}"
            f"{'–' if trial.memory is None else f'{trial.memory / 1e6:.0f}':>8}"
            for trial in self.trials
        ]
        need, unknown = Need.in_turn(self.trials), sum(trial.seconds is None for trial in self.trials)
        beside = f", beside {count(unknown, 'trial')} whose time is not known" if unknown else ""
        return [
            f"{'trial':<{width}}{'s':>8}{'MB':>8}",
            *rows,
            "",
            f"{'trials':<10}{len(self.trials)}",
            f"{'time':<10}about {duration_text(need.seconds or 0.0)}, with starts of processes{beside}",
            f"{'memory':<10}{size(need.memory or 0)} in the largest process; {size(self.allowed)} are free",
            f"{'disk':<10}{size(self.disk)} for the views meanwhile; {size(self.free)} free",
            f"{'output':<10}{self.folder}: {self.stage}.csv, {self.stage}.json, page and pictures (not written now)",
        ]


def dry_run(plan: Plan, folder: Path, warn: Warn, rates: Rates) -> ExpectedRun:
    """Plan a comparison; nothing is written, and nothing is run.

    Args:
        rates: of this machine.

    Raises:
        ConfigError, DataError: the comparison would be refused.
    """
    start, own_bytes = time.process_time(), int(psutil.Process().memory_info().rss)  # of a process that has begun
    planned = plan(warn)
    data, prepared = planned.data, planned.data.prepared
    at_most = expected_seconds(data.geometry, rates)
    arrays = (
        prepared.projections.data, prepared.projections.weights, prepared.shares, data.truth,
        prepared.held_out and prepared.held_out[0],
    )  # fmt: skip
    disk, weighted = sum(array.nbytes for array in arrays if array is not None), prepared.ray_factors() is not None

    def expected(trial: Trial) -> ExpectedTrial:
        coarse, works = data.geometry.binned(trial.binning), at_most(trial)
        # of a process that has loaded the libraries, the views twice (in their file and those used), the rest
        memory = own_bytes + 2 * disk + trial.build().memory(coarse, Grid.matching(coarse), weighted)
        return ExpectedTrial(label=trial.label, seconds=None if works is None else start + works, memory=memory)

    trials = [*planned.references, *(planned.table.outcomes[n].trial for n in planned.table.todo)]
    free = shutil.disk_usage(folder.absolute().parent).free
    return ExpectedRun(planned.layout.name, folder, tuple(map(expected, trials)), disk, free, free_memory())
