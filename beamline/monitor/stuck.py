"""Stuck: the same image twice. Noise never repeats, so an equal checksum is a frame that was delivered again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import ClassVar

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind


@dataclass(frozen=True)
class StuckState:
    """Checksum and facts of the frame before.

    Attributes:
        checksum, angle: of it.
        repeats: how many frames in a row have had this checksum.
        noiseless: darks or flats of a single grey value repeat: a simulation without noise.
    """

    checksum: int | None = None
    angle: float = nan
    repeats: int = 0
    noiseless: bool = False


@dataclass(frozen=True)
class StuckCheck:
    """No limits: one repetition is one too many. Score: repetitions in a row."""

    name: ClassVar[str] = "stuck"
    bit: ClassVar[int] = 2
    unit: ClassVar[str] = "repetitions"
    meaning: ClassVar[str] = "the image equals the one before, pixel for pixel: the camera delivered a frame twice"
    policy: ClassVar[Policy] = Policy.LOG

    start = StuckState

    def look(self, state: StuckState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[StuckState]:
        """Compare checksums. Without noise, references of one kind and the frames of a view are alike."""
        plain = digest.variance == 0 and frame.kind is not FrameKind.PROJECTION
        alike = digest.checksum == state.checksum
        as_before = frame.kind is not FrameKind.PROJECTION or frame.angle == state.angle
        state = replace(
            state, checksum=digest.checksum, angle=frame.angle, noiseless=state.noiseless or (plain and alike)
        )
        if not alike or plain or (state.noiseless and as_before):
            return Look(replace(state, repeats=0))
        state = replace(state, repeats=state.repeats + 1)
        advice = (
            f"Pixel for pixel the frame before, {state.repeats} time{'s' if state.repeats > 1 else ''} in a row: "
            "the camera or its driver repeats a buffer. Stop and restart the camera."
        )
        return Look(state, Flag(self.name, Level.ALARM, frame.index, state.repeats, 0, advice))
