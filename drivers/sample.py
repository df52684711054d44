"""Sample mover by a motor: any stage between two named places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.protocols import RotationStage

POLL = 0.05  # s between looks at a sample that moves
MARGIN = 10.0  # s beyond twice the time of a move after which it has failed


@dataclass(frozen=True)
class MoverPlaces:
    """Where the sample is in the beam and out of it, and the speed between: rad, rad/s of the stage."""

    inside: float
    outside: float
    speed: float


class StageSampleMover:
    """Implements `drivers.base.protocols.SampleMover`.

    Each call asks the stage where it is, since a person may have moved it, and moves unless it stands there.
    """

    def __init__(self, stage: RotationStage, places: MoverPlaces, clock: Clock, name: str = "sample mover") -> None:
        self.name = name
        self._stage, self._places, self._clock = stage, places, clock
        self._check: Callable[[], None] = lambda: None

    def watch(self, check: Callable[[], None]) -> None:
        """From now on `check` is called again and again on the way; its exception stops the stage and ends the move."""
        self._check = check

    def out(self) -> None:
        """Raises DeviceError: the sample did not arrive."""
        self._go(self._places.outside, "out of the beam")

    def back(self) -> None:
        """Raises DeviceError: the sample did not arrive."""
        self._go(self._places.inside, "into the beam")

    def close(self) -> None:
        """The sample stays where it is."""
        self._stage.close()

    def _go(self, place: float, where: str) -> None:
        stage, speed = self._stage, self._places.speed
        try:
            way = abs(stage.position() - place)
            if stage.to_counts(stage.position()) == stage.to_counts(place) and not stage.moving():
                return
            stage.start_move(place, speed)
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
            advice = cause.advice or "Look where the sample is before the next scan"
            problem = f"the sample did not come {where}: {cause.device}: {cause.problem}"
            raise cause.told_by(self.name, problem, advice=advice) from cause
