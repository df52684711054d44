"""Table of a trade-off: all its trials with what became of them, and which of them are on the front of a cost."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from beamline.tradeoff import pareto
from beamline.tradeoff.trials import Outcome


@dataclass(frozen=True)
class Table:
    """All trials of a trade-off and what they were made on.

    Attributes:
        outcomes: in the order of the plan.
        by: what quality means: "psnr" or "residual_held_out", as dB either way.
        length_unit: of the resolution, "mm" or "px".
        machine: of `beamline.core.machine.machine`.
        scan: facts for people, by name.
        command: that repeats it.
        stopped: somebody ended it before all trials were done.
    """

    outcomes: tuple[Outcome, ...]
    by: str
    length_unit: str
    machine: Mapping[str, str | int]
    scan: Mapping[str, str]
    command: str
    stopped: bool = False

    def with_outcome(self, index: int, outcome: Outcome) -> Table:
        return replace(self, outcomes=(*self.outcomes[:index], outcome, *self.outcomes[index + 1 :]))

    @property
    def n_done(self) -> int:
        return sum(outcome.status == "done" for outcome in self.outcomes)

    @property
    def compared(self) -> tuple[Outcome, ...]:
        """The trials that reconstruct the scan and did it."""
        return tuple(o for o in self.outcomes if o.status == "done" and o.trial.group != "precision")

    @property
    def qualities(self) -> list[float]:
        """dB of each trial in `compared`."""
        return [outcome.quality(self.by) for outcome in self.compared]

    @property
    def quality_name(self) -> str:
        return "PSNR" if self.by == "psnr" else "−20 log₁₀ of the held-out residual"

    def front(self, cost: str) -> list[int]:
        """Positions in `compared` that are on the front of `cost`: "seconds" or "memory".

        Costs to 1 %: below that it is chance which of two trials was the cheaper one.
        """
        return pareto.front([pareto.rounded(value) for value in self.costs(cost)], self.qualities)

    def costs(self, cost: str) -> list[float]:
        if cost == "seconds":
            return [outcome.seconds for outcome in self.compared]
        return [math.nan if o.peak_bytes is None else float(o.peak_bytes) for o in self.compared]

    def told(self, outcome: Outcome) -> dict[str, Any]:
        """One trial, for an event; `gaussians` are those at its start, as in its settings."""
        return {
            **asdict(outcome.trial),
            "label": outcome.trial.label,
            "status": outcome.status,
            "seconds": outcome.seconds,
            "cpu_seconds": outcome.cpu_seconds,
            "gaussians_end": outcome.gaussians,
            "peak_bytes": outcome.peak_bytes,
            "quality_db": outcome.quality(self.by),
            "message": outcome.message,
            **outcome.metrics,
            **outcome.details,
        }
