"""The fault table: each fault, how a scan must end after it, and the faults that a controller cannot have.

docs/faults.md has a row for each of these, with the same names; `test_page` keeps them the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from beamline.core.errors import ConfigError
from beamline.scan.ledger import LedgerError
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from tests.drivers.faults.rig import DARKS, FLATS, KINDS, VIEWS, Phase, Rig
from tests.messages import SUFFIX, read

TESTS = Path(__file__).parents[2]
FIRST_VIEW = DARKS + FLATS
"""Row of the file."""
BETWEEN = 21_000
"""Counts between views 5 and 6, which are at 20 and 22 degrees."""


@dataclass(frozen=True)
class LineFault:
    """Something happens to one reply on the serial line.

    Attributes:
        spoil: the reply as it arrives instead; the same where it is the next one's turn.
        error: the class of the error; `words`: a part of its message, which the page quotes too.
        replied: something arrived, which the error must show.
        phases: of the scan, in which it is tried.
        not_on: controller -> why it cannot happen there.
        harmless_on: controller -> why the scan is complete in spite of it.
    """

    fault: str
    spoil: Callable[[Rig, bytes], bytes]
    error: type[DeviceError]
    words: str
    replied: bool
    phases: tuple[Phase, ...] = (Phase.OPENING, Phase.TURNING)
    not_on: Mapping[str, str] = field(default_factory=dict)
    harmless_on: Mapping[str, str] = field(default_factory=dict)


def _garbage(rig: Rig, reply: bytes) -> bytes:
    end = rig.kind.line_end
    return b"\xfe\x00" + reply.removesuffix(end)[::-1] + end


def _changed(rig: Rig, reply: bytes) -> bytes:
    """Another digit, in a reply that has a checksum."""
    return reply.replace(b"0", b"8", 1) if b":" in reply else reply


LINE: tuple[LineFault, ...] = (
    LineFault("no reply", lambda rig, reply: b"", DeviceTimeout, "no whole reply within 1 s", False, tuple(Phase)),
    LineFault(
        "garbage",
        _garbage,
        DeviceError,
        "the reply does not have the expected form",
        replied=True,
    ),
    LineFault(
        "half a reply",
        lambda rig, reply: reply[: max(1, (len(reply) - len(rig.kind.line_end)) // 2)],
        DeviceTimeout,
        "no whole reply within 1 s",
        replied=True,
    ),
    LineFault(
        "wrong checksum",
        _changed,
        DeviceError,
        "the reply was damaged on the way",
        replied=True,
        not_on={
            "pm16c": "its lines carry no checksum: a changed digit is noticed where settings are read back",
            "pi_gcs": "its lines carry no checksum: a changed digit is noticed where settings are read back",
        },
    ),
    LineFault(
        "echo",
        lambda rig, reply: rig.cable.last_request + reply,
        DeviceError,
        "the reply does not have the expected form",
        replied=True,
        harmless_on={"zaber": "what a host sends begins with another sign than a reply, and is passed over"},
    ),
    LineFault(
        "a line that nobody asked for",
        lambda rig, reply: rig.kind.unasked(rig.controller) + reply,
        DeviceError,
        "the reply does not have the expected form",
        replied=True,
        harmless_on={
            "pm16c": "it tells of stops without being asked; such a line is passed over",
            "zaber": "alerts are marked as such and passed over",
        },
    ),
)


def phases_of(kind: str, row: LineFault) -> Sequence[Phase]:
    """Those in which a fault is tried on a controller: each on the first one that it stops, and the other ones that it
    stops share them; the last one where it is harmless."""
    stopped = [each for each in KINDS if each not in row.not_on and each not in row.harmless_on]
    if kind not in stopped:
        return row.phases[-1:]
    n = stopped.index(kind)
    return row.phases[n - 1 :: len(stopped) - 1] if n else row.phases


def slow_but(kind: str) -> list[pytest.MarkDecorator]:
    """No mark for the first controller; the others are slow."""
    return [pytest.mark.slow] * (kind != next(iter(KINDS)))


def one_quick_each(rows: Sequence[Any]) -> list[Any]:
    """For `parametrize`: each row with each controller; one is quick, in turn from row to row, the others slow."""
    return [
        pytest.param(row, kind, id=f"{row.fault}-{kind}", marks=[pytest.mark.slow] * ((n - k) % len(KINDS) > 0))
        for n, row in enumerate(rows)
        for k, kind in enumerate(KINDS)
    ]


UNPLUGGED, PORT_FAILED = "stage unplugged", "the port failed"
"""In each phase with the next request, and while the stage turns and nobody asks it. The words of the error."""
NOT_RESTORED: Mapping[str, str] = MappingProxyType(
    {
        kind: f"an earlier program that was killed, or lost the connection, changed {settings}; "
        "the original values are restored at the end"
        for kind, settings in {
            "pm16c": r"RTE 042 for 024, SPDH \d+ for 1000",
            "pi_gcs": r"VEL \d+\.0{6} for 10\.0{6}, SPA 0xB 60\.0{6} for 100\.0{6}, SPA 0xC 60\.0{6} for 100\.0{6}",
            "zaber": r"maxspeed \d+ for 16384, motion\.accelonly \d+ for 100, motion\.decelonly \d+ for 100, "
            r"comm\.checksum 1 for 0",
        }.items()
    }
)
"""Controller -> what the next scan tells of a stage that was unplugged: its settings could not be restored."""


@dataclass(frozen=True)
class MotionFault:
    """Something stops the stage between views 5 and 6.

    Attributes:
        breaks: arranges it before the scan.
        says: controller -> what the error says besides that it stopped short.
        flags: controller -> what the next scan tells, of flags that it keeps: the place may not be what it counts.
    """

    fault: str
    breaks: Callable[[Rig], None]
    says: Mapping[str, str]
    words: str = "it stopped short of"
    flags: Mapping[str, str] = field(default_factory=dict)


def _stop_after_view_5(rig: Rig) -> None:
    rig.at_frame[FIRST_VIEW + 5] = rig.stop_from_elsewhere


MOTION: tuple[MotionFault, ...] = (
    MotionFault(
        "fault in motion",
        lambda rig: rig.block(stall_at=BETWEEN),
        {"pm16c": "emergency stop", "pi_gcs": "error 1024", "zaber": r"stalled and stopped \(FS\)"},
        flags={"zaber": r"stalled and stopped \(FS\)"},
    ),
    MotionFault(
        "limit switch",
        lambda rig: rig.block(switch_at=BETWEEN),
        {"pm16c": "limit", "pi_gcs": "positive limit switch", "zaber": r"limit error \(FE\)"},
        flags={"zaber": r"limit error \(FE\), reached a limit switch at an unexpected position \(WL\)"},
    ),
    MotionFault(
        "stopped by somebody else",
        _stop_after_view_5,
        {"pm16c": "stop command", "pi_gcs": "error 10", "zaber": r"movement interrupted \(NI\)"},
    ),
)


@dataclass(frozen=True)
class PulseFault:
    """The trigger cable loses pulses or picks some up.

    Attributes:
        missing: views.
        invalid: rows without a trigger.
    """

    fault: str
    breaks: Callable[[Rig], None]
    words: str
    missing: tuple[int, ...] = ()
    invalid: int = 0


def _lose(*pulses: int) -> Callable[[Rig], None]:
    def breaks(rig: Rig) -> None:
        rig.trigger_cable.lost = frozenset(pulses)

    return breaks


def _pick_up(*after: int) -> Callable[[Rig], None]:
    def breaks(rig: Rig) -> None:
        rig.trigger_cable.picked_up_after = frozenset(after)

    return breaks


PULSES: tuple[PulseFault, ...] = (
    PulseFault("pulses lost on the way", _lose(3, 7, 8), "projections are missing: 3, 7-8", (3, 7, 8)),
    PulseFault(
        "fewer pulses than planned",
        _lose(9, 10, 11),
        "projections are missing: 9-11",
        (9, 10, 11),
    ),
    PulseFault("extra pulses", _pick_up(2, 6), "frames came without a trigger", invalid=2),
)
"""Beyond the controllers, but run on each: their pulses differ in width and in when they are on the line."""

CAMERA_KIND = "pm16c"
"""What the camera does is the same with every controller, so its faults run on one."""


@dataclass(frozen=True)
class CameraFault:
    """`test_camera` has a test of the fault's name; the scan ends with this error, which has these words."""

    fault: str
    error: type[Exception]
    words: str


