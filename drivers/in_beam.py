"""Devices in the beam that are moved by another device (a stage with named positions, a digital output) or by the
operator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import DigitalOutput, RotationStage

POLL = 0.05  # s between two reads while a motor moves
MARGIN = 10.0  # s; a move has failed after twice its expected time plus this
INSIDE, OUTSIDE = "into the beam", "out of the beam"


@dataclass(frozen=True)
class StagePlaces:
    """Positions of a stage by name.

    Attributes:
        places: rad of the stage.
        speed: rad/s.
        failed: beginning of the error sentence; the name of the place is added at its end.
    """

    places: Mapping[str, float]
    speed: float
    failed: str = "the filter did not move to"


class PlacedStage:
    """A stage that moves to named places. Implements `drivers.base.protocols.Filter` and `Watchable`.

    Each call reads the position of the stage, because a person may have moved it. The stage moves only if it is not at
    the requested place.
    """

    def __init__(self, stage: RotationStage, places: StagePlaces, clock: Clock, name: str = "filter") -> None:
        self.name = name
        self._stage, self._places, self._clock = stage, places, clock
        self._check: Callable[[], None] = lambda: None

    def watch(self, check: Callable[[], None]) -> None:
        """From now on, call `check` repeatedly during every move.

        An exception from `check` stops the stage and ends the move.
        """
        self._check = check

    def place(self) -> str | None:
        """Name of the present place. Raises DeviceError."""
        return next((name for name in self._places.places if self._is_at(name)), None)

    def put(self, place: str, offset: float = 0.0) -> None:
        """Move to a place, or `offset` radians away from it. Raises DeviceError if the stage did not arrive."""
        stage, speed, target = self._stage, self._places.speed, self._places.places[place] + offset
        try:
            if self._stands_at(target):
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
            advice = cause.advice or "Check its position before the next scan"
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
            return f"the device was at {math.degrees(before):.4f} deg, and is now at {math.degrees(now):.4f} deg{named}"

        return moved

    def close(self) -> None:
        """Close the connection; the stage stays where it is."""
        self._stage.close()

    def _is_at(self, place: str) -> bool:
        return self._stands_at(self._places.places[place])

    def _stands_at(self, angle: float) -> bool:
        """Whether the stage is at this angle, within the tolerance of its own moves."""
        stage = self._stage
        away = stage.to_counts(stage.position()) - stage.to_counts(angle)
        return abs(away) <= stage.limits.tolerance and not stage.moving()


class StageSampleMover:
    """Implements `drivers.base.protocols.SampleMover` with a stage that has the places INSIDE and OUTSIDE."""

    def __init__(self, motor: PlacedStage, rad_per_mm: float = math.nan) -> None:
        self.name, self.watch, self.close, self._motor = motor.name, motor.watch, motor.close, motor
        self._rad_per_mm = rad_per_mm
        self.remember_place = motor.remember_place

    def out(self) -> None:
        """Move the sample out. Raises DeviceError if it did not arrive."""
        self._motor.put(OUTSIDE)

    def back(self, aside: float = 0.0) -> None:
        """Move the sample into the beam, `aside` mm from its place. Raises DeviceError if it did not arrive."""
        self._motor.put(INSIDE, aside * self._rad_per_mm if aside else 0.0)


NOT_KNOWN = "It is not known whether the shutter is open: check the shutter before anybody goes near the beam"


class OutputShutter:
    """Implements `drivers.base.protocols.Shutter` with a digital output of a controller.

    Reading back checks the output and not the blade. Only the beam shows whether the shutter moved. `close` always
    sends its command, even if the shutter is known to be closed.

    Args:
        output: the line that drives the shutter.
        open_high: True: a high line opens the shutter. False: a low line opens it, and so does a controller without
            power.
        settle: travel time of the blade in s; `open` and `close` wait for it.

    Raises:
        DeviceRefused: the settling time is negative or not finite.
    """

    by_hand = False

    def __init__(
        self, output: DigitalOutput, clock: Clock, *, open_high: bool = True, settle: float = 0.0, name: str = "shutter"
    ) -> None:
        self.name = name
        if not (math.isfinite(settle) and settle >= 0):
            raise DeviceRefused(name, f"the settling time of {settle} s is not valid", expected="0 or more seconds")
        self._output, self._clock, self._open_high, self._settle = output, clock, open_high, settle
        self._open: bool | None = None  # the last level sent; None before the first command and after a failure

    def open(self) -> None:
        """Open, and wait for the blade. Raises DeviceError if the output rejects the level or does not keep it."""
        if self._open is None or not self.is_open():
            self._put(True)

    def close(self) -> None:
        """Close, and wait for the blade. Raises DeviceError if the output rejects the level or does not keep it."""
        self._put(False)

    def is_open(self) -> bool:
        """True if the output has the level for "open"; without read-back, True if `open` was the last command sent.

        False before the first command. Raises DeviceError.
        """
        level = self._output.get()
        return self._open is True if level is None else level is self._open_high

    def _put(self, opened: bool) -> None:
        self._open = None
        level = opened is self._open_high
        try:
            self._output.set(level)
            self._clock.sleep(self._settle)
            held = self._output.get()
        except DeviceError as cause:
            wanted = "high" if level else "low"
            raise DeviceError(
                self.name,
                f"it could not be {'opened' if opened else 'closed'}: {cause.device}: {cause.problem}",
                request=cause.request or f"{self._output.name} {wanted}",
                reply=cause.reply,
                expected=cause.expected or f"{wanted} on {self._output.name}",
                advice=cause.advice or "Check the controller's power and cable",
                state=NOT_KNOWN,
                wire=cause.wire,
            ) from cause
        if held is not None and held is not level:
            raise DeviceError(
                self.name,
                f"{self._output.name} does not have the level that was set",
                request="high" if level else "low",
                reply="high" if held else "low",
                expected=f"{'high' if level else 'low'}, which {'opens' if opened else 'closes'} the shutter",
                advice="Check the output's number, its wiring for a short, and that no other program sets it",
                state=NOT_KNOWN,
            )
        self._open = opened


Ask = Callable[[str], None]
"""Function that shows a request to the operator and returns when the operator has confirmed it.

