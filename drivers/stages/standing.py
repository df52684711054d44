"""Standing: waits until a moving stage stands, and knows how long a stop may take."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from drivers.base.clock import Clock
from drivers.base.protocols import StageLimits

POLL = 0.02
"""s between two status queries of a moving stage."""
STOP_MARGIN = 2.0
"""s beyond the longest deceleration after which a stop has failed."""
Status = TypeVar("Status")


def until_standing(clock: Clock, look: Callable[[], Status], moves: Callable[[Status], bool], timeout: float) -> Status:
    """The last status: the stage stands, or it still moves after `timeout` s.

    Args:
        look: asks the controller, at least once.
        moves: whether the stage moves by what a look has shown.
    """
    deadline = clock.now() + timeout
    while moves(status := look()) and (left := deadline - clock.now()) > 0:
        clock.sleep(min(POLL, left))
    return status


def longest_stop(limits: StageLimits) -> float:
    """s after a stop by which every stage stands: it slows down from its full speed."""
    return limits.max_speed / limits.acceleration + STOP_MARGIN
