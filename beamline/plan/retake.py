"""Retake: views that are repeated after the last one, with a standing stage at their angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.plan.plan import Block, Mode
from drivers.base.frame import FrameKind


@dataclass(frozen=True)
class Retake:
    """A view to repeat: its frame in the file (-1: it gave none), and its trigger within the views."""

    row: int
    trigger: int


def spread(views: Sequence[Retake], most: int) -> tuple[Retake, ...]:
    """At most so many of the views, evenly spread, so that the others leave small gaps instead of a large one."""
    if len(views) <= most:
        return tuple(views)
    return tuple(views[i] for i in np.unique(np.linspace(0, len(views) - 1, most).round().astype(int)))


def middle_of_exposure(views: Block) -> NDArray[np.float64]:
    """float64 [view] radians by which the stage has turned beyond the trigger in the middle of a view's exposure.

    0 for a step scan. A standing stage at this angle shows the same as the view of a fly scan.
    """
    turned = np.zeros(views.n)
    first = 0
    for train in views.trains:
        passed = slice(first, first + train.n)
        turned[passed] = np.sign(views.angles[passed][-1] - views.angles[first]) * views.speed * views.exposure / 2
        first += train.n
    return turned


def retake_block(views: Block, triggers: NDArray[np.int64]) -> Block:
    """The block that repeats these views, in their order; the stage stands during each exposure."""
    angles = views.angles[triggers] + middle_of_exposure(views)[triggers]
    period = views.exposure if views.trains else views.period
    return Block(FrameKind.PROJECTION, Mode.STEP, views.first_trigger + views.n, angles, views.exposure, period)
