"""Chooses the candidate, or the strength of a prior, that predicts held-out projections best.

Candidates are compared projection by projection, because projections differ more than candidates do. The choice is the
simplest candidate that no other one clearly beats. For strengths, the choice is the one with the smallest mean
residual.
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
"""Share by which a costlier candidate must lower the residual to be chosen.

(On a scan of a tooth, a fit lowers the residual by 1.3 % and takes four times as long.)
"""

_CERTAIN_SHARE, _CERTAIN_ERRORS, _CERTAIN_VIEWS = 0.25, 4.0, 5
"""A candidate that costs little more than the chosen one replaces it for a small but certain gain: for this share of
`LEAST_GAIN`, if the gain exceeds this number of standard errors, with at least this number of held-out projections.

(PnP-DCT instead of total variation, see docs/decisions/voxels.md. A standard error of two or three projections says
little.)

Discrete levels end the tests of such candidates only if the gain of the levels exceeds the same number of standard
errors. (The gain of levels that are wrong differs from projection to projection, see docs/decisions/voxels.md.)
"""

# name of the measure in the explanation of a choice
MEASURE = "root mean square residual in held-out projections, as line integrals"
_ERRORS = 1.0  # standard errors of the difference; below it, two candidates count as equally good
# largest number of octaves from the first strength: cones with coarse voxels need 6 to 9, and 40 change nothing
_OCTAVES = 10
TRIALS = 4
"""Usual number of tests to choose a strength (3 to 6 on five scans).

Some use fewer columns, see `columns_of_matter`.
"""
MOST_TRIALS = (2 + _OCTAVES) / TRIALS
"""Largest number of iterations of all tests, divided by the usual number."""


def exceeds_standard_error(improvements: F64, errors: float) -> bool:
    """Whether the mean gain [held-out view] exceeds `errors` of its standard errors.

    False if a gain is not finite because a candidate was stopped or diverged.
    """
    return bool(np.isfinite(improvements).all()) and float(improvements.mean()) > errors * _standard_error(improvements)


def _standard_error(improvements: F64) -> float:
    """Standard error of the mean gain [held-out view]; 0 for a single projection."""
    return float(improvements.std(ddof=1)) / math.sqrt(improvements.size) if improvements.size > 1 else 0.0


def predicts_as_well(residuals: F64, best: F64) -> bool:
    """Whether residuals [held-out view] exceed those of the best candidate by no more than chance."""
    return not exceeds_standard_error(residuals - best, _ERRORS)


def significantly_better(residuals: F64, reference_residuals: F64, least_gain: float, errors: float = _ERRORS) -> bool:
    """Whether residuals [held-out view] are lower than others by the share `least_gain` and by `errors` standard errors
    of the difference."""
    by_more = float(residuals.mean()) < (1 - least_gain) * float(reference_residuals.mean())
    return by_more and exceeds_standard_error(reference_residuals - residuals, errors)


class Prediction(NamedTuple):
    """The residuals of a candidate's volume in the held-out projections.

    Attributes:
        name: name of the candidate.
        residuals: [held-out view] root mean square, as line integrals; None: the candidate was not tried.
        prior: the prior of the candidate's volume, which is used again for the volume from all projections. None: the
            candidate has no prior, or chooses it again.
        remark: the reason why the candidate was not tried or was stopped early; may be empty.
        costs_little: whether the candidate takes at most about three times as long as total variation. Then a small but
            certain gain over a candidate with a prior and without discrete levels suffices.
    """

    name: str
    residuals: Sequence[float] | None = None
    prior: Prior | None = None
    remark: str = ""
    costs_little: bool = False

    @property
    def has_levels(self) -> bool:
        """Whether the candidate's volume is pulled to discrete levels."""
        return self.prior is not None and self.prior.materials is not None and bool(self.prior.materials.levels)


