"""Anomaly: the shared parts of effects that label their frames: the label, a range of views, the edge of a slit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from simulators.frame.shot import Shot

VISIBLE = 1e-3  # Least change of the light that is labelled, as a share
NARROWEST = 1e-9  # mm: an edge with a smaller penumbra is a step


def _in_order(views: tuple[int, int]) -> tuple[int, int]:
    if not 0 <= views[0] < views[1]:
        raise ValueError(f"must be [first, one after the last] with 0 <= first < last, got {list(views)}")
    return views


Views = Annotated[tuple[int, int], AfterValidator(_in_order)]
"""First view and the one after the last. A flat belongs to the view that is exposed next."""


@dataclass(frozen=True)
class Label:
    """An anomaly that a monitor should find in a frame.

    Attributes:
        kind: the anomaly's name.
        region: (first row, row after the last, first column, column after the last) in pixels of the frame.
        which: number among several of one kind; the same in every frame.
    """

    kind: str
    region: tuple[int, int, int, int]
    which: int = 0

    def joined(self, other: Label) -> Label:
        """This label with a region that includes the other's."""
        (top, below, left, right), region = self.region, other.region
        joined = min(top, region[0]), max(below, region[1]), min(left, region[2]), max(right, region[3])
        return Label(self.kind, joined, self.which)


def within(views: Views | None, shot: Shot) -> bool:
    """Whether the shot lies in the range; True without a range."""
    return views is None or views[0] <= shot.view < views[1]


def lit_share(inside: NDArray[np.float64], penumbra: float) -> NDArray[np.float64]:
    """Share of the light at `inside` mm within the edge of a slit (negative: behind it), with a penumbra in mm.

    The edge covers more and more of an evenly bright source: a ramp, half of the light at the edge itself.
    """
    return np.clip(0.5 + inside / max(penumbra, NARROWEST), 0.0, 1.0)
