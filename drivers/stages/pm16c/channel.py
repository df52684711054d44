"""One motor channel of a Tsuji PM16C-04XD(L) in the controller's own units: pulses, pulses/s, codes, and its replies.

Protocol: the vendor's remote manual, revision 17 (2017), cross-checked with KEK's drivers. Set commands have no reply,
so each important one is read back. A controller that writes its memory needs time: KEK's driver waits 40 ms after
settings. So if a read-back is wrong, it is repeated for a while, and then the setting is sent once more. Only after
that is it an error.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.serial.line import Probe, line_to
from drivers.stages.pm16c.settings import TriggerPoints
from drivers.stages.settings import Wiring
from drivers.stages.shared import FoundSettings, while_it_moves

PROBE = Probe("STQ?", r"[RL][0-4]")
STOPPED_NOTE = r"STOP[0-9A-F]"
MEMORY = 0.12  # longest time in s until a setting takes effect
LOOK = 0.02  # s between two checks of a setting
T = TypeVar("T")


class PM16CLine:
    """Raises (in all methods):
    DeviceError: a wrong reply or read-back. DeviceTimeout: no reply.
    """

    def __init__(self, url: str, wiring: Wiring, clock: Clock, name: str) -> None:
        self.commanded = False
        """True if a move was started; error messages depend on it."""
        self._name, self._clock = name, clock
        self._serial = line_to(wiring, url, name, clock, PROBE, unsolicited=STOPPED_NOTE)

    def send(self, command: str) -> None:
        """Send a command without waiting."""
        self._serial.send(command)

    def ask(self, request: str, form: str, meaning: str) -> re.Match[str]:
        state = "An earlier move was started; the stage may be turning" if self.commanded else "Nothing has moved"
        return self._serial.query(request, form, meaning, state)

    def set(self, command: str, query: str, value: int) -> None:
        """Send a numeric setting and read it back."""
        self.make_sure(command, query, r"[+-]?\d+", value, int)

    def make_ready(self, command: str, query: str, wanted: str) -> None:
        """Arm or disarm the trigger output and check it."""
        self.make_sure(command, query, "YES|NO", wanted, str)

    def make_sure(self, command: str, query: str, form: str, wanted: T, read: Callable[[str], T]) -> None:
        """Send a setting, and check that the reply to `query`, of the form `form`, is `wanted`."""
        for _ in range(2):
            self.send(command)
            value = self.until(lambda: read(self.ask(query, form, f"{wanted}, as just set")[0]), wanted.__eq__)
            if value == wanted:
                return
        raise self.not_followed(command, str(value), str(wanted))

    def until(self, look: Callable[[], T], good: Callable[[T], bool]) -> T:
        """The first good reply, or the last one within the time for a setting to take effect."""
        deadline = self._clock.now() + MEMORY
        while not good(status := look()) and self._clock.now() < deadline:
            self._clock.sleep(LOOK)
        return status

    def not_followed(self, command: str, reply: str, wanted: str) -> DeviceError:
        """The error for a read-back that differs from the set value."""
        return DeviceError(
            self._name,
            f"it did not accept a setting ({self.complaint()})",
            request=command,
            reply=reply,
            expected=wanted,
            advice="Check that no other program or person controls this controller",
            state="Nothing has moved",
        )

    def complaint(self) -> str:
        """Read and clear the controller's error text."""
        text = self.ask("ERR?", r".*", "an error text")[0]
        self.send("ERRC")
        return f"the controller says {text}"

    def close(self) -> None:
        self._serial.close()


COUNT = r"([+-]\d{7,10})"
STATUS_SINCE = (1, 47)  # Firmware
ENDINGS = {0x80: "emergency stop", 0x40: "stop command", 0x20: "limit", 0x10: "error"}
ERRORS = {
    0x2: "a move was rejected because the pulse chip was busy",
    0x4: "a move to an impossible position was rejected",
}
"""Error flags about the motor.

The flag for an unknown command is left out, because the empty line at every opening sets it.
"""
STOPS = {ENDINGS[0x80], ENDINGS[0x40]}


@dataclass(frozen=True)
class ChannelStatus:
    """Reply to STSx?. `ending`: text on why the last move ended early; "" if it did not."""

    remote: bool
    moving: bool
    ending: str
    counts: int
    raw: str

    @property
    def stopped(self) -> bool:
        """True if the move was stopped."""
        return bool(STOPS & set(self.ending.split(", ")))