class TrialChoice(NamedTuple):
    """Which of the candidates tried so far predicts held-out projections best.

    Attributes:
        part_of_scan: the part of the scan that was used; if no candidate was tried, the reason.
        least_gain: see `LEAST_GAIN`.
        predictions: predictions of the candidates, the simplest first.
    """

    part_of_scan: str
    least_gain: float = LEAST_GAIN
    predictions: tuple[Prediction, ...] = ()

    @classmethod
    def of(cls, values: Sequence[Any]) -> TrialChoice:
        """Convert a choice, or its values from a file (see `Decisions`), to a choice."""
        part_of_scan, least_gain, predictions = values
        made = [Prediction(*each) for each in predictions]
        return cls(
            part_of_scan, least_gain, tuple(each._replace(prior=each.prior and Prior.of(each.prior)) for each in made)
        )

    def after(self, prediction: Prediction) -> TrialChoice:
        """The choice with one more candidate."""
        return self._replace(predictions=(*self.predictions, prediction))

    @property
    def residuals_by_number(self) -> dict[int, F64]:
        """Residuals [held-out view] of the candidates that were tried, by number.

        A candidate whose residual is not finite was stopped or diverged, and counts as not tried.
        """
        measured = {
            number: each.residuals for number, each in enumerate(self.predictions) if each.residuals is not None
        }
        return {number: np.asarray(residuals) for number, residuals in measured.items() if np.isfinite(residuals).all()}

    @property
    def best(self) -> int | None:
        """Number of the candidate with the smallest mean residual; None: no candidate was tried."""
        residuals = self.residuals_by_number
        return min(residuals, key=lambda number: float(residuals[number].mean()), default=None)

    @property
    def best_residuals(self) -> F64 | None:
        """The residuals of the best candidate; None: no candidate was tried."""
        return None if self.best is None else self.residuals_by_number[self.best]

    @property
    def with_levels(self) -> int | None:
        """Number of the candidate whose discrete levels passed all their tests; None: there is none."""
        return next((number for number in self.residuals_by_number if self.predictions[number].has_levels), None)

    def levels_suffice(self, *, costs_little: bool = False) -> bool:
        """Whether discrete levels lower the residuals of all simpler candidates by `least_gain`, so that further
        candidates need not be tried, which do not use levels.

        Args:
            costs_little: True for a further candidate that costs little: the gain of the levels must also be certain.
        """
        errors = _CERTAIN_ERRORS if costs_little else _ERRORS
        return self.with_levels is not None and self._gains(self.with_levels, errors)

    def _gains(self, number: int, errors: float) -> bool:
        """Whether a candidate lowers the residuals of all candidates simpler than levels by `least_gain`, and by
        `errors` standard errors."""
        residuals = self.residuals_by_number
        return all(
            significantly_better(residuals[number], residuals[simpler], self.least_gain, errors)
            for simpler in self._simpler_than_levels
        )

    @property
    def _simpler_than_levels(self) -> list[int]:
        """Numbers of the candidates that were tried before discrete levels."""
        return [number for number in self.residuals_by_number if self.with_levels is None or number < self.with_levels]

    @property
    def chosen(self) -> int | None:
        """Number of the simplest candidate that no other one clearly beats; None: none was tried.

        A candidate whose discrete levels passed all their tests takes the place of a simpler one, even if it lowers the
        residual by less than `least_gain`. (At 10³ photons noise is most of the residual: the levels of cracks from 90
        projections lower it by 1.6 %, and the volume is 0.8 dB better.) It does not take the place of one with a
        smaller residual. (A shell from 30 projections with 500 photons: patches are 0.6 dB better than levels, which
        lower the residual by 1 %.)

        A candidate that costs little takes the place of levels if its gain is certain and that of the levels is not.
        (Bone from 32 projections: levels lower the residual by 18 %, which is 2.7 standard errors, and patches by 5 %,
        which is 7.7; the volume with patches is 1.4 dB better.)
        """
        residuals, levels = self.residuals_by_number, self.with_levels
        if not residuals:
            return None
        if levels is None:
            return self._simplest_of(residuals)
        other = self._simplest_of(self._without_levels)
        if self.levels_suffice():
            return other if self._is_more_certain(other) else self._simplest_of(residuals)
        return levels if residuals[levels].mean() < residuals[other].mean() else other

    def _is_more_certain(self, number: int) -> bool:
        """Whether a candidate that costs little has a certain gain, and the levels have not."""
        certain = self.predictions[number].costs_little and self._gains(number, _CERTAIN_ERRORS)
        return certain and not self.levels_suffice(costs_little=True)

    @property
    def _without_levels(self) -> dict[int, F64]:
        """`residuals_by_number` of the candidates without discrete levels."""
        return {number: each for number, each in self.residuals_by_number.items() if number != self.with_levels}

    def _simplest_of(self, residuals: dict[int, F64]) -> int:
        """Number of the first of these candidates that the best does not clearly beat, or of the one that replaces it
        for a small but certain gain."""
        simplest = self._first_unbeaten(residuals)
        return next(
            (
                number
                for number, each in residuals.items()
                if self._may_be_certain(number, simplest)
                and significantly_better(each, residuals[simplest], _CERTAIN_SHARE * self.least_gain, _CERTAIN_ERRORS)
            ),
            simplest,
        )

    def _may_be_certain(self, better: int, simpler: int) -> bool:
        """Whether a small but certain gain suffices for one candidate to replace another.

        The other one has a prior, because FBP, which has none, takes much less time. It has no discrete levels.
        (Levels are better by 1.2 dB for a cathode from 90 projections, where the residual of patches is 1.5 % smaller.)
        """
        enough_views, other = self.residuals_by_number[better].size >= _CERTAIN_VIEWS, self.predictions[simpler]
        return (
            enough_views and self.predictions[better].costs_little and other.prior is not None and not other.has_levels
        )

    def _first_unbeaten(self, residuals: dict[int, F64]) -> int:
        """Number of the first of these candidates that the best of them does not beat by `least_gain`."""
        best = min(residuals.values(), key=lambda each: float(each.mean()))
        return next(
            number for number, each in residuals.items() if not significantly_better(best, each, self.least_gain)
        )

    @property
    def verdicts(self) -> list[str]:
        """For each candidate "best", or "alike" if it predicts equally well within chance, or "".

        All are empty if the best candidate does not lower any other residual by `least_gain`."""
        residuals, best_residuals, words = self.residuals_by_number, self.best_residuals, [""] * len(self.predictions)
        if best_residuals is None or all(
            (1 - self.least_gain) * each.mean() <= best_residuals.mean() for each in residuals.values()
        ):
            return words
        for number, each in residuals.items():
            words[number] = "best" if number == self.best else "alike" * predicts_as_well(each, best_residuals)
        return words

    @property
    def prior(self) -> Prior | None:
        """The prior of the chosen candidate."""
        return None if self.chosen is None else self.predictions[self.chosen].prior

    def with_prior(self, prior: Prior) -> TrialChoice:
        """The choice with another prior of the chosen candidate."""
        assert self.chosen is not None
        predictions = list(self.predictions)
        predictions[self.chosen] = predictions[self.chosen]._replace(prior=prior)
        return self._replace(predictions=tuple(predictions))

    @property
    def reason(self) -> str:
        """The part of the scan, all residuals, the remarks, and why a simpler candidate than the best was chosen.

        These residuals are those of weighted rays. The data residual in reports is something else: a share of the norm
        of the projections.
        """
        if self.chosen is None:
            return self.part_of_scan
        means = [(each.name, np.mean(each.residuals)) for each in self.predictions if each.residuals is not None]
        listed = [f"{name} {mean:#.4g}" for name, mean in means]
        remarks = [each.remark for each in self.predictions if each.remark]
        sentences = "; ".join([*listed, *remarks])
        return f"test reconstructions of {self.part_of_scan}, {MEASURE}: {sentences}{self._certain}{self._of_the_best}"

    @property
    def _certain(self) -> str:
        """That the chosen candidate replaced a simpler one for a small but certain gain; empty if it did not."""
        if self.chosen is None or not self.predictions[self.chosen].costs_little:
            return ""
        simplest = self._first_unbeaten(self._without_levels)
        if simplest >= self.chosen:
            return ""
        return (
            f". {self._gain(self.chosen, simplest)}. Here a gain below {self.least_gain:.0%} suffices, because the "
            f"gain exceeds {_CERTAIN_ERRORS:.0f} standard errors and {self.predictions[self.chosen].name} costs little"
        )

    def _gain(self, better: int, worse: int) -> str:
        """Sentence on how much smaller the residual of one candidate is."""
        ours, theirs = self.residuals_by_number[better], self.residuals_by_number[worse]
        improvement, error = (
            value / theirs.mean() for value in ((theirs - ours).mean(), _standard_error(theirs - ours))
        )
        return (
            f"The residual of {self.predictions[better].name} is {improvement:.2%} smaller than the residual of "
            f"{self.predictions[worse].name} (standard error {error:.2%})"
        )

    @property
    def _of_the_best(self) -> str:
        """By how much the best candidate is better than the chosen one, and why it was not chosen; empty if it was."""
        if self.chosen is None or self.best is None or self.chosen == self.best:
            return ""
        if self.chosen > self.best:
            simpler = min(self._simpler_than_levels, key=lambda number: float(self.residuals_by_number[number].mean()))
            return (
                f". {self._gain(self.best, simpler)}. {self._gain(self.chosen, simpler)}. "
                f"{self.predictions[self.chosen].name} was chosen, because only its gain exceeds {_CERTAIN_ERRORS:.0f} "
                "standard errors"
            )
        margin = f"{self.least_gain:.0%} and by more than " if self.least_gain else "more than "
        certain = (
            f", or by {_CERTAIN_SHARE * self.least_gain:.1%} and by more than {_CERTAIN_ERRORS:.0f} standard errors"
            if self.least_gain and self._may_be_certain(self.best, self.chosen)
            else ""
        )
        return (
            f". {self._gain(self.best, self.chosen)}. {self.predictions[self.chosen].name} was chosen, because it is "
            f"simpler: a costlier method is chosen only if its residual is smaller by {margin}one standard "
            f"error{certain}"
        )


