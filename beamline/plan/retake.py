"""Retake: views that are taken again after the last one, with a standing stage at their angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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


def return_triggers(views: Block, n: int) -> NDArray[np.int64]:
    """So many of the views, evenly spread in angle, in the order in which a stage meets them on its way back."""
    ahead = np.argsort(views.angles, kind="stable")
    chosen = ahead[np.unique(np.linspace(0, views.n - 1, min(n, views.n)).round().astype(int))]
    back = abs(views.angles[chosen[0]] - views.angles[-1]) > abs(views.angles[chosen[-1]] - views.angles[-1])
    return np.asarray(chosen[::-1] if back else chosen, np.int64)


def return_block(views: Block, n: int, *, stored: bool) -> Block:
    """The block that takes so many views a second time on the way back; the stage stands during each exposure."""
    block = retake_block(views, return_triggers(views, n))
    return replace(block, kind=FrameKind.ALIGNMENT, stored=frozenset(range(block.n)) if stored else frozenset[int]())


def retake_block(views: Block, triggers: NDArray[np.int64]) -> Block:
    """The block that repeats these views, in their order; the stage stands during each exposure."""
    angles = views.angles[triggers] + middle_of_exposure(views)[triggers]
    period = views.exposure if views.trains else views.period
    return Block(FrameKind.PROJECTION, Mode.STEP, views.first_trigger + views.n, angles, views.exposure, period)
