"""Choice: which of some candidates predicts views held out, and the strength of a prior that predicts them best.

Candidates are compared view by view, since views differ more than candidates do: the simplest is taken that the best
does not beat by more than one standard error. Of strengths the one of the least mean residual is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from recon.base.arrays import F64
from recon.base.decisions import Prior

LEAST_GAIN = 0.02
"""Share by which a costlier candidate must lower a residual. A fit of a tooth lowers it by 1.3 %, in four times the
time."""

_MEASURE = "root mean square residual in held-out projections, as line integrals"  # by which a choice is explained
_ERRORS = 1.0  # standard errors of the difference, up to which two candidates predict alike
_OCTAVES = 10  # from the first strength, at most: cones of coarse voxels take 6 to 9, and 40 change nothing
TRIALS = 4
"""Trials of a strength, as a rule: 3 to 6 on five scans, some of fewer columns, see `columns_of_matter`."""
MOST_TRIALS = (2 + _OCTAVES) / TRIALS
"""The most sweeps of trials, over those as a rule."""


def exceeds_standard_error(gains: F64, errors: float) -> bool:
    """Whether the mean gain [view held out] exceeds `errors` of its standard errors. False: a gain is not finite, as a
    candidate was ended, or diverged."""
    return bool(np.isfinite(gains).all()) and float(gains.mean()) > errors * _standard_error(gains)


def _standard_error(gains: F64) -> float:
    """Of the mean gain [view held out]; 0 of one view."""
    return float(gains.std(ddof=1)) / math.sqrt(gains.size) if gains.size > 1 else 0.0


def predicts_as_well(residuals: F64, best: F64) -> bool:
    """Whether residuals [view held out] exceed those of the best by no more than chance."""
    return not exceeds_standard_error(residuals - best, _ERRORS)


def significantly_better(residuals: F64, other: F64, least_gain: float) -> bool:
    """Whether residuals [view held out] are below another candidate's, beyond chance and by the share `least_gain`."""
    by_more = float(residuals.mean()) < (1 - least_gain) * float(other.mean())
    return by_more and exceeds_standard_error(other - residuals, _ERRORS)


class Prediction(NamedTuple):
    """What the volume of a candidate leaves of the views held out.

    Attributes:
        name: of the candidate.
        residuals: [view held out] root mean square, in line integrals; None: it was not tried.
        prior: that its volume had, and has again of all views; None: it has none, or it is chosen anew.
        remark: why it was not tried, or not to its end; may be empty.
    """

    name: str
    residuals: Sequence[float] | None = None
    prior: Prior | None = None
    remark: str = ""


