"""A stage that goes to named places: as a filter, or as sample mover."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.protocols import RotationStage

POLL = 0.05  # s between looks at a motor that moves
MARGIN = 10.0  # s beyond twice the time of a move after which it has failed
INSIDE, OUTSIDE = "into the beam", "out of the beam"


@dataclass(frozen=True)
class StagePlaces:
    """Positions of a stage by name.

    Attributes:
        places: rad of the stage.
        speed: rad/s.
        failed: how an error begins; the name of the place ends its sentence.
    """

    places: Mapping[str, float]
    speed: float
    failed: str = "the filter did not come to"


class PlacedStage:
    """A stage that goes to named places. Implements `drivers.base.protocols.Filter` and `Watchable`.

    Each call asks the stage where it is, since a person may have moved it, and moves unless it stands there.
    """

    def __init__(self, stage: RotationStage, places: StagePlaces, clock: Clock, name: str = "filter") -> None:
        self.name = name
        self._stage, self._places, self._clock = stage, places, clock
        self._check: Callable[[], None] = lambda: None

    def watch(self, check: Callable[[], None]) -> None:
        """From now on `check` is called again and again on the way; its exception stops the stage and ends the move."""
        self._check = check

    def place(self) -> str | None:
        """Raises DeviceError."""
        return next((name for name in self._places.places if self._is_at(name)), None)

    def put(self, place: str) -> None:
        """Raises DeviceError: it did not arrive."""
        stage, speed, target = self._stage, self._places.speed, self._places.places[place]
        try:
            if self._is_at(place):
                return
            way = abs(stage.position() - target)
            stage.start_move(target, speed)
            deadline = self._clock.now() + 2 * (way / speed + speed / stage.limits.acceleration) + MARGIN
            try:
                while stage.moving() and self._clock.now() < deadline:
                    self._check()
                    self._clock.sleep(POLL)
            except BaseException:
                stage.abort()
                raise
            stage.wait(POLL)
        except DeviceError as cause:
            advice = cause.advice or "Look where it is before the next scan"
            problem = f"{self._places.failed} {place}: {cause.device}: {cause.problem}"
            raise cause.told_by(self.name, problem, advice=advice) from cause

    def remember_place(self) -> Callable[[], str]:
        """See `drivers.base.protocols.Rechecked`."""
        before = self._stage.position()

        def moved() -> str:
            if self._stands_at(before):
                return ""
            now, place = self._stage.position(), self.place()
            named = f" ({place})" if place else ""
            return f"it stood at {math.degrees(before):.4f} deg, and is at {math.degrees(now):.4f} deg{named}"

        return moved

    def close(self) -> None:
        """Close the connection; the stage stays where it is."""
        self._stage.close()

    def _is_at(self, place: str) -> bool:
        return self._stands_at(self._places.places[place])

    def _stands_at(self, angle: float) -> bool:
        """Within the tolerance that the stage's own moves arrive with."""
        stage = self._stage
        away = stage.to_counts(stage.position()) - stage.to_counts(angle)
        return abs(away) <= stage.limits.tolerance and not stage.moving()


class StageSampleMover:
    """Implements `drivers.base.protocols.SampleMover` by a stage with the places INSIDE and OUTSIDE."""

    def __init__(self, motor: PlacedStage) -> None:
        self.name, self.watch, self.close, self._motor = motor.name, motor.watch, motor.close, motor
        self.remember_place = motor.remember_place

    def out(self) -> None:
        """Raises DeviceError: the sample did not arrive."""
        self._motor.put(OUTSIDE)

    def back(self) -> None:
        """Raises DeviceError: the sample did not arrive."""
        self._motor.put(INSIDE)
