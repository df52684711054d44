"""One motor channel of a Tsuji PM16C-04XD(L) in the controller's own units: pulses, pulses/s, codes, and its replies.

Protocol: the vendor's remote manual, revision 17 (2017), cross-checked with KEK's drivers. Set commands have no reply,
so each one that matters is read back.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from drivers.clock import Clock
from drivers.errors import DeviceError, DeviceRefused
from drivers.serial_line import Probe, SerialLine

PROBE = Probe("STQ?", r"[RL][0-4]")
STOPPED_NOTE = r"STOP[0-9A-F]"
COUNT = r"([+-]\d{7,10})"
STATUS = r"([RL])[0-9A-F]([PNS])(?:[0-9A-F]([0-9A-F]{2})|---)" + COUNT
MAX_SPEED = 5_000_000
"""pulses/s."""
MAX_COUNT = 2_147_483_647
"""Of positions, trigger points and limits, either way."""
ENDINGS = {0x80: "emergency stop", 0x40: "stop command", 0x20: "limit", 0x10: "error"}
STOPS = {ENDINGS[0x80], ENDINGS[0x40]}
E24 = (
    1.0,
    1.1,
    1.2,
    1.3,
    1.5,
    1.6,
    1.8,
    2.0,
    2.2,
    2.4,
    2.7,
    3.0,
    3.3,
    3.6,
    3.9,
    4.3,
    4.7,
    5.1,
    5.6,
    6.2,
    6.8,
    7.5,
    8.2,
    9.1,
)
RATES = sorted((m * 10.0**e for m in E24 for e in range(-2, 4) if 0.0155 < m * 10.0**e < 1005), reverse=True)
"""RTE code -> ms per 1000 pulses/s: the preferred numbers of IEC 60063 from 1000 down to 0.016, codes 0 to 115."""


@dataclass(frozen=True)
class ChannelStatus:
    """What STSx? says. `ending` is why the last move ended early, in words; "" where it did not."""

    remote: bool
    moving: bool
    ending: str
    counts: int
    raw: str

    @property
    def stopped(self) -> bool:
        """Somebody stopped it."""
        return bool(STOPS & set(self.ending.split(", ")))


def steepest_code(acceleration: float) -> int:
    """The code of the steepest acceleration that is not above `acceleration` (pulses/s²).

    Raises:
        ValueError: even the gentlest is above it.
    """
    codes = [code for code, ms in enumerate(RATES) if 1e6 / ms <= acceleration * (1 + 1e-9)]
    if not codes:
        raise ValueError(f"{acceleration:g} pulses/s² is gentler than the controller's gentlest, {1e6 / RATES[0]:g}")
    return codes[-1]


class PM16CChannel:
    """Talks to the controller about one channel; it is put on position controller A, whose trigger output is TP0.

    Raises (here and in all methods):
        DeviceError: a reply or a read-back is not what it must be. DeviceTimeout: no reply.
        DeviceRefused: the controller is in LOCAL, or its motors move.
    """

    def __init__(
        self, url: str, *, channel: int, name: str, clock: Clock, timeout: float, baudrate: int, transcript: Path | None
    ) -> None:
        self._name, self._digit = name, f"{channel:X}"
        self._commanded = False
        self.last_move = ""
        """The command of the last move or search, for errors."""
        self._restore_local = False
        self._line = SerialLine(
            url,
            device=name,
            probe=PROBE,
            clock=clock,
            timeout=timeout,
            baudrate=baudrate,
            unsolicited=STOPPED_NOTE,
            transcript=transcript,
        )

    def open(self, rate_code: int) -> str:
        """Go to REMOTE, take position controller A without a train, set the acceleration; the firmware's version."""
        c = self._digit
        self._line.send("")  # an empty line ends what another program may have left half said
        version = self._ask("VER?", r".*PM16C-04X.*", "the version of a PM16C-04XD(L)")[0]
        if not self.status().remote:
            self._line.send("REM")
            self._restore_local = True
        self.standing("opening")
        self._line.send("ERRC")
        if not self._ask("SETCH?", r"[0-9A-F]{4}", "four channels")[0].startswith(c):
            self._line.send(f"SETCH{c}---")
            self._ask("SETCH?", rf"{c}[0-9A-F]{{3}}", f"channel {c} on position controller A")
        self._make_ready(f"TMGC{c}", "NO")  # of whoever was here before and died
        self._set(f"RTE{c}{rate_code:03d}", f"RTE?{c}", rate_code)
        return version

    def own_limits(self) -> tuple[int, int] | None:
        """The controller's own soft limits (backward, forward) in counts; None where they are switched off."""
        c = self._digit
        if self._ask(f"SETLS?{c}", r"[01]{8}", "eight limit-switch bits")[0][0] == "0":
            return None
        backward, forward = (self._ask(f"{side}L?{c}", COUNT, "a signed position")[1] for side in "BF")
        return int(backward), int(forward)

    def counts(self) -> int:
        return int(self._ask(f"PS?{self._digit}", COUNT, "a signed position in pulses")[1])

    def status(self) -> ChannelStatus:
        match = self._ask(f"STS{self._digit}?", STATUS, "remote flag, channel, motion, status bits and position")
        bits = int(match[3] or "0", 16)
        ending = ", ".join(text for bit, text in ENDINGS.items() if bits & bit)
        return ChannelStatus(match[1] == "R", match[2] != "S" or bool(bits & 1), ending, int(match[4]), match[0])

    def standing(self, purpose: str) -> ChannelStatus:
        """The status; refuses `purpose` while the motor moves or the panel is in LOCAL."""
        status = self.status()
        if status.moving:
            raise DeviceRefused(
                self._name,
                f"{purpose} is not possible while it moves",
                reply=status.raw,
                advice="Wait for the move to end, or stop it",
                state=f"The move under way goes on; it is at {status.counts} counts",
            )
        if not status.remote:
            raise DeviceRefused(
                self._name,
                f"{purpose} is not possible: the controller is in LOCAL",
                reply=status.raw,
                advice="Wait until all its motors stand and set REMOTE on the panel",
                state="Nothing has moved",
            )
        return status

    def start(self, target: int, speed: int) -> None:
        """Begin a move to `target` counts at `speed` pulses/s."""
        self.standing("a move")
        self._take_speed(speed)
        self._begin(f"ABS{self._digit}{target:+d}", target)

    def find_home(self, speed: int) -> None:
        """Begin the search for the home switch at `speed` pulses/s; it leaves the trigger output cleared."""
        self.standing("a home search")
        self._make_ready(f"TMGC{self._digit}", "NO")
        self._take_speed(speed)
        self._begin(f"FDHP{self._digit}", None)

    def go_home(self, home: int) -> None:
        """Begin the move to the home that the search found, at the speed of the search."""
        self._begin(f"GTHP{self._digit}", home)

    def home(self) -> int | None:
        """Where the home switch was found, in counts; None where no search has found it."""
        reply = self._ask(f"SHP?{self._digit}", rf"{COUNT}|NO H\.P", "a signed position or NO H.P")
        return None if reply[1] is None else int(reply[1])

    def preset(self, counts: int) -> None:
        """Call the place where it stands `counts`."""
        self.standing("a preset")
        self._set(f"PS{self._digit}{counts:+d}", f"PS?{self._digit}", counts)

    def arm(self, mode: int, start: int, end: int, interval: int) -> None:
        """Set up the trigger output (counts) and make it ready."""
        c = self._digit
        self._line.send(f"TMGC{c}")
        self._set(f"TMGM{c}{mode}", f"TMGM?{c}", mode)
        self._set(f"TMGS{c}{start:+d}", f"TMGS?{c}", start)
        self._set(f"TMGE{c}{end:+d}", f"TMGE?{c}", end)
        self._set(f"TMGI{c}{interval}", f"TMGI?{c}", interval)
        self._make_ready(f"TMGR{c}", "YES")

    def disarm(self) -> None:
        self.standing("disarming")
        self._make_ready(f"TMGC{self._digit}", "NO")

    def slow_stop(self) -> str:
        """Send the stop command; what was sent. It waits for nothing."""
        self._line.send(command := f"SSTP{self._digit}")
        return command

    def emergency_stop(self) -> str:
        """As `slow_stop`, without deceleration."""
        self._line.send(command := f"ESTP{self._digit}")
        return command

    def close(self) -> None:
        """Give the panel back if it was in LOCAL, and free the port even where the line is dead."""
        try:
            if self._restore_local:
                self._line.send("LOC")
        finally:
            self._line.close()

    def _take_speed(self, speed: int) -> None:
        c = self._digit
        self._set(f"SPDH{c}{speed}", f"SPDH?{c}", speed)
        self._line.send(f"SPDH{c}")
        self._ask(f"SPD?{c}", "HSPD", "HSPD, the speed just selected")

    def _begin(self, command: str, target: int | None) -> None:
        """Send a command that moves and see that it does, or that it is at its target (None: no target) already."""
        self._commanded, self.last_move = True, command
        self._line.send(command)
        status = self.status()
        there = self.home() == status.counts if target is None else status.counts == target
        if not status.moving and not there:
            raise DeviceError(
                self._name,
                f"the move did not start ({status.ending or self._complaint()})",
                request=command,
                reply=status.raw,
                expected="a moving motor",
                advice="Check limit switches, the motor's driver and that the panel is in REMOTE",
                state=f"The stage stands at {status.counts} counts",
            )

    def _make_ready(self, command: str, wanted: str) -> None:
        self._line.send(command)
        reply = self._ask(f"TMGR?{self._digit}", "YES|NO", "YES or NO")[0]
        if reply != wanted:
            raise self._not_followed(command, reply, wanted)

    def _set(self, command: str, query: str, value: int) -> None:
        """Send a setting and read it back."""
        self._line.send(command)
        reply = self._ask(query, r"[+-]?\d+", f"{value}, as just set")[0]
        if int(reply) != value:
            raise self._not_followed(command, reply, str(value))

    def _not_followed(self, command: str, reply: str, wanted: str) -> DeviceError:
        return DeviceError(
            self._name,
            f"a setting was not taken ({self._complaint()})",
            request=command,
            reply=reply,
            expected=wanted,
            advice="Check that no other program or person drives this controller",
            state="Nothing has moved",
        )

    def _complaint(self) -> str:
        """The controller's own error text, then cleared."""
        text = self._ask("ERR?", r".*", "an error text")[0]
        self._line.send("ERRC")
        return f"the controller says {text}"

    def _ask(self, request: str, form: str, meaning: str) -> re.Match[str]:
        state = "A move was started before; the stage may be turning" if self._commanded else "Nothing has moved"
        return self._line.query(request, form, meaning, state)