class TrialChoice(NamedTuple):
    """Which candidate predicts views held out, of those tried so far.

    Attributes:
        where: the part of the scan that was tried; where no candidate was, the reason.
        least_gain: see `LEAST_GAIN`.
        predictions: of the candidates, the simplest first.
    """

    where: str
    least_gain: float = LEAST_GAIN
    predictions: tuple[Prediction, ...] = ()

    @classmethod
    def of(cls, values: Sequence[Any]) -> TrialChoice:
        """A choice, or its values from a file, as `Decisions` keeps it."""
        where, least_gain, predictions = values
        named = ((name, left, prior and Prior.of(prior), remark) for name, left, prior, remark in predictions)
        return cls(where, least_gain, tuple(Prediction(*each) for each in named))

    def after(self, prediction: Prediction) -> TrialChoice:
        """The choice with one candidate more."""
        return self._replace(predictions=(*self.predictions, prediction))

    @property
    def tried(self) -> dict[int, F64]:
        """Residuals [view held out] of the candidates that were tried, by number.

        One with a residual that is not finite was ended, or diverged, and counts as not tried.
        """
        given = {at: each.residuals for at, each in enumerate(self.predictions) if each.residuals is not None}
        return {at: np.asarray(left) for at, left in given.items() if np.isfinite(left).all()}

    @property
    def best(self) -> int | None:
        """Number of the candidate of least mean residual; None: none was tried."""
        tried = self.tried
        return min(tried, key=lambda at: float(tried[at].mean()), default=None)

    @property
    def least(self) -> F64 | None:
        """The residuals of the least mean; None: none was tried."""
        return None if self.best is None else self.tried[self.best]

    @property
    def few_materials(self) -> bool:
        """Whether few materials predict views held out better than total variation: costlier candidates, which know of
        no levels, are then not tried, to save the time."""
        return any(each.prior and each.prior.materials and each.prior.materials.levels for each in self.predictions)

    @property
    def at(self) -> int | None:
        """Number of the first candidate, and so the simplest, that the best does not beat; None: none was tried."""
        if (least := self.least) is None:
            return None
        return next(at for at, each in self.tried.items() if not significantly_better(least, each, self.least_gain))

    @property
    def verdicts(self) -> list[str]:
        """[candidate] "best"; "alike", which predicts as well but for chance; or empty. All are empty where the best
        lowers the residual of no other one by `least_gain`."""
        tried, least, words = self.tried, self.least, [""] * len(self.predictions)
        if least is None or all((1 - self.least_gain) * each.mean() <= least.mean() for each in tried.values()):
            return words
        for at, each in tried.items():
            words[at] = "best" if at == self.best else "alike" * predicts_as_well(each, least)
        return words

    @property
    def prior(self) -> Prior | None:
        """The prior of the candidate chosen."""
        return None if self.at is None else self.predictions[self.at].prior

    @property
    def reason(self) -> str:
        """Where it was tried, with all residuals (of weighed rays; the data residual is a share of the views), remarks,
        and why a simpler candidate than the best is taken."""
        if self.at is None:
            return self.where
        given = [(each.name, np.mean(each.residuals)) for each in self.predictions if each.residuals is not None]
        listed = [f"{name} {mean:#.4g}" for name, mean in given]
        remarks = [each.remark for each in self.predictions if each.remark]
        return f"test reconstructions of {self.where}, {_MEASURE}: {'; '.join([*listed, *remarks])}{self._of_the_best}"

    @property
    def _of_the_best(self) -> str:
        """By how much the best is better than a simpler one that is taken; empty where the best is taken."""
        if self.at is None or self.best is None or self.at == self.best:
            return ""
        (simple, of_simple), (best, of_best) = (
            (self.predictions[at].name, self.tried[at]) for at in (self.at, self.best)
        )
        improvement, error = (
            (of_simple - of_best).mean() / of_simple.mean(),
            _standard_error(of_simple - of_best) / of_simple.mean(),
        )
        margin = f"{self.least_gain:.0%} and by more than " if self.least_gain else "more than "
        return (
            f". The residual of {best} is {improvement:.2%} smaller than that of {simple} "
            f"(standard error {error:.2%}). "
            f"{simple} was chosen, because it is simpler: the residual of a costlier method must be smaller by "
            f"{margin}one standard error"
        )


@dataclass(frozen=True, eq=False)
class BestStrength:
    """The best strength of a prior by held-out views, and the least residual [view] in its search."""

    strength: float
    residuals: F64


def preferred_strength(residuals_of: Callable[[float], F64], first: float) -> BestStrength | None:
    """The strength of a prior whose residual is least, searched in octaves from `first`.

    No strength is simpler or cheaper than another, so that chance is no reason for one. (The strongest within one
    standard error of the least is an octave or two above it: a teapot refined from a fit loses 1.1 dB by one.) The
    search goes to stronger priors as long as they predict no worse beyond chance, else to weaker ones, as long as these
    predict better. The vertex of the parabola through the least and its neighbours is taken (whole octaves lose 0.5 dB
    on fibres with texture).

    Returns:
        None: a residual is infinite, since the trials were ended.
    """
    tried: dict[int, F64] = {}

    def mean(octave: int) -> float:
        if octave not in tried:
            tried[octave] = residuals_of(first * 2.0**octave)
        return float(tried[octave].mean())

    if math.isinf(mean(1)) or math.isinf(mean(0)):
        return None
    up = not exceeds_standard_error(tried[1] - tried[0], _ERRORS)
    at, towards = (1, 1) if up else (0, -1)
    while abs(at + towards) <= _OCTAVES:
        if math.isinf(mean(at + towards)):
            return None
        if exceeds_standard_error(tried[at + towards] - tried[at], _ERRORS if up else 0.0):
            break
        at += towards
    octave = min(tried, key=mean)
    vertex = float(octave)
    if octave - 1 in tried and octave + 1 in tried:
        weaker, stronger = mean(octave - 1) - mean(octave), mean(octave + 1) - mean(octave)
        vertex += (weaker - stronger) / (2 * (weaker + stronger)) if weaker + stronger > 0 else 0.0
    return BestStrength(first * 2.0**vertex, tried[octave])
