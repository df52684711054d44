"""Ring current: it decays and is topped up, and the beam is proportional to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from simulators.effects.chain import ImageEffect
from simulators.frame.mapping import NotNegative, Positive
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class RingCurrent(ImageEffect):
    """The current decays as exp(-t/lifetime) and returns to full at each top-up. The ring is full when the camera is
    connected.

    A frame gets the mean current over its exposure, in closed form: consecutive exposures collect the same light as one
    long exposure.

    Attributes:
        lifetime: s to fall to 1/e.
        top_up_every: s from the start of one top-up to the start of the next; None: not periodic.
        top_up_below: share of the full current at which a top-up starts; None: not by the current. Without either the
            current only decays.
        refill: s that a top-up takes, with a linearly rising current; 0: it is instantaneous.
    """

    lifetime: Positive
    top_up_every: Positive | None = None
    top_up_below: Annotated[float, Field(gt=0, lt=1)] | None = None
    refill: NotNegative = 0.0

    def __post_init__(self) -> None:
        if self.top_up_every is not None and self.top_up_below is not None:
            raise ValueError("top_up_every and top_up_below exclude each other; give one of them")
        if self.refill > 0 and not self.tops_up:
            raise ValueError(f"refill must be 0 s without top_up_every or top_up_below, got {self.refill} s")
        if self.top_up_every is not None and not self.top_up_every > self.refill:
            raise ValueError(f"top_up_every must be longer than refill, got {self.top_up_every} and {self.refill} s")

    @property
    def tops_up(self) -> bool:
        return self.top_up_every is not None or self.top_up_below is not None

    def apply(self, image: Image, shot: Shot) -> Image:
        image *= self.mean(shot.elapsed, shot.exposure)
        return image

    def mean(self, start: float, duration: float) -> float:
        """Mean share of the full current over `duration` s from `start`, s since the camera was connected."""
        if not self.tops_up:
            x = duration / self.lifetime
            return math.exp(-start / self.lifetime) * (-math.expm1(-x) / x if x > 0 else 1.0)
        start %= self._falls() + self.refill  # within its cycle: differences of small numbers lose fewer digits
        return (self._charge(start + duration) - self._charge(start)) / duration

    def _charge(self, time: float) -> float:
        """Integral of the share from 0 to `time`, s."""
        falls = self._falls()
        least = math.exp(-falls / self.lifetime)
        whole = self._fallen(falls) + (1 + least) / 2 * self.refill
        cycles, rest = divmod(time, falls + self.refill)
        risen = max(rest - falls, 0.0)
        slope = (1 - least) / self.refill if self.refill else 0.0
        return cycles * whole + self._fallen(min(rest, falls)) + least * risen + slope * risen**2 / 2

    def _falls(self) -> float:
        """s of each cycle in which the current falls."""
        if self.top_up_below is not None:
            return -self.lifetime * math.log(self.top_up_below)
        assert self.top_up_every is not None  # called only for a ring that is topped up
        return self.top_up_every - self.refill

    def _fallen(self, time: float) -> float:
        return -self.lifetime * math.expm1(-time / self.lifetime)
