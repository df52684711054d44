"""Shutter on a digital output: any controller's output opens and closes it, with time to travel and a look back."""

from __future__ import annotations

import math
from typing import Protocol

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused


class DigitalOutput(Protocol):
    """One output line of some controller."""

    name: str

    def set(self, high: bool) -> None:
        """Put the line to high or low. Raises DeviceError where the controller does not take it."""
        ...

    def get(self) -> bool | None:
        """The line is high, as the controller says; None where it does not tell."""
        ...


class OutputShutter:
    """Implements `drivers.protocols.Shutter` on a controller's output.

    The look back is at the output, which is not the blade: whether the shutter obeyed, only the beam can say. Closing
    always sends, whatever is known: a beam that is off twice harms nobody.

    Args:
        output: the line that the shutter's driver listens to.
        open_high: a high line opens (else a low one does: then a controller without power opens the shutter).
        settle: s that the blade travels; `open` and `close` return after it.

    Raises:
        DeviceRefused: a settling time that is no time.
    """

    def __init__(
        self,
        output: DigitalOutput,
        clock: Clock,
        *,
        open_high: bool = True,
        settle: float = 0.0,
        name: str = "shutter",
    ) -> None:
        self.name = name
        if not (math.isfinite(settle) and settle >= 0):
            raise DeviceRefused(name, f"a settling time of {settle} s is none", expected="0 or more seconds")
        self._output, self._clock, self._open_high, self._settle = output, clock, open_high, settle
        self._open: bool | None = None  # as last sent; None before that, and after a failure

    def open(self) -> None:
        """Open and wait for the blade. Raises DeviceError: the output did not take it, or does not hold it."""
        if self._open is None or not self.is_open():
            self._put(True)

    def close(self) -> None:
        """Close and wait for the blade. Raises DeviceError: the output did not take it, or does not hold it."""
        self._put(False)

    def is_open(self) -> bool:
        """What the output says; where it does not tell, what was last sent: False before, so that nobody counts on
        beam. Raises DeviceError."""
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
            raise self._unheard(opened, level, cause) from cause
        if held is not None and held is not level:
            raise DeviceError(
                self.name,
                f"the output {self._output.name} does not hold what it was told",
                request="high" if level else "low",
                reply="high" if held else "low",
                expected=f"{'high' if level else 'low'}, which {'opens' if opened else 'closes'} the shutter",
                advice="Check the output's number, its wiring for a short, and that no other program sets it",
                state="Whether the shutter is open is not known: look before anybody goes near the beam",
            )
        self._open = opened

    def _unheard(self, opened: bool, level: bool, cause: DeviceError) -> DeviceError:
        """The output's own failure does not say that a shutter hangs on it."""
        return DeviceError(
            self.name,
            f"it could not be {'opened' if opened else 'closed'}: {cause.device}: {cause.problem}",
            request=cause.request or f"{self._output.name} {'high' if level else 'low'}",
            reply=cause.reply,
            expected=cause.expected or f"{'high' if level else 'low'} on {self._output.name}",
            advice=cause.advice or "Check the controller's power and cable",
            state="Whether the shutter is open is not known: look before anybody goes near the beam",
            wire=cause.wire,
        )