CAMERA: tuple[CameraFault, ...] = (
    CameraFault("camera absent at start", DeviceError, "DCAM finds no camera"),
    CameraFault("an error of the library", DeviceError, "the camera's library reports an error"),
    CameraFault("camera unplugged", DeviceError, "NOCONNECTION"),
    CameraFault("setting refused", DeviceRefused, "it rejects EXPOSURETIME"),
    CameraFault("frame lost in the camera", LedgerError, "Exposed, but never delivered by the camera"),
    CameraFault("ring overrun", LedgerError, "projections are missing"),
    CameraFault("triggers planned too fast", ConfigError, "set scan.period_s >="),
    CameraFault("triggers too fast", LedgerError, "gave no frame, because the camera was not ready"),
    CameraFault("slow link", LedgerError, "`beamline check --connect` tests the link of the camera"),
)


@dataclass(frozen=True)
class FaultElsewhere:
    """A fault whose test is with the driver or the scan: `test` is its file, under tests, and its name."""

    fault: str
    words: str
    test: tuple[str, str]


OF_LINES = (
    FaultElsewhere(
        "two controllers with one address (Zaber)",
        "two devices answered one request",
        ("drivers/stages/zaber/test_stage.py", "test_two_devices_with_one_address_are_refused_before_anything_moves"),
    ),
    FaultElsewhere(
        "another device at the port",
        "another device answered",
        ("drivers/stages/test_every_stage.py", "test_the_configured_serial_number_is_required"),
    ),
    FaultElsewhere(
        "a terminal server in Telnet mode, one that asks for a login, the port of another service",
        "the server uses Telnet",
        ("drivers/stages/test_terminal_server.py", "test_who_speaks_in_the_place_of_the_controller_is_named"),
    ),
    FaultElsewhere(
        "a terminal server that closes the connection (no traffic, another client)",
        "the other side closed the connection",
        ("drivers/stages/test_terminal_server.py", "test_a_server_that_closes_a_connection_is_told_from_a_cable"),
    ),
    FaultElsewhere(
        "another protocol (Zaber's Binary), another baud rate",
        "it contains bytes that are not text",
        ("drivers/serial/test_line.py", "test_bytes_that_are_no_text_are_refused_in_a_reply_of_any_form"),
    ),
    FaultElsewhere(
        "no right to the port, or another program holds it",
        "belongs to the group",
        ("drivers/base/test_causes.py", "test_the_group_that_owns_a_port_is_named"),
    ),
)
OF_MOTION = (
    FaultElsewhere(
        "a slip: stalled and recovered, displaced, moved by its knob (Zaber WS, WM, NC); an error of the motion "
        "(PI 504, 1024, 1025)",
        "disturbed since its last move",
        ("drivers/stages/zaber/test_stage.py", "test_a_slip_between_two_moves_is_told_once_by_the_next"),
    ),
    FaultElsewhere(
        'step scan: the stage moved after it had arrived (another program, the panel, a hunting servo, a "done" that '
        "comes too early)",
        "the frame was exposed while the stage was not at the planned angle",
        ("beamline/scan/test_moved_while_exposed.py", "test_a_view_during_which_it_is_moved_is_taken_again"),
    ),
    FaultElsewhere(
        "filter, sample mover, monochromator or shutter moved during a block",
        "The device was moved while",
        ("beamline/scan/test_moved_while_exposed.py", "test_a_device_in_the_beam_that_is_moved_ends_the_scan"),
    ),
)

