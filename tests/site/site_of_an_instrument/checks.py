"""A check of the monitor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from beamline.monitor.check import CheckResult, Flag, Level, Policy, ScanContext
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame
from recon.base.setting import setting


@dataclass(frozen=True)
class Half:
    """Flags a frame with less than a share of the most light so far."""

    name: ClassVar[str] = "half"
    bit: ClassVar[int] = 47
    unit: ClassVar[str] = "share"
    meaning: ClassVar[str] = "the frame has far less light than one before it"
    policy: ClassVar[Policy] = Policy.LOG
    share: float = setting(0.5, "Of the most light so far.", gt=0)

    def start(self) -> float:
        return 0.0

    def look(self, state: float, frame: Frame, digest: FrameDigest, context: ScanContext) -> CheckResult[float]:
        light = float(frame.counts.mean())
        if light >= self.share * state:
            return CheckResult(max(state, light))
        return CheckResult(
            state, Flag(self.name, Level.WARN, frame.index, light / state, self.share, "Look at the shutter.")
        )
