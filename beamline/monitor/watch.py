"""All checks together: a frame goes in, flags come out, and a scan's worth of knowledge is carried along as a value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.monitor import bands, beam, dark, mass, saturation, stuck, timing
from beamline.monitor.digest import FrameDigest
from beamline.monitor.flag import Flag, Level, ScanContext
from drivers.frame import Frame, FrameKind

CHECKS: tuple[ModuleType, ...] = (beam, saturation, stuck, bands, timing, mass, dark)
NAMES: tuple[str, ...] = tuple(module.NAME for module in CHECKS)
ALARM_SHIFT = 16  # bit i: check i flagged the frame; bit 16 + i: and it was an alarm


@dataclass(frozen=True, eq=False)
class Monitor:
    """What the monitor knows: the scan, each check's state, and how many references its means are made of."""

    context: ScanContext
    states: tuple[Any, ...]
    counted: int = 0
    kind: FrameKind = FrameKind.INVALID


def start(context: ScanContext, thresholds: Mapping[str, Mapping[str, float]] | None = None) -> Monitor:
    """A fresh watch. `thresholds` gives, per check, the limits that differ from its defaults.

    Raises:
        ConfigError: a check or a limit that does not exist; the message names the legal ones.
    """
    thresholds = thresholds or {}
    for name in thresholds:
        if name not in NAMES:
            raise ConfigError(f"monitor.thresholds names a check {name!r}; legal: {', '.join(NAMES)}")
    return Monitor(context, tuple(module.State(limits=_limits(module, thresholds)) for module in CHECKS))


def watch(before: Monitor, frame: Frame, digest: FrameDigest) -> tuple[Monitor, tuple[Flag, ...]]:
    """Look at a frame: the watch with it, and what the checks found. O(pixels of the preview)."""
    flags: list[Flag] = []
    states: list[Any] = []
    for module, state in zip(CHECKS, before.states, strict=True):
        state, flag = module.check(state, frame, digest, before.context)
        states.append(state)
        flags += [] if flag is None else [flag]
    return replace(_remember(before, frame, digest), states=tuple(states)), tuple(flags)


def bitmask(flags: Iterable[Flag]) -> int:
    """The flags as bits, in the order of NAMES; see ALARM_SHIFT."""
    bits = 0
    for flag in flags:
        bit = 1 << NAMES.index(flag.check)
        bits |= bit | (bit << ALARM_SHIFT if flag.level is Level.ALARM else 0)
    return bits


def _limits(module: ModuleType, thresholds: Mapping[str, Mapping[str, float]]) -> Any:
    given = dict(thresholds.get(module.NAME, {}))
    legal = [field.name for field in fields(module.Limits)]
    for name in given:
        if name not in legal:
            raise ConfigError(
                f"monitor.thresholds.{module.NAME} has no limit {name!r}; legal: {', '.join(legal) or 'none'}"
            )
    return module.Limits(**given)


def _remember(before: Monitor, frame: Frame, digest: FrameDigest) -> Monitor:
    """Mean previews of the latest group of darks and of flats."""
    counted = before.counted + 1 if frame.kind is before.kind else 1
    context = before.context
    if frame.kind is FrameKind.DARK:
        context = replace(context, dark=_mean(context.dark, digest.preview, counted))
    elif frame.kind is FrameKind.FLAT:
        context = replace(context, flat=_mean(context.flat, digest.preview, counted), flat_exposure=frame.exposure)
    return replace(before, context=context, counted=counted, kind=frame.kind)


def _mean(so_far: NDArray[np.float32] | None, preview: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    return preview if so_far is None or n == 1 else so_far + (preview - so_far) / np.float32(n)
