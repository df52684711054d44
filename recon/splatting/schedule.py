"""Schedule: how far a fit has come towards its last rates, by steps or a clock, and how many steps it takes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.base.choices import DEFAULT_STEPS as DEFAULT_STEPS
from recon.base.choices import SHORT_STEPS as SHORT_STEPS
from recon.splatting.finish import FinishTrial
from recon.splatting.optimise import FitState
from recon.splatting.problem import FitProblem

# At this step fits of 500 photons a pixel leave 1.2 to 1.4 times the noise. Those of 1000 to 50 000 photons leave 2.0
# to 7 times (eighteen slabs of seven samples). At 1.7 to 1.9 a disc with cracks loses 0.4 to 0.9 dB in the short fit,
# at 1.3 0.1 dB (docs/notes/exploration.md).
_LOOKED_AT, _NEAR_NOISE = 100, 1.5

TRIAL_AT = 50
"""Step at which a trial tells whether further steps gain anything, see `finish.try_finish`."""
ENDED_AT = 100  # where they do not; after 50 in all a thorax of 90 views loses 0.14 dB, after 100 nothing


@dataclass(eq=False)
class Schedule:
    """The length of a fit.

    Attributes:
        steps: end the fit; None: only `seconds` end it.
        seconds: end it, too.
        by_content: after 100 steps it may be shortened, see `look`.
        bend: step and fraction after which the fraction rises evenly to 1.
        trial: of the finish at `TRIAL_AT`; None: it was not made, or could hold out no views.
    """

    steps: int | None
    seconds: float | None = None
    by_content: bool = False
    bend: tuple[int, float] = (0, 0.0)
    trial: FinishTrial | None = None

    @classmethod
    def resumed(cls, planned: Schedule, checkpoint: Mapping[str, NDArray[Any]]) -> Schedule:
        """The schedule of a checkpoint; the planned one if it holds none. ValueError: it is none."""
        if not planned.by_content or "schedule" not in checkpoint:
            return planned
        steps, at, fraction = _three(checkpoint, "schedule")
        trial = FinishTrial.of(_three(checkpoint, "trial")) if "trial" in checkpoint else None
        return cls(int(steps), planned.seconds, planned.by_content, (int(at), float(fraction)), trial)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its arrays in a checkpoint."""
        if not self.by_content:
            return {}
        trial = {} if self.trial is None else {"trial": np.array(self.trial, np.float64)}
        return {"schedule": np.array([self.steps or 0, *self.bend]), **trial}

    def fraction(self, step: int, spent: float) -> float:
        """How far the fit has come after so many steps and seconds, 0..1."""
        at, before = self.bend
        by_steps = before + (1 - before) * (step - at) / (self.steps - at) if self.steps else 0.0
        return min(1.0, max(by_steps, spent / self.seconds if self.seconds else 0.0))

    def least(self, step: int, tried: bool) -> int:
        """Steps after which the data may yet end the fit, `tried` by a trial of the finish; 0: they cannot."""
        if not (self.by_content and self.steps and step < _LOOKED_AT):
            return 0
        least = ENDED_AT if tried and step <= TRIAL_AT and self.trial is None else SHORT_STEPS
        return least if least < self.steps else 0

    def look(self, state: FitState, problem: FitProblem) -> None:
        """Shorten the fit if its residual after 100 steps is near the noise of the views."""
        if not (self.by_content and state.step == _LOOKED_AT and self.steps and self.steps > SHORT_STEPS):
            return
        if residual_over_noise(state, problem) < _NEAR_NOISE:
            self._shorten(state.step, SHORT_STEPS)

    def after_trial(self, trial: FinishTrial | None, step: int) -> None:
        """Keep the trial, and shorten the fit where further steps gain nothing."""
        self.trial = trial
        if trial is not None and trial.sweeps:
            self._shorten(step, ENDED_AT)

    def _shorten(self, step: int, steps: int) -> None:
        self.bend, self.steps = (step, self.fraction(step, 0.0)), steps


def _three(checkpoint: Mapping[str, NDArray[Any]], name: str) -> tuple[float, float, float]:
    values = np.asarray(checkpoint[name], np.float64)
    if values.shape != (3,) or not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError(f"{name} of the checkpoint is {values.tolist()}, expected three numbers of 0 or more")
    return float(values[0]), float(values[1]), float(values[2])


def residual_over_noise(state: FitState, problem: FitProblem) -> float:
    """Root mean square residual of the last steps' views, over the noise of a pixel."""
    squares = [float(np.mean(np.square(problem.backend.numpy(image)))) for image in problem.images]
    return float(state.residual) * math.sqrt(float(np.mean(squares))) / problem.noise
