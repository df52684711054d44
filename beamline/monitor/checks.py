"""Registry of the monitor's checks, and the bits by which a file says which of them flagged a frame.

To add a check: write its file beside the others and enter it in CHECKS. Configuration, bitmask, legend of the file and
`beamline info` follow from the entry.
"""

from __future__ import annotations

from collections.abc import Iterable

from beamline.monitor.bands import Bands
from beamline.monitor.beam import Beam
from beamline.monitor.check import Check, Flag, Level
from beamline.monitor.dark import Dark
from beamline.monitor.mass import Mass
from beamline.monitor.saturation import Saturation
from beamline.monitor.stuck import Stuck
from beamline.monitor.timing import Timing

ALARM_SHIFT = 16  # bit b: the check with this bit flagged the frame; bit 16 + b: and it was an alarm


def _registry(*checks: Check) -> tuple[Check, ...]:
    """The checks with their default limits, refused where two share a name or a bit, or a bit has no place."""
    names, bits = {check.name for check in checks}, {check.bit for check in checks}
    if min(len(names), len(bits)) < len(checks) or not bits <= set(range(ALARM_SHIFT)):
        taken = ", ".join(f"{check.name} {check.bit}" for check in checks)
        raise ValueError(f"every check needs a name and a bit (0 ... {ALARM_SHIFT - 1}) of its own, got {taken}")
    return checks


CHECKS: tuple[Check, ...] = _registry(
    Beam(),
    Saturation(),
    Stuck(),
    Bands(),
    Timing(),
    Mass(),
    Dark(),
)

_BITS = {check.name: check.bit for check in CHECKS}


def bitmask(flags: Iterable[Flag]) -> int:
    """The flags of a frame as 32 bits; see ALARM_SHIFT."""
    bits = 0
    for flag in flags:
        bit = 1 << _BITS[flag.check]
        bits |= bit | (bit << ALARM_SHIFT if flag.level is Level.ALARM else 0)
    return bits
