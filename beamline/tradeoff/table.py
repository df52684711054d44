"""All trials of a trade-off with their outcomes, and which of them are on the Pareto front of a cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from beamline.core.events import TrialDone
from beamline.tradeoff import pareto
from beamline.tradeoff.trials import Outcome


@dataclass(frozen=True)
class TrialCost:
    """A cost of a trial, and how a picture shows it.

    Attributes:
        name: in file names; `words`: in titles and captions.
        axis: label with its unit; `scale`: from the value to that unit.
        of: the cost of an outcome; NaN where it is not known.
    """

    name: str
    words: str
    axis: str
    scale: float
    of: Callable[[Outcome], float]


TIME = TrialCost("seconds", "time", "time (s)", 1.0, lambda outcome: outcome.seconds)
MEMORY = TrialCost(
    "memory", "memory", "peak memory of the process (MB)", 1e-6,
    lambda outcome: math.nan if outcome.peak_bytes is None else float(outcome.peak_bytes),
)  # fmt: skip


@dataclass(frozen=True)
class TrialTable:
    """All trials of a trade-off, with the scan and the machine that they ran on.

    Attributes:
        outcomes: in the order of the plan.
        by: the measure of quality: "psnr" or "residual_held_out", both as dB.
        length_unit: of the resolution, "mm" or "px".
        scan: facts for people, by name.
        stopped: it was interrupted before all trials were done.
    """

    outcomes: tuple[Outcome, ...]
    by: str
    length_unit: str
    machine: Mapping[str, str | int]
    scan: Mapping[str, str]
    command: str
    stopped: bool = False

    def with_outcome(self, index: int, outcome: Outcome) -> TrialTable:
        return replace(self, outcomes=(*self.outcomes[:index], outcome, *self.outcomes[index + 1 :]))

    @property
    def n_done(self) -> int:
        return sum(outcome.status == "done" for outcome in self.outcomes)

    @property
    def compared(self) -> tuple[Outcome, ...]:
        """The trials that reconstructed the scan successfully."""
        return tuple(o for o in self.outcomes if o.status == "done")

    @property
    def qualities(self) -> list[float]:
        """dB of each trial in `compared`."""
        return [outcome.quality(self.by) for outcome in self.compared]

    @property
    def quality_name(self) -> str:
        return "PSNR" if self.by == "psnr" else "−20 log₁₀ of the held-out residual"

    def costs(self, cost: TrialCost) -> list[float]:
        """The cost of each trial in `compared`."""
        return [cost.of(outcome) for outcome in self.compared]

    def front(self, cost: TrialCost) -> list[int]:
        """Positions in `compared` of the trials on the front of quality and `cost`.

        Costs are compared to 1 %: smaller differences between two trials are chance.
        """
        return pareto.front([pareto.rounded(value) for value in self.costs(cost)], self.qualities)

    def event(self, index: int, outcome: Outcome) -> TrialDone:
        """The trial of this index, as an event; `gaussians` are those at its start, as in its settings."""
        figures = outcome.trial.as_record() | {
            "cpu_seconds": outcome.cpu_seconds, "gaussians_end": outcome.gaussians, **outcome.metrics
        }  # fmt: skip
        said = figures.pop("label"), outcome.status, outcome.seconds, outcome.message, outcome.quality(self.by)
        return TrialDone(index + 1, len(self.outcomes), *said, outcome.peak_bytes, figures)
