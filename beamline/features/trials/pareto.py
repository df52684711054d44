"""The Pareto front of (cost, quality), and the cost of each further decibel along it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass


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


@dataclass(frozen=True)
class Step:
    """From one point of a front to the next.

    Attributes:
        start, end: positions of the points.
        cost: extra cost of the second point.
        gain: its extra quality, dB.
    """

    start: int
    end: int
    cost: float
    gain: float

    @property
    def per_decibel(self) -> float:
        """The cost of a dB on this step."""
        return self.cost / self.gain


def steps(kept: Sequence[int], costs: Sequence[float], qualities: Sequence[float]) -> list[Step]:
    """The steps along a front, by rising cost; none if it has fewer than two points."""
    pairs = itertools.pairwise(kept)
    return [Step(a, b, costs[b] - costs[a], qualities[b] - qualities[a]) for a, b in pairs]
