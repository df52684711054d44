"""The registry of the monitor's checks, and the bits with which a file records the checks that flagged a frame.

To add a check, add its file in this folder and a line in REGISTRY, or in CHECKS of a folder of checks. Its keys in the
configuration, its bits and its legend in a scan file, and its name in `beamline info` then follow automatically.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields
from importlib import import_module
from operator import attrgetter

from beamline.monitor.check import Check, Flag, Level
from recon.base.registry import Registry, in_folders

ALARM_SHIFT = 16  # bit b: the check with this bit flagged the frame; bit 16 + b: the flag was an alarm
BITS = (*range(16), *range(32, 48))  # bits that a check may have, the next free one first
ALARMS = sum(1 << bit + ALARM_SHIFT for bit in BITS)  # if a frame has one of these bits, it has an alarm


REGISTRY = {  # for the class of a check, its module in this folder
    "BeamCheck": "beam",
    "SaturationCheck": "frames",
    "StuckCheck": "frames",
    "TimingCheck": "frames",
    "MassCheck": "field",
    "DarkCheck": "frames",
    "LostCheck": "frames",
    "MotionCheck": "motion",
    "PixelsCheck": "field",
    "FieldOfViewCheck": "field",
    "OppositeCheck": "opposite",
}


def _distinct(*checks: Check) -> tuple[Check, ...]:
    """The checks; ValueError if two share a name or a bit, or a bit is outside the mask."""
    names, bits = {check.name for check in checks}, {check.bit for check in checks}
    if min(len(names), len(bits)) < len(checks) or not bits <= set(BITS):
        taken = ", ".join(f"{check.name} {check.bit}" for check in checks)
        raise ValueError(f"every check needs its own name and bit (0 ... 15, 32 ... 47), got {taken}")
    return checks


def _all(ours: tuple[Check, ...]) -> Registry[Check]:
    """These checks and those of other packages."""
    all_checks = ours

    def entry(name: str, kind: Callable[[], Check]) -> Check:
        nonlocal all_checks
        check = kind()
        if check.name != name:
            raise ValueError(
                f"the class of this check has the name {check.name!r}; expected the name of its entry point"
            )
        _ = check.policy, check.unit, check.meaning, check.start(), fields(check)
        all_checks = _distinct(*all_checks, check)
        return check

    return Registry("check", {check.name: check for check in ours}, entry)


_MODULES = {name: f"beamline.monitor.{module}" for name, module in REGISTRY.items()}
_CLASSES = {**_MODULES, **in_folders("beamline.monitor", "CHECKS")}
_OURS = _distinct(
    *sorted((getattr(import_module(module), name)() for name, module in _CLASSES.items()), key=attrgetter("bit"))
)
BY_NAME = _all(_OURS)
CHECKS: tuple[Check, ...] = tuple(BY_NAME.values())
"""All checks with their default limits, in the order of their bits. In this order they check a frame."""

_BITS = {check.name: check.bit for check in CHECKS}


def flagged_frames(flags: Iterable[Flag]) -> dict[tuple[str, Level], set[int]]:
    """Number of frames of a file by check and level. If a check gave a frame a warning and an alarm, the alarm
    counts."""
    frames: dict[tuple[str, Level], set[int]] = {}
    for flag in flags:
        frames.setdefault((flag.check, flag.level), set()).update(flag.frames)
    for check, level in frames:
        if level is Level.WARN:
            frames[check, level] -= frames.get((check, Level.ALARM), set())
    return {key: rows for key, rows in frames.items() if rows}


def bitmask(flags: Iterable[Flag]) -> int:
    """The flags of a frame as 64 bits; see ALARM_SHIFT. An INFO has no bit, because nothing is wrong with the frame."""
    bits = 0
    for flag in flags:
        if flag.level is Level.INFO:
            continue
        bit = 1 << _BITS[flag.check]
        bits |= bit | (bit << ALARM_SHIFT if flag.level is Level.ALARM else 0)
    return bits
