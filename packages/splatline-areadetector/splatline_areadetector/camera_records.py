"""Records: what the camera driver sets in its IOC, each read back until it is so."""

from __future__ import annotations

from drivers.base.clock import Clock
from drivers.base.errors import DeviceRefused
from drivers.epics.channel import ProcessVariable, open_channel

LOOK_EVERY = 0.02  # s, for a readback


class Records:
    """The records of an IOC by their names after the prefix, each opened once."""

    def __init__(self, prefix: str, name: str, timeout: float, clock: Clock) -> None:
        self._prefix, self._name, self._timeout, self._clock = prefix, name, timeout, clock
        self._opened: dict[str, ProcessVariable] = {}

    def read(self, record: str) -> float | str:
        (value,) = self._channel(record).read("")
        return value.label or value.value

    def write(self, record: str, value: float | str) -> None:
        self._channel(record).write("", value)

    def set(self, record: str, value: float | str, within: float = 0.01) -> float | str:
        """Write a value, and wait for its readback; a number may differ by this share. The readback."""
        self.write(record, value)
        return self.await_value(record, value, within)

    def await_value(self, record: str, value: float | str, within: float = 0.01) -> float | str:
        """Wait until the readback is this value. Raises DeviceRefused if it does not come to be."""
        deadline = self._clock.now() + self._timeout
        while not _is_near(shown := self.read(f"{record}_RBV"), value, within):
            if self._clock.now() > deadline:
                raise DeviceRefused(
                    self._name, f"{record} did not take {value!r}", request=f"{self._prefix}{record} = {value}",
                    reply=f"{record}_RBV is {shown!r}", state="Other settings may have changed",
                    advice="Try it in the camera's control screen, and check `driver`",
                )  # fmt: skip
            self._clock.sleep(LOOK_EVERY)
        return shown

    def close(self) -> None:
        for channel in self._opened.values():
            channel.close()

    def _channel(self, record: str) -> ProcessVariable:
        if record not in self._opened:
            self._opened[record] = open_channel(f"{self._prefix}{record}", self._name, self._timeout)
        return self._opened[record]


def _is_near(shown: float | str, value: float | str, within: float) -> bool:
    if isinstance(shown, str) or isinstance(value, str):
        return shown == value or (isinstance(shown, str) and shown in _SWITCHED.get(value, ()))
    return abs(shown - value) <= within * abs(value) + 1e-9


_SWITCHED: dict[float | str, tuple[str, ...]] = {
    0: ("No", "Disable", "Off", "Done"), 1: ("Yes", "Enable", "On", "Acquire", "Acquiring"),
}  # fmt: skip
"""Labels of switches, which are written as 0 or 1."""