If the operator does not confirm it, the function raises the error of the caller.
"""


class _Manual:
    """A device that the operator moves; `_state` is the state that the operator confirmed last.

    The state None means that the state is not known: before the first answer, while the operator is asked, or after a
    request that was not confirmed.
    """

    _name = ""

    def __init__(self, ask: Ask, name: str = "") -> None:
        self.name, self._ask = name or self._name, ask
        self._state: Any = None

    def _bring(self, state: object, request: str) -> None:
        """Ask the operator for a state, unless it is the present state."""
        if self._state != state:
            self._state = None
            self._ask(request)
            self._state = state


class ManualShutter(_Manual):
    """Implements `drivers.base.protocols.Shutter` by asking the operator.

    The state of the shutter at the start is not known, so the first `open` or `close` always asks. Later calls ask only
    if the state changes.
    """

    by_hand = True
    _name = "shutter"

    def open(self) -> None:
        self._bring(True, "Open the beam shutter.")

    def close(self) -> None:
        self._bring(False, "Close the beam shutter.")

    def is_open(self) -> bool:
        """The state that was confirmed last.

        False before the first confirmation, which is the safe assumption for a measurement.
        """
        return self._state is True


class ManualSampleMover(_Manual):
    """Implements `drivers.base.protocols.SampleMover` by asking the operator; the sample starts in the beam."""

    _name = "sample mover"

    def __init__(self, ask: Ask, name: str = "") -> None:
        super().__init__(ask, name)
        self._state = "in"

    def out(self) -> None:
        self._bring("out", "Move the sample out of the beam.")

    def back(self, aside: float = 0.0) -> None:
        if aside:
            advice = "Configure a stage that moves it (devices.sample_mover)."
            raise DeviceError(
                "sample mover", f"the operator cannot move the sample {aside:g} mm sideways by hand", advice=advice
            )
        self._bring("in", "Move the sample back into the beam, to the same place.")


class ManualFilter(_Manual):
    """Implements `drivers.base.protocols.Filter` by asking the operator. The filter at the start is not known."""

    _name = "filter"

    def put(self, place: str) -> None:
        self._bring(place, f"Put the filter into the beam: {place}.")

    def place(self) -> str | None:
        place: str | None = self._state
        return place


class ManualMonochromator(_Manual):
    """Implements `drivers.base.protocols.Monochromator` by asking the operator.

    The energy at the start is not known.
    """

    _name = "monochromator"

    def move_to(self, energy: float) -> None:
        self._bring(energy, f"Set the monochromator to {energy:.7g} keV.")

    def energy(self) -> float | None:
        energy: float | None = self._state
        return energy