@dataclass(frozen=True, eq=False)
class BestStrength:
    """The strength of a prior that predicts held-out projections best, and its residuals [view]."""

    strength: float
    residuals: F64


def preferred_strength(residuals_of: Callable[[float], F64], first: float) -> BestStrength | None:
    """The strength of a prior with the smallest residual, searched in octaves from `first`.

    No strength is simpler or cheaper than another one, so the standard error plays no role. (The strongest prior within
    one standard error of the smallest residual is an octave or two higher: one octave costs a teapot refined from a fit
    1.1 dB.) The search goes to stronger priors as long as they do not predict worse by more than chance, otherwise to
    weaker ones as long as these predict better. The result is the vertex of the parabola through the best strength and
    its neighbours. (With whole octaves, fibres with texture lose 0.5 dB.)

    Returns:
        None if a residual is infinite, because the tests were stopped.
    """
    residuals: dict[int, F64] = {}

    def mean(octave: int) -> float:
        if octave not in residuals:
            residuals[octave] = residuals_of(first * 2.0**octave)
        return float(residuals[octave].mean())

    if math.isinf(mean(1)) or math.isinf(mean(0)):
        return None
    stronger_first = not exceeds_standard_error(residuals[1] - residuals[0], _ERRORS)
    tested_octave, direction = (1, 1) if stronger_first else (0, -1)
    while abs(tested_octave + direction) <= _OCTAVES:
        if math.isinf(mean(tested_octave + direction)):
            return None
        if exceeds_standard_error(
            residuals[tested_octave + direction] - residuals[tested_octave], _ERRORS if stronger_first else 0.0
        ):
            break
        tested_octave += direction
    octave = min(residuals, key=mean)
    vertex = float(octave)
    if octave - 1 in residuals and octave + 1 in residuals:
        weaker, stronger = mean(octave - 1) - mean(octave), mean(octave + 1) - mean(octave)
        vertex += (weaker - stronger) / (2 * (weaker + stronger)) if weaker + stronger > 0 else 0.0
    return BestStrength(first * 2.0**vertex, residuals[octave])
