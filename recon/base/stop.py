"""Stop: a request and a deadline, by which a caller ends work early."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Self


class Stop:
    """Request to end work with what it has reached; the work calls it between steps.

    Args:
        asks: True ends the work, and it is not asked again.
        deadline: when the work ends by itself, by `now`, in s; inf: never.
        now: the clock.

    Attributes:
        stopped: somebody asked for the end; the deadline alone does not count, because it was planned. Of one
            made by `by` the deadline of the first counts as asked for.
    """

    def __init__(
        self,
        asks: Callable[[], bool] = lambda: False,
        deadline: float = math.inf,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._asks, self.deadline, self._now, self.stopped = asks, deadline, now, False

    def __call__(self) -> bool:
        if self.deadline < math.inf and self._now() >= self.deadline:
            return True
        self.stopped = self.stopped or bool(self._asks())
        return self.stopped

    def by(self, deadline: float, now: Callable[[], float]) -> Self:
        """The same request with a deadline."""
        return type(self)(self, deadline, now)

    def leaves(self, seconds: float) -> bool:
        """Whether at least so many s remain before its own deadline."""
        return self.deadline == math.inf or self._now() + seconds <= self.deadline

    def cut(self, done: int, planned: int) -> bool:
        """Whether somebody's stop left some of the `planned` steps or iterations undone; 0: no number is planned."""
        return self.stopped and not 0 < planned <= done
