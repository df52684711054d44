"""Effects of the open beam: changes of its shape and intensity, a loss of the beam, and objects that cross it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.base.setting import setting
from simulators.effects.chain import VISIBLE, Anomaly, AnomalyLabel, ImageEffect, ViewRange, exposed_share, within
from simulators.frame.mapping import BelowOne, NotNegative, Positive, Whole
from simulators.frame.shot import Image, Shot


@dataclass(frozen=True)
class BeamBend(ImageEffect):
    """A change of the beam in the projections: -log of the intensity of each ray changes by level + drift t + Σ
    curvature x².

    x is the distance from the middle of the frame, horizontally and vertically, 1 at its edges; t is in s since the
    camera was connected. Flats and darks do not change. If the value is negative, the projections have a higher
    intensity than the flats predict.

    Attributes:
        curvature: (horizontal, vertical), value at the edges of the frame.
        level: constant value.
        drift: constant change, 1/s.
    """

    curvature: tuple[float, float] = (0.0, 0.0)
    level: float = 0.0
    drift: float = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        if not shot.sample:
            return image
        down, across = ((2 * (np.arange(n) + 0.5) / n - 1) ** 2 for n in image.shape)
        image *= np.exp(-self.curvature[1] * down)[:, None]
        image *= np.exp(-self.curvature[0] * across - self.level - self.drift * shot.elapsed)
        return image


@dataclass(frozen=True)
class RingCurrent(ImageEffect):
    """The current decays as exp(-t/lifetime) and returns to full at each top-up. The ring is full when the camera is
    connected.

    A frame gets the mean current over its exposure, in closed form. So consecutive exposures collect the same number of
    photons as one long exposure.

    Attributes:
        lifetime: s to fall to 1/e.
        top_up_every: s from the start of one top-up to the start of the next; None: not periodic.
        top_up_below: share of the full current at which a top-up starts; None: the current does not start a top-up.
            Without both settings the current only decays.
        refill: duration of a top-up in s, with a linearly rising current; 0: instantaneous.
    """

    lifetime: Positive
    top_up_every: Positive | None = None
    top_up_below: float | None = setting(None, gt=0, lt=1)
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
        """Mean share of the full current over `duration` s from `start` (s since the camera was connected)."""
        if not self.tops_up:
            x = duration / self.lifetime
            return math.exp(-start / self.lifetime) * (-math.expm1(-x) / x if x > 0 else 1.0)
        # time within its cycle, because differences of small numbers lose fewer digits
        start %= self._falls() + self.refill
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
        """Duration in s, in each cycle, in which the current falls."""
        if self.top_up_below is not None:
            return -self.lifetime * math.log(self.top_up_below)
        assert self.top_up_every is not None  # called only for a ring that is topped up
        return self.top_up_every - self.refill

    def _fallen(self, time: float) -> float:
        return -self.lifetime * math.expm1(-time / self.lifetime)


@dataclass(frozen=True)
class LostBeam(ImageEffect, Anomaly):
    """The beam is off for a range of projections or of time; a frame loses the photons of the overlap.

    Attributes:
        views: [first, one after the last]; flats taken just before one of these projections also lose their photons.
        seconds: [from, to] since the camera was connected.
        share: share of the intensity that remains.
    """

    views: ViewRange | None = None
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

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        rows, cols = shot.detector.shape
        return [AnomalyLabel(self.name, (0, rows, 0, cols))] if shot.beam and self._lost(shot) > 0 else []

    def _lost(self, shot: Shot) -> float:
        """Share of the photons of the frame that is lost."""
        if self.seconds is None:
            return 1 - self.share if within(self.views, shot) else 0.0
        # In seconds of this exposure, so that rounding cannot remove more than all photons.
        begin, end = (moment - shot.elapsed for moment in self.seconds)
        off = min(end, shot.exposure) - max(begin, 0.0)
        return (1 - self.share) * max(off, 0.0) / shot.exposure


@dataclass(frozen=True)
class Ghost(ImageEffect, Anomaly):
    """A smooth change of the intensity by a cos², as high as the frame. Flats do not have this change.

    An early data set of a battery shows it: "fog" crosses the frame in a few projections, with intensities that no
    other projection has. The cause is unknown. The ghost may be bright (photons scattered into the detector) or dark.

    Attributes:
        view: the first projection that shows the ghost, at the right edge. width: full width at half height in mm; the
            ghost ends `width` from its middle. speed: mm to the left from one projection to the next. gain: relative
            change of the intensity in the middle of the ghost; negative for a dark ghost.
    """

    view: Whole
    width: Positive
    speed: Positive
    gain: float = setting(0.3, ge=-1)

    def __post_init__(self) -> None:
        if self.gain == 0:
            raise ValueError("gain is 0, which shows no ghost; expected any other number")

    def apply(self, image: Image, shot: Shot) -> Image:
        first, change = self._change(shot)
        image[:, first : first + change.size] *= 1 + change
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        first, change = self._change(shot)
        visible = np.flatnonzero(np.abs(change) >= VISIBLE)
        if not shot.beam or not visible.size:
            return []
        return [
            AnomalyLabel(self.name, (0, shot.detector.shape[0], first + int(visible[0]), first + int(visible[-1]) + 1))
        ]

    def _change(self, shot: Shot) -> tuple[int, NDArray[np.float64]]:
        """The first column that the ghost covers, and the relative change of the intensity from there to the right."""
        cols, pitch = shot.detector.shape[1], shot.detector.pitch
        if not shot.sample or shot.view < self.view:
            return 0, np.zeros(0)
        # middle in columns, half a step after the left end of the ghost has reached the right edge of the frame
        middle = cols - 0.5 + (self.width - self.speed * (shot.view - self.view + 0.5)) / pitch
        reach = self.width / pitch
        first = max(0, math.ceil(middle - reach))
        away = (np.arange(first, min(cols, math.floor(middle + reach) + 1)) - middle) / reach
        return first, self.gain * np.cos(0.5 * np.pi * away) ** 2


@dataclass(frozen=True)
class BlackBand(ImageEffect, Anomaly):
    """A slit darkens a band at the left, with an edge that is soft because of the penumbra; flats also have the band.

    Attributes:
        width: mm from the left edge of the frame, for any ROI, to the place with half of the intensity. penumbra: mm
            over which the intensity rises from none to all. share: share of the intensity that remains in the band.
            views: [first, one after the last] projection with the slit in the beam; None: all.
    """

    width: Positive
    penumbra: NotNegative = 0.0
    share: BelowOne = 0.0
    views: ViewRange | None = None

    def apply(self, image: Image, shot: Shot) -> Image:
        if within(self.views, shot):
            intensity = self._intensity(shot)
            image[:, : intensity.size] *= intensity
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        cols = self._intensity(shot).size if shot.beam and within(self.views, shot) else 0
        return [AnomalyLabel(self.name, (0, shot.detector.shape[0], 0, cols))] if cols else []

    def _intensity(self, shot: Shot) -> NDArray[np.float64]:
        """Share of the intensity in each column of the band."""
        from_left = (np.arange(shot.detector.shape[1], dtype=np.float64) + 0.5) * shot.detector.pitch
        intensity = self.share + (1 - self.share) * exposed_share(from_left - self.width, self.penumbra)
        return intensity[intensity < 1]


@dataclass(frozen=True)
class NarrowField(ImageEffect, Anomaly):
    """An aperture before the sample transmits a rectangle of the beam, whose edges are soft because of the penumbra of
    the source.

    Flats are equally narrow. Pixels without the full intensity get a label for each side: left, right, above and below.

    Attributes:
        width: width of the rectangle in mm across the beam, between the places with half of the intensity. height:
            height in mm; None: the whole frame. centre: position of its middle in mm, (across, down the rows) from the
            projected rotation axis and z = 0. penumbra: mm over which the intensity rises from none to all.
    """

    width: Positive
    height: Positive | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    penumbra: NotNegative = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        down, across = self._intensity(shot)
        first, last = _lit_fully(across)
        image[:, :first] *= across[:first]
        image[:, last:] *= across[last:]
        first, last = _lit_fully(down)
        image[:first] *= down[:first, None]
        image[last:] *= down[last:, None]
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        rows, cols = shot.detector.shape
        (top, below), (left, right) = (_lit_fully(intensity, VISIBLE) for intensity in self._intensity(shot))
        strips = [(0, rows, 0, left), (0, rows, right, cols), (0, top, 0, cols), (below, rows, 0, cols)]
        return [
            AnomalyLabel(self.name, strip, which)
            for which, strip in enumerate(strips)
            if shot.beam and strip[0] < strip[1] and strip[2] < strip[3]
        ]

    def _intensity(self, shot: Shot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Shares of the intensity in each row and in each column; the share of a pixel is their product."""
        detector = shot.detector
        across = self._between(detector.u() - self.centre[0], self.width)
        if self.height is None:
            return np.ones(detector.shape[0]), across
        return self._between(detector.v() - self.centre[1], self.height), across

    def _between(self, place: NDArray[np.float64], width: float) -> NDArray[np.float64]:
        # The part of the source that is not covered. The two edges cover the source from opposite ends.
        near_edge, far_edge = (exposed_share(edge, self.penumbra) for edge in (width / 2 - place, width / 2 + place))
        return np.maximum(near_edge + far_edge - 1, 0.0)


def _lit_fully(intensity: NDArray[np.float64], less: float = 0.0) -> tuple[int, int]:
    """First pixel with at least 1 - `less` of the light, and the one after the last.

    The light falls off on both sides.
    """
    full = np.flatnonzero(intensity >= 1 - less)
    return (int(full[0]), int(full[-1]) + 1) if full.size else (intensity.size, intensity.size)
