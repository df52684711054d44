"""Shutter on a digital output of any controller: set the output, wait for the blade, read the output back."""

from __future__ import annotations

import math

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import DigitalOutput

NOT_KNOWN = "Whether the shutter is open is not known: look before anybody goes near the beam"


class OutputShutter:
    """Implements `drivers.base.protocols.Shutter` on a controller's output.

    Reading back checks the output, not the blade: only the beam shows whether the shutter moved. `close` always sends
    its command, even if the shutter is known to be closed.

    Args:
        output: the line that drives the shutter.
        open_high: a high line opens the shutter. With False a low line does, and so does a controller without power.
        settle: travel time of the blade, s; `open` and `close` wait for it.

    Raises:
        DeviceRefused: a settling time that is negative or not finite.
    """

    by_hand = False

    def __init__(
        self, output: DigitalOutput, clock: Clock, *, open_high: bool = True, settle: float = 0.0, name: str = "shutter"
    ) -> None:
        self.name = name
        if not (math.isfinite(settle) and settle >= 0):
            raise DeviceRefused(name, f"the settling time of {settle} s is not valid", expected="0 or more seconds")
        self._output, self._clock, self._open_high, self._settle = output, clock, open_high, settle
        self._open: bool | None = None  # level last sent; None before the first command, and after a failure

    def open(self) -> None:
        """Open and wait for the blade. Raises DeviceError: the output refused the level or does not hold it."""
        if self._open is None or not self.is_open():
            self._put(True)

    def close(self) -> None:
        """Close and wait for the blade. Raises DeviceError: the output refused the level or does not hold it."""
        self._put(False)

    def is_open(self) -> bool:
        """Whether the output holds the open level; without read-back, whether `open` was the last command sent.

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
                f"the output {self._output.name} does not hold the level that was set",
                request="high" if level else "low",
                reply="high" if held else "low",
                expected=f"{'high' if level else 'low'}, which {'opens' if opened else 'closes'} the shutter",
                advice="Check the output's number, its wiring for a short, and that no other program sets it",
                state=NOT_KNOWN,
            )
        self._open = opened
