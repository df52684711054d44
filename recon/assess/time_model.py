"""Quality against time: which method and length a budget takes, and times as text."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from recon.base.choices import Quality
from recon.base.empirical import DEFAULT_STEPS

_MOST_BINNED = 2  # of the measured curves

MODEL_STEPS = 50
"""Of a fit whose volume voxels make. Without: no Gaussians beside such a volume."""


@dataclass(frozen=True)
class QualityCurve:
    """Quality against steps of one kind of reconstruction, measured by tests/bench/test_quality_curves.py.

    Attributes:
        method: its name in `recon.methods`.
        counted: the method's setting that counts its steps; empty for a method without steps.
        binning: of detector pixels.
        share: Gaussians at the start, relative to the default number for the volume; 0 for a method on voxels.
        pace: CPU time of a step. For a fit relative to a step with binning 1 and share 1, for a method on voxels to a
        sweep of FISTA-TV over the same views and voxels.
        sweeps: time beside its steps and the choice of its weight, such as a fit's finish, in such sweeps.
        points: (steps, dB above the FBP of the unbinned views), steps rising.
    """

    method: str
    counted: str
    binning: int
    share: float
    pace: float
    sweeps: float
    points: tuple[tuple[int, float], ...]

    def gain(self, steps: float) -> float:
        """dB above FBP after so many steps, interpolated in their logarithm; -inf below the first point."""
        if steps < self.points[0][0]:
            return -math.inf
        at, gains = zip(*self.points, strict=True)
        return float(np.interp(math.log(steps), np.log(at), gains))

    def fixed(self, speeds: Speeds, further: int = 1) -> float:
        """Time in s that does not depend on the steps, with views binned by a further factor."""
        placed = (speeds.start + speeds.fill) * self.share / further**3
        finished = self.share == 0 or math.isfinite(speeds.sweep)
        sweeps, trials = (self.sweeps * speeds.sweep, speeds.trials) if self.sweeps > 0 and finished else (0.0, 0.0)
        bins = self.binning * further
        return (speeds.fbp + sweeps) / bins**3 + trials / bins**2 + placed  # trials have equally many rows in any case

    def step(self, speeds: Speeds, further: int = 1) -> float:
        """Seconds of a step."""
        if self.share > 0:
            return speeds.step * self.pace / further**2
        return speeds.sweep * self.pace / (self.binning * further) ** 3 if self.pace > 0 else 0.0


# Means of four scans: a slab of a measured walnut (40 rows of 256 pixels, 60 views). A simulated battery of four rays a
# pixel (48 rows of 160 pixels, 90 views, 5000 photons a pixel). The same in half the views with 100 000 photons.
# Simulated spheres (48 rows of 96 pixels, 60 views, 10 000 photons). Fits with a finish of 8 sweeps. A curve begins
# where its method is above FBP on all of them. Binning helps only where FBP of all pixels takes too long.
CURVES: tuple[QualityCurve, ...] = (
    QualityCurve("fbp", "", 1, 0.0, 0.0, 0.0, ((1, 0.0),)),
    QualityCurve("fbp", "", 2, 0.0, 0.0, 0.0, ((1, -3.88),)),
    QualityCurve("r2", "steps", 1, 1.0, 1.0, 16.4, ((125, 7.01), (250, 7.69), (500, 8.18), (1000, 8.32))),
    QualityCurve("r2", "steps", 1, 0.5, 0.67, 16.7, ((125, 6.94), (250, 7.54), (500, 8.09), (1000, 8.19))),
    QualityCurve("r2", "steps", 1, 0.25, 0.46, 13.4, ((125, 6.83), (250, 7.23), (500, 7.65), (1000, 7.86))),
    QualityCurve("r2", "steps", 1, 2.0, 1.63, 20.1, ((125, 7.11), (250, 7.75), (500, 8.25), (1000, 8.37))),
    QualityCurve("r2", "steps", 2, 0.25, 0.46, 21.4, ((125, -1.85), (250, -1.79), (500, -2.03), (1000, -1.91))),
    QualityCurve("fista-tv", "iterations", 1, 0.0, 0.99, 5.7, ((5, 3.92), (10, 6.44), (20, 7.36), (40, 8.06))),
    QualityCurve("fista-tv", "iterations", 2, 0.0, 1.22, 5.0, ((5, -2.36), (10, -1.95), (20, -1.98), (40, -2.0))),
    QualityCurve("os-sirt-tv", "iterations", 1, 0.0, 0.69, 4.9, ((10, 2.62), (20, 5.57), (40, 7.14))),
    QualityCurve("os-sirt-tv", "iterations", 2, 0.0, 0.86, 2.2, ((10, -2.33), (20, -1.8), (40, -1.73))),
)


@dataclass(frozen=True)
class Preset:
    """Settings of a fit for one of the quality levels.

    Attributes:
        share: Gaussians at the start, relative to the default number for the volume.
    """

    steps: int
    share: float


PRESETS: dict[Quality, Preset] = {"preview": Preset(125, 0.5), "standard": Preset(400, 1.0), "best": Preset(1500, 1.0)}


@dataclass(frozen=True)
class Speeds:
    """Times on this machine for this scan, in s, without binning and with the default number of Gaussians.

    Attributes:
        fbp: FBP of the whole volume.
        start: placing the Gaussians, without FBP.
        step: one step of the fit.
        fill: computing the final volume from the Gaussians.
        sweep: a sweep of FISTA-TV over all views; infinite where voxels do not take them.
        trials: the choice of a weight of total variation by views held out; 0 where voxels do not take them.
    """

    fbp: float
    start: float
    step: float
    fill: float
    sweep: float
    trials: float = 0.0


@dataclass(frozen=True)
class Choice:
    """Method and settings chosen for a time budget.

    Attributes:
        method: its name in `recon.methods`.
        counted: its setting that counts `steps`; empty for a method without steps.
        binning: of detector pixels, on top of the selection's.
        share: Gaussians at the start, relative to the default number for the unbinned volume; 0 for none.
        steps: number of steps for which the time suffices.
        gain: expected dB above the FBP of the unbinned views, from the measured curve.
        seconds: expected time.
    """

    method: str
    counted: str
    binning: int
    share: float
    steps: int
    gain: float
    seconds: float

    @property
    def is_gaussian_fit(self) -> bool:
        return self.share > 0

    def settings(self, default_count: int) -> dict[str, int]:
        """Settings of the method, as `recon.methods.build` takes them.

        Args:
            default_count: of Gaussians, for the unbinned volume.
        """
        settings = {self.counted: self.steps} if self.counted else {}
        return settings | ({"gaussians": max(1, round(self.share * default_count))} if self.is_gaussian_fit else {})


def plans(budget: float, speeds: Speeds, largest_binning: int, methods: Collection[str] | None = None) -> list[Choice]:
    """For each method the settings with the best expected quality within `budget` seconds; the best method first.

    Each measured curve gives the quality of a kind of reconstruction after the steps for which the time suffices. A
    method that needs more is left out. If all need more, only the one with the least time is returned, with a gain of
    -inf.

    Args:
        budget: s for everything: FBP, placing, steps, finish and filling the volume.
        methods: names of the methods to consider; None: all with a measured curve.

    Raises:
        ValueError: for a budget that is not positive.
    """
    if not (math.isfinite(budget) and budget > 0):
        raise ValueError(f"a budget is a positive time in s, got {budget}")
    kinds = [
        (curve, further)
        for curve in CURVES
        for further in (1, 2, 4)
        if curve.binning * further <= max(1, largest_binning) and (methods is None or curve.method in methods)
        if further == 1 or curve.binning == _MOST_BINNED
    ]
    best: dict[str, Choice] = {}
    for curve, further in kinds:
        choice = _longest(curve, further, budget, speeds)
        # With equal gains the finer volume, then fewer Gaussians.
        if choice is not None and (curve.method not in best or _rank(choice) > _rank(best[curve.method])):
            best[curve.method] = choice
    if best:
        return sorted(best.values(), key=_rank, reverse=True)
    shortest = [_choice(curve, further, curve.points[0][0], speeds) for curve, further in kinds]
    return [replace(min(shortest, key=lambda c: c.seconds), gain=-math.inf)]


def best_steps(method: str) -> int:
    """Number of steps beyond which no measured curve of this method gains: further steps fit the noise."""
    best = (max(c.points, key=lambda point: point[1])[0] for c in CURVES if c.method == method)
    return max(best, default=DEFAULT_STEPS)


def _longest(curve: QualityCurve, further: int, budget: float, speeds: Speeds) -> Choice | None:
    """The choice of one kind that the time suffices for; None: it does not."""
    left, step = budget - curve.fixed(speeds, further), curve.step(speeds, further)
    first, last = curve.points[0][0], max(curve.points, key=lambda point: point[1])[0]
    if not left >= first * step:
        return None
    # More steps follow the noise, see `best_steps`.
    return _choice(curve, further, int(min(left / step, last)) if step > 0 else last, speeds)


def _choice(curve: QualityCurve, further: int, steps: int, speeds: Speeds) -> Choice:
    # Binning above 2 was not measured: each further factor of 2 is assumed to cost 3 dB, about as much as the first.
    gain = curve.gain(steps) - 3.0 * math.log2(further)
    seconds = curve.fixed(speeds, further) + steps * curve.step(speeds, further)
    share = curve.share / further**3
    return Choice(curve.method, curve.counted, curve.binning * further, share, steps, gain, seconds)


def _rank(choice: Choice) -> tuple[float, float, float]:
    return choice.gain, -choice.binning, -choice.share


def parse_budget(text: str) -> float:
    """Parse "30s", "2m", "1.5h" or a bare number to seconds.

    Raises:
        ValueError: for anything else, and for a time that is not positive and finite.
    """
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number = text.strip()
    unit = units.get(number[-1:].lower())
    try:
        seconds = float(number if unit is None else number[:-1]) * (unit or 1.0)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"{text!r} is not a time: expected a positive number with s, m or h, such as 30s, 2m or 1h")
    return seconds


def duration_text(seconds: float) -> str:
    """A time as text: s, min or h."""
    if seconds < 100:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.3g} min" if seconds < 6000 else f"{seconds / 3600:.3g} h"
