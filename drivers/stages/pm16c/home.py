"""The PM16C's search for its home switch: find it (FDHP), go back to it (GTHP), give it its count (PS).

Taken from memory and to be checked at an instrument: the direction of the search and the switch's kind are set on the
controller's panel. The speed is the selected one. A search that has found the switch may end some counts beyond it.
"""

from __future__ import annotations

from drivers.base.errors import DeviceError
from drivers.stages.pm16c.channel import ChannelStatus, PM16CChannel


class HomeSearch:
    """One search, in steps: `begin`, then `go_on` each time the motor has come to rest, until it returns False.

    Args:
        home: the count that the reference gets.
    """

    def __init__(self, channel: PM16CChannel, name: str, home: int) -> None:
        self._channel, self._name, self._home = channel, name, home
        self._found: int | None = None
        self._cancelled = False

    def begin(self, speed: int) -> None:
        """Start to search at `speed` pulses/s."""
        self._channel.find_home(speed)

    def cancel(self) -> None:
        """End the search: no further step. Call it before the stop is sent, from any thread."""
        self._cancelled = True

    def go_on(self, status: ChannelStatus) -> bool:
        """Take the next step after the motor has come to rest. False if there is no further step.

        Raises:
            DeviceError: the search ended without the switch, or was stopped.
        """
        found = self._channel.home() if self._found is None else self._found
        if found is None or self._cancelled or status.stopped:
            raise self._failed(status)
        if self._found is None and status.counts != found:
            self._found = found
            try:
                self._channel.go_home(found)
            finally:
                if self._cancelled:  # the stop may have gone out just before the move
                    self._channel.slow_stop()
            return True
        if status.counts != found:
            raise self._failed(status)
        self._channel.preset(self._home)
        return False

    def _failed(self, status: ChannelStatus) -> DeviceError:
        why = status.ending or ("stopped" if self._cancelled else "no reason given")
        return DeviceError(
            self._name,
            f"the search for the home switch stopped short ({why})",
            reply=status.raw,
            expected="to stand on the home switch",
            advice="Check the switch and its settings on the controller's panel, then search again",
            state=f"It stands at {status.counts} counts, which are not those of the reference",
        )
