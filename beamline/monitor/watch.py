"""Monitor: all checks together. A frame goes in, flags come out; what is known of the scan so far is a value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.monitor.check import Check, Flag, ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest
from drivers.frame import Frame, FrameKind


@dataclass(frozen=True, eq=False)
class Monitor:
    """What the monitor knows after the frames so far.

    Attributes:
        context: the scan, and the mean references of the latest groups.
        checks: with their limits.
        states: of the checks, in their order.
        kind, counted: of the latest group of frames: their kind, and how many there are.
    """

    context: ScanContext
    checks: tuple[Check, ...]
    states: tuple[Any, ...]
    kind: FrameKind = FrameKind.INVALID
    counted: int = 0


def start(context: ScanContext, checks: Sequence[Check] = CHECKS) -> Monitor:
    """A monitor before the first frame."""
    return Monitor(context, tuple(checks), tuple(check.start() for check in checks))


def look(monitor: Monitor, frame: Frame, digest: FrameDigest) -> tuple[Monitor, tuple[Flag, ...]]:
    """Look at the next frame: the monitor after it, and what the checks found. O(pixels of the preview)."""
    looks = [
        check.look(state, frame, digest, monitor.context)
        for check, state in zip(monitor.checks, monitor.states, strict=True)
    ]
    after = replace(_with_reference(monitor, frame, digest), states=tuple(look.state for look in looks))
    return after, tuple(look.flag for look in looks if look.flag is not None)


def _with_reference(monitor: Monitor, frame: Frame, digest: FrameDigest) -> Monitor:
    """The monitor with the frame's preview in the mean of its group, where it is a dark or a flat."""
    counted = monitor.counted + 1 if frame.kind is monitor.kind else 1
    context = monitor.context
    if frame.kind is FrameKind.DARK:
        context = replace(context, dark=_mean(context.dark, digest.preview, counted))
    elif frame.kind is FrameKind.FLAT:
        context = replace(context, flat=_mean(context.flat, digest.preview, counted), flat_exposure=frame.exposure)
    return replace(monitor, context=context, counted=counted, kind=frame.kind)


def _mean(so_far: NDArray[np.float32] | None, preview: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    return preview if so_far is None or n == 1 else so_far + (preview - so_far) / np.float32(n)
