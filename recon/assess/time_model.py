"""Quality against time: the time that the next decibel would take, and times as text."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.assess.plans import CURVES, QualityCurve

_REACH = 10.0  # times the time covered: no extrapolation goes further
_POINTS = 24  # groups of a record: neighbouring values share a running mean, so more groups are not more information


@dataclass(frozen=True)
class NextDecibel:
    """Additional time for which a reconstruction would have to run to gain another dB.

    Attributes:
        seconds: additional time; infinite if no gain is measurable, or needs more than ten times the time so far.
        low, high: range of uncertainty of `seconds`.
        of: the quantity that would gain a dB.
    """

    seconds: float
    low: float
    high: float
    of: Literal["residual", "volume"] = "residual"

    @property
    def measurable(self) -> bool:
        return math.isfinite(self.seconds)


def next_decibel(seconds: ArrayLike, residuals: ArrayLike) -> NextDecibel | None:
    """Extrapolate a fit's record of residual against time by one decibel.

    In the second half of the time -20 log10 of the residual is fitted by a line in log t, which is how fits slow down.
    It is extrapolated to at most ten times the time so far. A longer fit would also lower its learning rates later, so
    the result is a rough estimate.

    Args:
        seconds: since the start of the reconstruction, rising.
        residuals: of the same length; values that are not positive numbers are left out.

    Returns:
        None for a record too short to tell.
    """
    t, q = record(seconds, residuals)
    none = NextDecibel(math.inf, math.inf, math.inf)
    late = t >= 0.5 * t[-1] if t.size else np.zeros(0, bool)
    t, q = t[late], q[late]
    if t.size < 6:
        return None
    groups = np.array_split(np.arange(t.size), min(_POINTS, t.size // 2))
    x = np.array([np.log(t[g]).mean() for g in groups])
    y = np.array([q[g].mean() for g in groups])
    if x.size < 3 or np.ptp(x) == 0:
        return None
    x -= x.mean()
    slope = float(x @ y / (x @ x))  # dB for each factor of e in time
    scatter = y - y.mean() - slope * x
    error = math.sqrt(float(scatter @ scatter) / (x.size - 2) / float(x @ x))
    # The least error of the slope, even for a record of two dozen points without scatter.
    error = max(error, 1e-3 * abs(slope))
    if slope <= 2 * error:
        return none
    end = float(t[-1])
    middle, low, high = (_time_of(end, s) for s in (slope, slope + 2 * error, slope - 2 * error))
    return NextDecibel(middle, low, high) if math.isfinite(middle) else none


def next_decibel_of_fit(seconds: float, steps: int) -> NextDecibel:
    """Additional time for a fit to gain a dB, from the quality of fits of other lengths (`CURVES`).

    A fit's own record does not tell. Much of its last gain comes from the falling learning rates, and a longer fit has
    that gain only once. The curves are means over four scans; `low` and `high` are the best and the worst of
    the curves for different numbers of Gaussians. Beyond its last point a curve is extrapolated with its last slope, to
    at most four times its steps.

    Args:
        seconds: time that the fit took.
        steps: number of its steps, over which the learning rates fell.
    """
    factors = sorted(_further(curve, steps) for curve in CURVES if curve.binning == 1 and curve.share > 0)
    low, middle, high = (seconds * (factor - 1) for factor in (factors[0], factors[len(factors) // 2], factors[-1]))
    return NextDecibel(middle, low, high, "volume")


def _further(curve: QualityCurve, steps: int) -> float:
    """Factor on the steps that gains a dB; inf if it is above ten."""
    steps = max(steps, curve.points[0][0])
    (before, gain), (last, most) = curve.points[-2:]
    slope = max(0.0, (most - gain) / math.log(last / before))
    at = np.geomspace(steps, max(4 * last, steps), 400)
    gains = np.array([curve.gain(k) for k in at]) + slope * np.log(np.maximum(at / last, 1))
    enough = np.flatnonzero(gains >= gains[0] + 1)
    return float(at[enough[0]] / steps) if enough.size and at[enough[0]] <= _REACH * steps else math.inf


def _time_of(end: float, slope: float) -> float:
    if slope <= 1 / math.log(_REACH):
        return math.inf
    return end * math.expm1(1 / slope)


def record(seconds: ArrayLike, residuals: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(s, -20 log10 of the residual) for the valid entries of a fit's record."""
    t, r = np.asarray(seconds, np.float64), np.asarray(residuals, np.float64)
    known = np.isfinite(t) & (t > 0) & np.isfinite(r) & (r > 0)
    return t[known], -20 * np.log10(r[known])


def parse_budget(text: str) -> float:
    """Seconds of "30s", "2m", "1.5h" or a bare number of seconds.

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
