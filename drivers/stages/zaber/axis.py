"""One axis of a Zaber device in the device's own units: microsteps, native speeds, settings, flags, and its replies.

Every command except a stop has its own message id and waits for its reply, which accepts or rejects it.
"""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import dataclass

from drivers.base.clock import Clock
from drivers.base.errors import DeviceRefused
from drivers.serial.line import Probe, line_to
from drivers.stages.shared import FoundSettings, while_it_moves
from drivers.stages.zaber.packet import (
    INTERRUPTED,
    REASONS,
    SLIPPED,
    UNREFERENCED,
    Reply,
    damage,
    encode,
    passed_over_form,
    reply_form,
)
from drivers.stages.zaber.settings import ZaberSettings

PROBE_ID, STOP_ID, IDS = 98, 99, 98  # Ordinary commands count their ids from 0 to 97
REPEATS = 3  # How often a command is sent again if the device answers AGAIN
PAUSE = 0.05  # s before that
TEXT, WHOLE, NUMBER = r"[^:]*", r"-?\d{1,12}", r"-?\d{1,12}(?:\.\d{1,12})?"
"""Most digits of a position; a longer number is impossible for an axis and for a float."""
CHECKSUM = "comm.checksum"
KEPT = ("maxspeed", "motion.accelonly", "motion.decelonly")
"""Settings of the axis that survive a power cycle; the driver restores them, and the device's checksums, at the end."""


@dataclass(frozen=True)
class ZaberAxisStatus:
    """Position in microsteps, motion, and every warning flag, the gravest first."""

    counts: int
    moving: bool
    flags: tuple[str, ...]
    raw: str

    @property
    def referenced(self) -> bool:
        return UNREFERENCED.isdisjoint(self.flags)

    @property
    def grave(self) -> frozenset[str]:
        """Flags of faults, and of a stage that slipped or was moved, whatever the last move did."""
        return frozenset(flag for flag in self.flags if flag.startswith("F")) | (SLIPPED & set(self.flags))


class ZaberAxis:
    """Controls one axis of one device, and the device itself.

    Raises (here and in all methods):
        DeviceRefused: the device rejects a command. DeviceError: a wrong or damaged reply.
        DeviceTimeout: no reply.
    """

    def __init__(self, url: str, settings: ZaberSettings, clock: Clock, name: str) -> None:
        self._name, self._device, self._axis, self._clock = name, settings.device, settings.axis, clock
        self._ids = itertools.cycle(range(IDS))
        self._must_have_checksum = self._commanded = False
        self.last_move = ""
        """The command of the last move or search, for errors."""
        self.found = FoundSettings()
        self.flags_at_opening: tuple[str, ...] = ()
        """Without that of a stop, which says nothing of where the stage is."""
        self._line = line_to(
            settings,
            url,
            name,
            clock,
            Probe(encode(self._device, 0, PROBE_ID, ""), reply_form(self._device, 0, PROBE_ID, TEXT)),
            unsolicited=passed_over_form(STOP_ID),
            identified=True,
            check=lambda line: damage(line, must_have_checksum=self._must_have_checksum),
        )

    def open(self) -> dict[str, str]:
        """Switch checksums on, identify the device, remember the settings that will change."""
        self._line.send("")  # an empty line ends an incomplete command in the device
        if (checksums := self.get_if_known(CHECKSUM, 0)) is not None:
            self.ask(f"set {CHECKSUM} 1")
            self._must_have_checksum = True
        number = self.get_if_known("device.id", 0) or self.ask("get deviceid", WHOLE)
        serial, firmware = self.ask("get system.serial", WHOLE), self.ask("get version", NUMBER)
        self.flags_at_opening = tuple(flag for flag in self.standing("opening").flags if flag != INTERRUPTED)
        self.found.values = {setting: self.ask_axis(f"get {setting}", NUMBER) for setting in KEPT}
        if checksums is not None:
            self.found.values[CHECKSUM] = checksums
        return {"model": f"Zaber device {number}", "serial": serial, "firmware": firmware}

    def status(self) -> ZaberAxisStatus:
        reply = self._ask(self._axis, "get pos", WHOLE)
        flags = self.ask_axis("warnings", r"\d+(?: \w\w)*").split()[1:] if reply.flag else ()
        return ZaberAxisStatus(int(reply.data), reply.busy, tuple(flags), reply.raw)

    def standing(self, purpose: str) -> ZaberAxisStatus:
        """The status; refuses `purpose` while the axis moves."""
        status = self.status()
        if status.moving:
            raise while_it_moves(self._name, purpose, status.counts, status.raw)
        return status

    def begin(self, words: str) -> None:
        """Begin a move or a search."""
        self._commanded, self.last_move = True, words
        self.ask_axis(words)

    def stop(self, words: str) -> str:
        """Send `stop` or `estop` without waiting, and return it; its reply is skipped when it comes."""
        self._line.send(packet := encode(self._device, self._axis, STOP_ID, words))
        return packet

    def ask(self, words: str, form: str = TEXT) -> str:
        """Data of the reply of the device itself."""
        return self._ask(0, words, form).data

    def ask_axis(self, words: str, form: str = TEXT) -> str:
        return self._ask(self._axis, words, form).data

    def get_if_known(self, setting: str, axis: int) -> str | None:
        """A setting of an axis, or of the device itself (0); None if it has no such setting."""
        with contextlib.suppress(DeviceRefused):
            return self._ask(axis, f"get {setting}", NUMBER).data
        return None

    def close(self) -> None:
        """Restore the settings, and free the port even if the line is dead."""
        try:
            self.found.restore(self._restore)
        finally:
            self._line.close()

    def _restore(self, setting: str, value: str) -> None:
        if setting == CHECKSUM:
            self._must_have_checksum = value == "1"
        self._ask(0 if setting == CHECKSUM else self._axis, f"set {setting} {value}", TEXT)

    def _ask(self, axis: int, words: str, form: str) -> Reply:
        for _ in range(REPEATS):
            reply = self._exchange(axis, words, form)
            if reply.accepted or reply.data != "AGAIN":
                break
            self._clock.sleep(PAUSE)
        if not reply.accepted:
            raise DeviceRefused(
                self._name,
                f"it rejects this: {REASONS.get(reply.data, 'a reason that this driver does not know')} ({reply.data})",
                request=words,
                reply=reply.raw,
                advice="Check the configuration against the device, and that no other program drives it",
                state="The move under way goes on" if reply.busy else "Nothing has moved by it",
            )
        return reply

    def _exchange(self, axis: int, words: str, form: str) -> Reply:
        state = "A move was started before; the stage may be turning" if self._commanded else "Nothing has moved"
        identity = next(self._ids)
        request, meaning = encode(self._device, axis, identity, words), f"the reply to message {identity:02d}"
        return Reply.of(self._line.query(request, reply_form(self._device, axis, identity, form), meaning, state))