OF_CAMERA = (
    FaultElsewhere(
        "the camera's library hangs, or crashes",
        "ends every process that loads it",
        ("drivers/dcam/test_abi.py", "test_a_library_that_would_end_or_hang_this_process_is_refused"),
    ),
)

_FAULTS: tuple[tuple[Any, ...], ...] = (LINE, OF_LINES), (MOTION, OF_MOTION, PULSES, CAMERA, OF_CAMERA)
WORDS: Mapping[str, str] = MappingProxyType(
    {row.fault: row.words for rows in _FAULTS[0] for row in rows}
    | {UNPLUGGED: PORT_FAILED}
    | {row.fault: row.words for rows in _FAULTS[1] for row in rows}
)
"""Every fault, in the order of docs/faults.md -> words that the operator sees."""


def applies() -> None:
    """Every controller that a row speaks of exists, and no row is silent on a controller without saying why."""
    for row in LINE:
        assert set(row.not_on) <= set(KINDS) and set(row.harmless_on) <= set(KINDS)
        assert all(row.not_on.values()) and all(row.harmless_on.values())
    assert all(set(row.says) == set(KINDS) for row in MOTION)
    for elsewhere in (*OF_LINES, *OF_MOTION, *OF_CAMERA):
        path, name = elsewhere.test
        text = (TESTS / path).read_text(encoding="utf-8")
        messages = read((TESTS / path).with_suffix(SUFFIX)).values()
        assert f"def {name}(" in text, elsewhere.fault
        assert any(elsewhere.words in words for words in (text, *chain(*messages))), elsewhere.fault
    assert VIEWS == 12
