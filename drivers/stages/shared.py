"""What the stages of this package share: places by their travel, and stops."""

from __future__ import annotations

from typing import Protocol

from drivers.base.clock import Clock
from drivers.base.protocols import RotationStage, StageLimits
from drivers.stages.stops import Stops, longest_stop, until_standing
from drivers.stages.travel import Travel


class LineStage(RotationStage, Protocol):
    """A stage behind a serial line; its driver adds the commands of the controller.

    `stop` returns when the stage stands, `abort` at once. A `wait` for a stopped move raises, whoever stopped it: no
    thread takes the move as complete.
    """

    _clock: Clock
    _travel: Travel
    _stops: Stops

    def _counts(self) -> int:
        """The present place, asked of the controller."""
        ...

    def _send_stop(self, hard: bool) -> str:
        """Send a stop (hard: without deceleration); returns the command."""
        ...

    @property
    def limits(self) -> StageLimits:
        return self._travel.limits

    def to_counts(self, angle: float) -> int:
        return self._travel.to_counts(angle)

    def to_angle(self, counts: int) -> float:
        return self._travel.to_angle(counts)

    def position(self) -> float:
        return self.to_angle(self._counts())

    def stop(self) -> None:
        self._stops.came(hard=False)
        command = self._send_stop(hard=False)
        longest = longest_stop(self.limits)
        if until_standing(self._clock, self.moving, bool, longest):
            raise self._travel.not_stopped(longest, self._counts(), command)

    def abort(self) -> None:
        self._stops.came(hard=True)
        self._send_stop(hard=True)
