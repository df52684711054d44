"""Bands: rows that turn dark while the others do not, as after a readout fault or a lost packet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.preview import light, thinned
from drivers.frame import Frame, FrameKind

CALIBRATION = 5  # frames of a kind before a verdict
MEMORY = 0.2  # weight of the newest frame in the reference
SIGMAS = 8.0
PATIENCE = 20  # flagged frames in a row after which the change is the new normal: the sample, not the camera


@dataclass(frozen=True, eq=False)
class Profile:
    """Per preview row: the logarithm of its usual light, its usual change from frame to frame, and how often seen."""

    usual: NDArray[np.float64]
    change: NDArray[np.float64]
    seen: int = 1
    flagged: int = 0


@dataclass(frozen=True, eq=False)
class BandsState:
    """The profiles of projections and of flats, None before the first."""

    projection: Profile | None = None
    flat: Profile | None = None


@dataclass(frozen=True)
class Bands:
    """Score: the largest fraction of light that a preview row has lost. A row's light is its median over columns."""

    name: ClassVar[str] = "bands"
    bit: ClassVar[int] = 3
    unit: ClassVar[str] = "fraction of the row's light"
    meaning: ClassVar[str] = "rows lost light against their own past while the other rows did not: a dark band"
    policy: ClassVar[Policy] = Policy.LOG

    alarm: Annotated[
        float,
        Field(ge=0, description="fraction of light that a preview row may lose against its past and the other rows"),
    ] = 0.15

    def start(self) -> BandsState:
        return BandsState()

    def look(self, state: BandsState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[BandsState]:
        if frame.kind is FrameKind.PROJECTION:
            profile, flag = self._compare(state.projection, frame.index, digest, context)
            return Look(replace(state, projection=profile), flag)
        if frame.kind is FrameKind.FLAT:
            profile, flag = self._compare(state.flat, frame.index, digest, context)
            return Look(replace(state, flat=profile), flag)
        return Look(state)

    def _compare(
        self, profile: Profile | None, view: int, digest: FrameDigest, context: ScanContext
    ) -> tuple[Profile, Flag | None]:
        """Compare a frame's rows with the profile of its kind: the profile after it, and the finding."""
        blocks = light(digest.preview, context, thinned(digest.preview, rows=False))
        rows = np.log(np.maximum(np.median(blocks, axis=1), 0.5).astype(np.float64))
        if profile is None or profile.usual.shape != rows.shape:
            return Profile(rows, np.zeros_like(rows)), None
        deviation = rows - profile.usual
        deviation -= np.median(deviation)  # the beam dims all rows alike
        loss = 1 - np.exp(deviation)
        limit = np.maximum(self.alarm, SIGMAS * profile.change)
        dark = np.flatnonzero(loss > limit)
        if profile.seen >= CALIBRATION and dark.size and profile.flagged < PATIENCE:
            worst = int(dark[np.argmax(loss[dark])])
            advice = (
                f"{dark.size} of {rows.size} preview rows (from {dark[0]}) lost up to {loss[worst]:.0%} of their light "
                "at once: a dark band. Check the camera's link and readout; repeat the view."
            )
            flag = Flag(self.name, Level.ALARM, view, float(loss[worst]), float(limit[worst]), advice)
            return replace(profile, flagged=profile.flagged + 1), flag
        weight = max(MEMORY, 1 / (profile.seen + 1))
        return Profile(
            usual=profile.usual + weight * (rows - profile.usual),
            change=profile.change + weight * (np.abs(deviation) - profile.change),
            seen=profile.seen + 1,
        ), None
