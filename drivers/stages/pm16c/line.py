"""The PM16C's dialogue: queries are answered, settings are not, so each setting that matters is read back.

A controller that writes its memory takes its time: KEK's driver waits 40 ms after settings. So a wrong
read-back is repeated for a while, and the setting then sent once more, before it counts as refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TypeVar

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.serial.line import Probe, line_to
from drivers.stages.settings import Wiring

PROBE = Probe("STQ?", r"[RL][0-4]")
STOPPED_NOTE = r"STOP[0-9A-F]"
MEMORY = 0.12  # Longest time, s, until a setting takes effect
LOOK = 0.02  # s between two checks of this
T = TypeVar("T")


class PM16CLine:
    """Raises (in all methods):
    DeviceError: a wrong reply or read-back. DeviceTimeout: no reply.
    """

    def __init__(self, url: str, wiring: Wiring, clock: Clock, name: str) -> None:
        self.commanded = False
        """Whether a move has started; the text of an error depends on it."""
        self._name, self._clock = name, clock
        self._serial = line_to(wiring, url, name, clock, PROBE, unsolicited=STOPPED_NOTE)

    def send(self, command: str) -> None:
        """Send a command without waiting."""
        self._serial.send(command)

    def ask(self, request: str, form: str, meaning: str) -> re.Match[str]:
        state = "A move was started before; the stage may be turning" if self.commanded else "Nothing has moved"
        return self._serial.query(request, form, meaning, state)

    def set(self, command: str, query: str, value: int) -> None:
        """Send a numeric setting and read it back."""
        self.make_sure(command, query, r"[+-]?\d+", value, int)

    def make_ready(self, command: str, query: str, wanted: str) -> None:
        """Arm or disarm the trigger output and check it."""
        self.make_sure(command, query, "YES|NO", wanted, str)

    def make_sure(self, command: str, query: str, form: str, wanted: T, read: Callable[[str], T]) -> None:
        """Send a setting and check that the reply to `query`, of the form `form`, reads `wanted`."""
        for _ in range(2):
            self.send(command)
            value = self.until(lambda: read(self.ask(query, form, f"{wanted}, as just set")[0]), wanted.__eq__)
            if value == wanted:
                return
        raise self.not_followed(command, str(value), str(wanted))

    def until(self, look: Callable[[], T], good: Callable[[T], bool]) -> T:
        """The first good reply, or the last one within the time for a setting to take effect."""
        deadline = self._clock.now() + MEMORY
        while not good(seen := look()) and self._clock.now() < deadline:
            self._clock.sleep(LOOK)
        return seen

    def not_followed(self, command: str, reply: str, wanted: str) -> DeviceError:
        """The error for a read-back that is not what was set."""
        return DeviceError(
            self._name,
            f"a setting was not taken ({self.complaint()})",
            request=command,
            reply=reply,
            expected=wanted,
            advice="Check that no other program or person drives this controller",
            state="Nothing has moved",
        )

    def complaint(self) -> str:
        """Read and clear the controller's own error text."""
        text = self.ask("ERR?", r".*", "an error text")[0]
        self.send("ERRC")
        return f"the controller says {text}"

    def close(self) -> None:
        self._serial.close()
