"""Lost beam: for a time there is no light, or less of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from simulators.effects.anomaly import Label, Views, within
from simulators.effects.chain import Anomaly, ImageEffect
from simulators.frame.mapping import BelowOne
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class LostBeam(ImageEffect, Anomaly):
    """The beam is off for a range of views or of time; a frame loses the light of the overlap.

    Attributes:
        views: [first, one after the last]; flats taken just before one of them lose their light, too.
        seconds: [from, to] since the camera was connected.
        share: of the light that is left.
    """

    views: Views | None = None
    seconds: tuple[float, float] | None = None
    share: BelowOne = 0.0

    def __post_init__(self) -> None:
        if (self.views is None) == (self.seconds is None):
            raise ValueError("a lost beam needs either views or seconds, and not both")
        if self.seconds is not None and not self.seconds[0] < self.seconds[1]:
            raise ValueError(f"seconds must be [from, to] with from < to, got {list(self.seconds)}")

    def apply(self, image: Image, shot: Shot) -> Image:
        lost = self._lost(shot)
        if lost > 0:
            image *= 1 - lost
        return image

    def labels(self, shot: Shot) -> Sequence[Label]:
        rows, cols = shot.detector.shape
        return [Label(self.name, (0, rows, 0, cols))] if shot.beam and self._lost(shot) > 0 else []

    def _lost(self, shot: Shot) -> float:
        """Share of the frame's light that is lost."""
        if self.seconds is None:
            return 1 - self.share if within(self.views, shot) else 0.0
        # In seconds of this exposure, so that rounding cannot remove more than all light.
        begin, end = (at - shot.elapsed for at in self.seconds)
        off = min(end, shot.exposure) - max(begin, 0.0)
        return (1 - self.share) * max(off, 0.0) / shot.exposure
