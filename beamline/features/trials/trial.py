"""Trial (a reconstruction to make), its outcome, the table of all trials, and their Pareto front."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from beamline.core.files import REPORT
from beamline.features.trials.view_choices import ViewChoice
from recon.base.method import Method, Plain
from recon.base.method_kinds import Direct
from recon.methods import build, by_name

Status = Literal["done", "failed", "interrupted", "not run"]

LEAST_GAIN = 0.01  # dB: the smallest difference that tables show
# number of standard errors, of the difference over the held-out projections, up to which a difference may be chance
_ERRORS = 2.0


@dataclass(frozen=True)
class MethodTrial:
    """One reconstruction to make.

    Attributes:
        group: the setting that the trial varies; "method" if it varies none. method: name of the method in
            `recon.methods`. views: number of projections, evenly spread over those of the scan; with `choice`, the
            number of projections in the choice.
        settings: settings of the method by name, as for `recon.methods.build`.
        seconds_asked: time limit of the reconstruction in s; None: no limit.
        choice: selection of projections; None: `views` evenly spread ones.
    """

    group: str
    method: str
    views: int
    settings: Mapping[str, Plain] = field(default_factory=dict, hash=False)
    seconds_asked: float | None = None
    choice: ViewChoice | None = None

    @property
    def left_out(self) -> bool:
        """True if the scan does not have the requested projections."""
        return self.choice is not None and self.choice.groups is None

    @property
    def shown(self) -> str:
        """The label under which the page shows a slice of the trial. In a study, all rows are shown; otherwise only
        baselines."""
        if self.choice is not None:
            return self.label
        return by_name(self.method).label if self.group == "method" else ""

    @property
    def frames(self) -> int:
        """The dose of the trial: number of frames of the scan that it uses, each counted once."""
        return self.views if self.choice is None else self.choice.frames

    def build(self) -> Method:
        """The method with the settings of the trial.

        Raises:
            ValueError: the method or a setting does not exist.
        """
        method, seconds = by_name(self.method), self.seconds_asked
        return build(method, {**self.settings, **({} if seconds is None else method.ended_by(seconds))})

    def in_time(self, seconds: float | None) -> MethodTrial:
        """The trial with this time limit in s, if its method has one. A direct method takes the time it needs."""
        method = by_name(self.method)
        if seconds is None or issubclass(method, Direct):
            return self
        by_time = method.ended_by(seconds)
        untimed = {name: value for name, value in self.settings.items() if name not in by_time}
        return replace(self, settings=untimed, seconds_asked=seconds)

    @property
    def label(self) -> str:
        """The settings in a few words."""
        if self.choice is not None:
            return f"{self.choice.label}: {self.method}"
        parts = [self.method, f"{self.views} views"]
        parts += [f"{self.seconds_asked:g} s"] if self.seconds_asked is not None else []
        return ", ".join([*parts, *(f"{value} {name}" for name, value in self.settings.items())])


HELD_OUT = "residual_held_out"


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        status: only outcomes with the status "done" have figures of merit.
        seconds: wall time of the reconstruction, without compilation and checks.
        peak_bytes: peak memory of its process; None if the system does not report it.
        metrics: figures of merit by name: psnr, ssim3d (with a ground truth), residual_held_out, and with a reference
            psnr_all, ssim_all, snr, cnr.
        gaussians: number of Gaussians at the end; None for voxel methods.
        cpu_seconds: CPU time of all threads of the reconstruction. Compare this value if other programs use the
            computer.
        squared_residuals: squared residual of each held-out projection.
        verdict: "best"; "alike": not significantly worse than the best; empty: worse, or not compared in this way.
    """

    trial: MethodTrial
    status: Status
    seconds: float = math.nan
    peak_bytes: int | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    gaussians: int | None = None
    message: str = ""
    cpu_seconds: float = math.nan
    squared_residuals: Sequence[float] = ()
    verdict: str = ""

    def quality(self, by: str) -> float:
        """Quality in dB by the metric of this name (higher is better); NaN if it is not known."""
        value = self.metrics.get(by, math.nan)
        if by != HELD_OUT:
            return value
        return -20 * math.log10(value) if value > 0 else math.nan


