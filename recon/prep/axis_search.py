"""The search of a rotation axis among candidates: the estimate, the rows that are looked at, and its optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Search = tuple[float, float] | None

MOST_ROWS = 16  # Rows that are enough for 0.1 px
FEWEST_COLS = 8  # Columns that an axis can be found from
FEWEST_BANDS = 4  # Bands of rows that show how it leans
AGREE = 1.0  # Two independent estimates no farther apart than this (px) are the same axis


class AxisError(ValueError):
    """The best axis lies at or outside the edge of the search range, so there is no estimate."""


@dataclass(frozen=True, eq=False)
class AxisEstimate:
    """Estimate of the rotation axis.

    Attributes:
        value: axis_col in pixels, 0 at the centre of the first column.
        candidates: float64 [n], the columns tested.
        curve: float64 [n], mismatch at each candidate: 0 is perfect agreement, about 1 no agreement.
        confident: False if the minimum of the curve is shallow, or parts of the data disagree.
        method: "pair", "opposite views", "double wedge", "centre of mass" or "views held out".
    """

    value: float
    candidates: Floats
    curve: Floats
    confident: bool
    method: str

    def __str__(self) -> str:
        sure = "confident" if self.confident else "not confident"
        return f"column {self.value:.2f} by {self.method}, {sure} ({len(self.candidates)} candidates)"


def few_rows(data: NDArray[np.floating]) -> Floats:
    """At most 16 rows, each the mean of up to 4, which has less noise: the sum of slices is again a slice."""
    rows = data.shape[1]
    if rows <= MOST_ROWS:
        return np.asarray(data, np.float64)
    group = min(4, rows // MOST_ROWS)
    chosen = np.linspace(0, rows - 1, MOST_ROWS * group).astype(int)
    return data[:, chosen].reshape(len(data), MOST_ROWS, group, -1).mean(axis=2, dtype=np.float64)


def lowest(candidates: Floats, curve: Floats) -> tuple[float, int]:
    """Position of the minimum of a curve, by a parabola through three points, and the index of its lowest point."""
    i = int(curve.argmin())
    if not 0 < i < curve.size - 1:
        return float(candidates[i]), i
    below, here, above = curve[i - 1 : i + 2]
    bend = below - 2 * here + above
    shift = 0.5 * (below - above) / bend if bend > 0 else 0.0
    return float(candidates[i] + shift * (candidates[1] - candidates[0])), i


def within(search: Search, candidates: Floats, curve: Floats) -> tuple[Floats, Floats]:
    if search is None:
        return candidates, curve
    inside = (candidates >= search[0]) & (candidates <= search[1])
    return candidates[inside], curve[inside]


def axis_error(value: float, search: Search, candidates: Floats, where: str) -> AxisError:
    low, high = (candidates[0], candidates[-1]) if search is None else search
    return AxisError(
        f"no rotation axis in the search range {low:g} to {high:g}: the best column is {value:.2f}, {where}; "
        "widen the range, or give the axis"
    )


def optimum(candidates: Floats, curve: Floats, search: Search) -> tuple[float, float]:
    """The minimum inside the search range and its depth, 0 (as bad as the typical candidate) to 1 (perfect agreement).

    A minimum at the edge of the range, or clearly worse than one outside, raises AxisError: a range without the axis
    also has a minimum.
    """
    part, values = within(search, candidates, curve)
    if part.size < 3:
        low, high = (candidates[0], candidates[-1]) if search is None else search
        raise ValueError(
            f"search range {low:g} to {high:g} holds {part.size} candidates; the axis is looked for in columns "
            f"{candidates[0]:g} to {candidates[-1]:g}"
        )
    value, i = lowest(part, values)
    if i in (0, part.size - 1):
        raise axis_error(value, search, candidates, "at its edge")
    typical = float(np.median(curve))
    depth, deepest = typical - float(values[i]), typical - float(curve.min())
    if depth < 0.8 * deepest:
        raise axis_error(lowest(candidates, curve)[0], search, candidates, "outside it")
    return value, depth / typical if typical > 0 else 0.0
