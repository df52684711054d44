"""All trials of a scan with their outcomes, and which of them are on the Pareto front of a cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from beamline.features.trials.trial import QUALITIES, Outcome, Quality
from beamline.projections.scan_statistics import Light, dose_scale

LEAST_GAIN = 0.01  # dB: the smallest difference that tables show
_ERRORS = 2.0  # standard errors, of the difference over the views held out, that chance may reach


@dataclass(frozen=True)
class TrialCost:
    """A cost of a trial, and how a picture shows it.

    Attributes:
        name: in file names; `words`: in titles and captions.
        axis: label with its unit; `scale`: from the value to that unit; `unit`: alone.
        of: the cost of an outcome; NaN where it is not known.
    """

    name: str
    words: str
    axis: str
    scale: float
    of: Callable[[Outcome], float]
    unit: str


TIME = TrialCost("seconds", "time", "time (s)", 1.0, lambda outcome: outcome.seconds, "s")
MEMORY = TrialCost(
    "memory", "memory", "peak memory of the process (MB)", 1e-6,
    lambda outcome: math.nan if outcome.peak_bytes is None else float(outcome.peak_bytes),
    "MB",
)  # fmt: skip


@dataclass(frozen=True)
class TrialTable:
    """All trials of a scan, with the scan and the machine that they ran on.

    Attributes:
        outcomes: in the order of the plan, also of trials that are left out.
        by: the measure of quality, of `QUALITIES`.
        length_unit: of the resolution, "mm" or "px".
        scan: facts for people, by name.
        stopped: it was interrupted before all trials were done.
        light: of a frame; None: the dose is counted in frames.
        notes: sentences on what the figures mean.
    """

    outcomes: tuple[Outcome, ...]
    by: str
    length_unit: str
    machine: Mapping[str, str | int]
    scan: Mapping[str, str]
    command: str
    stopped: bool = False
    light: Light | None = None
    notes: Sequence[str] = ()

    def with_outcome(self, index: int, outcome: Outcome) -> TrialTable:
        """The table with this outcome in place of the one of this number."""
        return replace(self, outcomes=(*self.outcomes[:index], outcome, *self.outcomes[index + 1 :]))

    def with_fact(self, name: str, value: str) -> TrialTable:
        """The table with one more fact about the scan."""
        return replace(self, scan={**self.scan, name: value})

    @property
    def n_done(self) -> int:
        """Trials that have a volume."""
        return sum(outcome.status == "done" for outcome in self.outcomes)

    @property
    def timed(self) -> bool:
        """Trials end when their time is over."""
        return any(outcome.trial.seconds_asked is not None for outcome in self.outcomes)

    @property
    def dose(self) -> TrialCost:
        """The dose as a cost. Each frame of the scan that several views share is counted once."""
        a_frame, axis = dose_scale(self.light)
        unit = "frames" if self.light is None else "photons" if self.light.gray is None else "Gy"
        return TrialCost("dose", "dose", axis, a_frame, lambda outcome: float(outcome.trial.frames), unit)

    @property
    def compared(self) -> tuple[Outcome, ...]:
        """The trials that reconstructed the scan successfully."""
        return tuple(o for o in self.outcomes if o.status == "done")

    @property
    def qualities(self) -> list[float]:
        """dB of each trial in `compared`."""
        return [outcome.quality(self.by) for outcome in self.compared]

    @property
    def quality(self) -> Quality:
        """The measure of quality, with its words."""
        return QUALITIES[self.by]

    @property
    def todo(self) -> list[int]:
        """Numbers of the trials that are not left out."""
        return [n for n, outcome in enumerate(self.outcomes) if not outcome.trial.left_out]

    def costs(self, cost: TrialCost) -> list[float]:
        """The cost of each trial in `compared`."""
        return [cost.of(outcome) for outcome in self.compared]

    def front(self, cost: TrialCost) -> list[int]:
        """Positions in `compared` of the trials on the front of quality and `cost`.

        Costs are compared to 1 %: smaller differences between two trials are chance. A trial that costs more is on the
        front where its gain is above `chance`.
        """
        qualities = self.qualities

        def better(i: int, j: int) -> bool:
            return qualities[i] - qualities[j] > self.chance(i, j)

        return front([rounded(value) for value in self.costs(cost)], qualities, better)

    def chance(self, i: int, j: int) -> float:
        """dB between two trials in `compared` that chance may reach.

        Without a truth: two standard errors of the mean difference of squared residuals over the views held out. The
        noise of a view is in both of its residuals, and so not in their difference.
        """
        squared = [np.asarray(self.compared[k].squared_residuals) for k in (i, j)]
        if not self.quality.of_views or min(each.size for each in squared) < 2 or squared[0].size != squared[1].size:
            return LEAST_GAIN
        apart, level = squared[0] - squared[1], (squared[0].mean() + squared[1].mean()) / 2
        error = apart.std(ddof=1) / math.sqrt(apart.size)
        return max(LEAST_GAIN, _ERRORS * 10 / math.log(10) * float(error / level)) if level > 0 else LEAST_GAIN


def rounded(cost: float) -> float:
    """The cost rounded to steps of 1 %, so that smaller differences count as equal."""
    if not cost > 0 or math.isinf(cost):
        return cost
    step = math.log(1.01)
    return math.exp(round(math.log(cost) / step) * step)


def front(
    costs: Sequence[float], qualities: Sequence[float], better: Callable[[int, int], bool] | None = None
) -> list[int]:
    """Positions of the points that no other point beats, by rising cost (and so by rising quality).

    A point is beaten by one with at most its cost and at least its quality, and better in one of the two. Of equal
    points the first stays. Points with a value that is not finite are left out.

    Args:
        better: whether the quality of the first point is clearly above that of the second, which costs less. Where it
            is not, the second one beats the first. None: by any difference.
    """
    finite = [i for i, pair in enumerate(zip(costs, qualities, strict=True)) if all(map(math.isfinite, pair))]
    kept: list[int] = []
    for i in sorted(finite, key=lambda i: (costs[i], -qualities[i], i)):
        if not kept or (qualities[i] > qualities[kept[-1]] and (better is None or better(i, kept[-1]))):
            kept.append(i)
    return kept