@dataclass(frozen=True)
class TrialTable:
    """All trials of a scan, with facts about the scan and the computer.

    Attributes:
        name: name of the command and of its CSV file.
        title: title of the page.
        outcomes: all outcomes in the order of the plan, including trials that are left out.
        by: the metric with which quality is compared: psnr, psnr_all or residual_held_out.
        scan: facts about the scan for people, by name.
        question: the question that the table answers; may be empty.
        stopped: True if it was interrupted before all trials were done.
        notes: sentences about the meaning of the figures.
        asks_costs: True if the question is which trial is worth its time. The Pareto front is then marked. asks_best:
            True if the question is which trial has the smallest residual in held-out projections. Figures then have
            more digits, and the pictures show them.
        page: file name of the page.
    """

    name: str
    title: str
    outcomes: tuple[Outcome, ...]
    by: str
    machine: Mapping[str, str | int]
    scan: Mapping[str, str]
    command: str
    question: str = ""
    stopped: bool = False
    notes: Sequence[str] = ()
    asks_costs: bool = False
    asks_best: bool = False
    page: str = REPORT

    def with_outcome(self, index: int, outcome: Outcome) -> TrialTable:
        """The table with the outcome of this number replaced."""
        return replace(self, outcomes=(*self.outcomes[:index], outcome, *self.outcomes[index + 1 :]))

    @property
    def compared(self) -> tuple[Outcome, ...]:
        """The outcomes of trials that reconstructed the scan successfully."""
        return tuple(o for o in self.outcomes if o.status == "done")

    @property
    def best(self) -> dict[str, Plain] | None:
        """The settings of the best trial; None if no trial has the verdict "best"."""
        return next((dict(each.trial.settings) for each in self.compared if each.verdict == "best"), None)

    @property
    def todo(self) -> list[int]:
        """Numbers of the trials that are not left out."""
        return [n for n, outcome in enumerate(self.outcomes) if not outcome.trial.left_out]

    @property
    def metrics(self) -> set[str]:
        """Names of the figures of merit that at least one row has."""
        return {name for outcome in self.outcomes for name in outcome.metrics}

    @property
    def front(self) -> list[Outcome]:
        """The Pareto front: trials for which no faster trial is as good, in ascending order of time and of quality.

        Times within 1 % count as equal. A slower trial is on the front only if it is better by more than `chance`. If
        trials are equal, the first one is on the front.
        """
        front: list[Outcome] = []
        known = [o for o in self.compared if math.isfinite(o.seconds) and math.isfinite(o.quality(self.by))]
        for each in sorted(known, key=lambda o: (_rounded(o.seconds), -o.quality(self.by))):
            if not front or each.quality(self.by) - front[-1].quality(self.by) > self.chance(each, front[-1]):
                front.append(each)
        return front

    def chance(self, first_trial: Outcome, second_trial: Outcome) -> float:
        """Largest difference between two trials in dB that is not significant.

        Without a ground truth: two standard errors of the mean difference of squared residuals over the held-out
        projections. The noise of a projection is in both of its residuals, so it cancels in the difference.
        """
        first, second = (np.asarray(each.squared_residuals) for each in (first_trial, second_trial))
        if self.by != HELD_OUT or min(first.size, second.size) < 2 or first.size != second.size:
            return LEAST_GAIN
        apart, level = first - second, (first.mean() + second.mean()) / 2
        error = apart.std(ddof=1) / math.sqrt(apart.size)
        return max(LEAST_GAIN, _ERRORS * 10 / math.log(10) * float(error / level)) if level > 0 else LEAST_GAIN

    def verdict(self, outcome: Outcome) -> str:
        """The verdict of the outcome. It is "front" if the outcome is on the Pareto front and the table marks the
        front."""
        return "front" if self.asks_costs and outcome in self.front else outcome.verdict

    @property
    def records(self) -> list[dict[str, Any]]:
        """The rows of the CSV file: all values of each trial, by name. A value that only other rows have is None."""
        settings = [name for outcome in self.outcomes for name in outcome.trial.settings]
        rows: list[dict[str, Any]] = []
        for outcome in self.outcomes:
            trial = outcome.trial
            values: dict[str, Any] = {
                "row": trial.label if trial.choice is None else trial.choice.label,
                **{name: getattr(trial, name) for name in ("group", "method", "views", "frames")},
                "window": 1 if trial.choice is None else trial.choice.window,
                **{name: trial.settings.get(name) for name in settings},
                "status": outcome.status,
                "seconds_asked": trial.seconds_asked,
                **{name: getattr(outcome, name) for name in ("seconds", "cpu_seconds", "peak_bytes")},
                "gaussians_end": outcome.gaussians,
                **{name: outcome.metrics.get(name) for name in sorted(self.metrics | {self.by})},
                "quality_db": outcome.quality(self.by),
                "verdict": self.verdict(outcome),
                "message": outcome.message,
            }
            unknown = [name for name, each in values.items() if isinstance(each, float) and not math.isfinite(each)]
            rows.append(values | dict.fromkeys(unknown))
        return rows


def _rounded(cost: float) -> float:
    """The cost rounded to steps of 1 %, so that smaller differences count as equal."""
    if not cost > 0 or math.isinf(cost):
        return cost
    step = math.log(1.01)
    return math.exp(round(math.log(cost) / step) * step)