class PM16CChannel:
    """Controls one channel of the controller, on position controller A, because that one has the trigger output TP0.

    Raises (here and in all methods):
        DeviceError: a wrong reply or read-back. DeviceTimeout: no reply.
        DeviceRefused: the controller is in LOCAL mode, or its motors move.
    """

    def __init__(self, url: str, channel: int, wiring: Wiring, clock: Clock, name: str) -> None:
        self._name, self._digit = name, f"{channel:X}"
        self.last_move = ""
        """The command of the last move or search, for errors."""
        self.error_at_opening = ""
        """The controller's error flags before opening cleared them."""
        self.found = FoundSettings()
        """What opening and moves change: position controllers, acceleration code, high speed, selected speed.
        """
        self._restore_local = False
        self._line = PM16CLine(url, wiring, clock, name)

    def open(self, rate_code: int) -> str:
        """Switch to REMOTE, select position controller A without a train, set the acceleration.

        Returns the firmware.
        """
        c = self._digit
        self._line.send("")  # an empty line ends an incomplete command of another program
        version = self._line.ask("VER?", r".*PM16C-04X.*", "the version of a PM16C-04XD(L)")[0]
        self._refuse_old(version)
        if not self.status().remote:
            self._line.send("REM")
            self._restore_local = True
            self._line.until(self.status, lambda status: status.remote)
        self.standing("opening")
        flags = int(self._line.ask("ERRF?", r"[0-9A-F]{2}", "error flags")[0], 16)
        self.error_at_opening = " and ".join(text for bit, text in ERRORS.items() if flags & bit)
        self._line.send("ERRC")
        self._found_settings(channels := self._channels())
        if not channels.startswith(c):
            self._line.send(command := f"SETCH{c}---")
            channels = self._line.until(self._channels, lambda channels: channels.startswith(c))
            if not channels.startswith(c):
                raise self._line.not_followed(command, channels, f"channel {c} on position controller A")
        self._line.make_ready(f"TMGC{c}", f"TMGR?{c}", "NO")  # a train left by a program that died
        self._line.set(f"RTE{c}{rate_code:03d}", f"RTE?{c}", rate_code)
        return version

    def own_limits(self) -> tuple[int, int] | None:
        """The controller's own soft limits (backward, forward) in counts.

        None if the first of the switch bits says that they are switched off [from memory].
        """
        c = self._digit
        if self._line.ask(f"SETLS?{c}", r"[01]{8}", "eight limit-switch bits")[0][0] == "0":
            return None
        backward, forward = (self._line.ask(f"{side}L?{c}", COUNT, "a signed position")[1] for side in "BF")
        return int(backward), int(forward)

    def counts(self) -> int:
        return int(self._line.ask(f"PS?{self._digit}", COUNT, "a signed position in pulses")[1])

    def status(self) -> ChannelStatus:
        form = rf"([RL]){self._digit}([PNS])(?:[0-9A-F]([0-9A-F]{{2}})|---){COUNT}"
        match = self._line.ask(f"STS{self._digit}?", form, "remote flag, channel, motion, status bits and position")
        bits = int(match[3] or "0", 16)
        ending = ", ".join(text for bit, text in ENDINGS.items() if bits & bit)
        return ChannelStatus(match[1] == "R", match[2] != "S" or bool(bits & 1), ending, int(match[4]), match[0])

    def standing(self, purpose: str) -> ChannelStatus:
        """The status. Raises DeviceRefused for `purpose` while the motor moves or the panel is in LOCAL."""
        status = self.status()
        if status.moving:
            raise while_it_moves(self._name, purpose, status.counts, status.raw)
        if not status.remote:
            raise DeviceRefused(
                self._name,
                f"{purpose} is not possible: the controller is in LOCAL",
                reply=status.raw,
                advice="Wait until all motors of the controller have stopped, and set REMOTE on the panel",
                state="Nothing has moved",
            )
        return status

    def start(self, target: int, speed: int) -> None:
        """Begin a move to `target` counts at `speed` pulses/s."""
        self.standing("a move")
        self._take_speed(speed)
        self._begin(f"ABS{self._digit}{target:+d}", target)

    def find_home(self, speed: int) -> None:
        """Begin the search for the home switch at `speed` pulses/s. The trigger output is cleared."""
        self.standing("a home search")
        self._line.make_ready(f"TMGC{self._digit}", f"TMGR?{self._digit}", "NO")
        self._take_speed(speed)
        self._begin(f"FDHP{self._digit}", None)

    def go_home(self, home: int) -> None:
        """Begin the move to the home that the search found, at the speed of the search."""
        self._begin(f"GTHP{self._digit}", home)

    def home(self) -> int | None:
        """Position of the home switch in counts; None if no search has found the switch."""
        reply = self._line.ask(f"SHP?{self._digit}", rf"{COUNT}|NO H\.P", "a signed position or NO H.P")
        return None if reply[1] is None else int(reply[1])

    def preset(self, counts: int) -> None:
        """Set the count of the present position to `counts`."""
        self.standing("a preset")
        self._line.set(f"PS{self._digit}{counts:+d}", f"PS?{self._digit}", counts)

    def arm(self, mode: int, points: TriggerPoints) -> None:
        """Set up the trigger output and make it ready."""
        c = self._digit
        self._line.make_ready(f"TMGC{c}", f"TMGR?{c}", "NO")
        self._line.set(f"TMGM{c}{mode}", f"TMGM?{c}", mode)
        self._line.set(f"TMGS{c}{points.start:+d}", f"TMGS?{c}", points.start)
        self._line.set(f"TMGE{c}{points.end:+d}", f"TMGE?{c}", points.end)
        self._line.set(f"TMGI{c}{points.interval}", f"TMGI?{c}", points.interval)
        self._line.make_ready(f"TMGR{c}", f"TMGR?{c}", "YES")

    def disarm(self) -> None:
        self.standing("disarming")
        self._line.make_ready(f"TMGC{self._digit}", f"TMGR?{self._digit}", "NO")

    def stop(self, hard: bool) -> str:
        """Send a stop (hard: without deceleration) without waiting; returns the command."""
        self._line.send(command := f"{'ESTP' if hard else 'SSTP'}{self._digit}")
        return command

    def close(self) -> None:
        """Switch back to LOCAL if it was in LOCAL before, and free the port even if the line is dead."""
        try:
            self._restore()
            if self._restore_local:
                self._line.send("LOC")
        finally:
            self._line.close()

    def _found_settings(self, channels: str) -> None:
        c = self._digit
        rate = self._line.ask(f"RTE?{c}", r"\d+", "an acceleration code")[0]
        speed = self._line.ask(f"SPDH?{c}", r"\d+", "pulses/s")[0]
        selected = self._line.ask(f"SPD?{c}", "([HML])SPD", "the selected speed")[1]
        values = {"RTE": f"{int(rate):03d}", "SPDH": str(int(speed)), "SPD": selected, "SETCH": channels}
        self.found.values = values

    def _restore(self) -> None:
        """Restore the settings that opening and moves have changed.

        Not while a motor moves, because it is then rejected.
        """
        c, write = self._digit, self._line.send
        if self.found.values and not (status := self.status()).moving and status.remote:
            forms = {"RTE": f"RTE{c}{{}}", "SPDH": f"SPDH{c}{{}}", "SPD": f"SPD{{}}{c}", "SETCH": "SETCH{}"}
            self.found.restore(lambda name, value: write(forms[name].format(value)))

    def _channels(self) -> str:
        """The channels on position controllers A to D."""
        return self._line.ask("SETCH?", r"[0-9A-F]{4}", "four channels")[0]

    def _refuse_old(self, version: str) -> None:
        number = re.match(r"(\d+)\.(\d+) ", version)
        if number is not None and (int(number[1]), int(number[2])) < STATUS_SINCE:
            raise DeviceRefused(
                self._name,
                f"the firmware {number[1]}.{number[2]} cannot report the status of one channel (STSx?)",
                request="VER?",
                reply=version,
                expected="{}.{} or later".format(*STATUS_SINCE),
                advice="Ask the vendor to update the firmware",
                state="Nothing has moved",
            )

    def _take_speed(self, speed: int) -> None:
        c = self._digit
        self._line.set(f"SPDH{c}{speed}", f"SPDH?{c}", speed)
        self._line.make_sure(f"SPDH{c}", f"SPD?{c}", "[HML]SPD", "HSPD", str)

    def _begin(self, command: str, target: int | None) -> None:
        """Send a move command, and check that the motor moves or is already at its target, if there is one."""
        self._line.commanded, self.last_move = True, command
        self._line.send(command)

        def has_started(status: ChannelStatus) -> bool:
            return status.moving or status.counts == (self.home() if target is None else target)

        status = self._line.until(self.status, has_started)
        if not has_started(status):
            raise DeviceError(
                self._name,
                f"the move did not start ({status.ending or self._line.complaint()})",
                request=command,
                reply=status.raw,
                expected="a moving motor",
                advice="Check limit switches, the motor driver, and that the panel is in REMOTE",
                state=f"The stage is at {status.counts} counts",
            )
