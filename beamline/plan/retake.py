"""Retake: views that are taken again after the last one, standing, at the angles that they had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.plan.plan import Block, Mode
from drivers.base.frame import FrameKind


@dataclass(frozen=True)
class Retake:
    """A view to take again: its frame in the file (-1: it gave none), and its trigger within the views."""

    row: int
    trigger: int


def spread(views: Sequence[Retake], most: int) -> tuple[Retake, ...]:
    """At most so many of the views, evenly spread over them: what is not taken again leaves small gaps, not one."""
    if len(views) <= most:
        return tuple(views)
    return tuple(views[i] for i in np.unique(np.linspace(0, len(views) - 1, most).round().astype(int)))


def middle_of_exposure(views: Block) -> NDArray[np.float64]:
    """float64 [view] radians by which the stage has turned beyond the trigger in the middle of a view's exposure.

    0 for a step scan. A standing stage must be there to show what the view of a fly scan shows.
    """
    turned = np.zeros(views.n)
    first = 0
    for train in views.trains:
        passed = slice(first, first + train.n)
        turned[passed] = np.sign(views.angles[passed][-1] - views.angles[first]) * views.speed * views.exposure / 2
        first += train.n
    return turned


def retake_block(views: Block, triggers: NDArray[np.int64]) -> Block:
    """The block that takes these views again, in their order: each stands for the exposure of the view."""
    angles = views.angles[triggers] + middle_of_exposure(views)[triggers]
    period = views.exposure if views.trains else views.period
    return Block(FrameKind.PROJECTION, Mode.STEP, views.first_trigger + views.n, angles, views.exposure, period)
