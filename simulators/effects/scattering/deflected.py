"""Light that the sample deflects, and loose particles in its path."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from recon.base.setting import Setting, setting
from simulators.effects.chain import VISIBLE, Anomaly, AnomalyLabel, ImageEffect, ViewRange, within
from simulators.frame.mapping import NotNegative, Positive, Whole
from simulators.frame.shot import Image, Shot, fixed_rng
from simulators.pixels.broad_blur import add_enlarged, broad_blur, gaussian

Length = Annotated[float, Setting(ge=1e-9, le=1e9)]
Height = Annotated[float, Setting(ge=-1e9, le=1e9)]
"""Limits of lengths (mm), of the number of particles and of their depth; above them, a frame takes seconds or
overflows."""


@dataclass(frozen=True)
class Crumb:
    """A round Gaussian cloud in a frame, cut off where it is thinner than VISIBLE.

    Attributes:
        row, col: position of its middle. sigma: standard deviation in pixels. depth: optical depth through its middle.
        which: number of the loose particle in the scene.
    """

    row: float
    col: float
    sigma: float
    depth: float
    which: int

    def box(self, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        """(first row, row after the last, first column, column after the last); empty outside the frame."""
        middle, size = np.array([self.row, self.col]), np.array(shape)
        aside = np.abs(middle - np.clip(middle, 0, size - 1))[::-1]  # the frame may contain only a part of the circle
        reach = np.sqrt(np.maximum(2 * math.log(self.depth / VISIBLE) * self.sigma**2 - aside**2, 0.0))
        # clipped first, because close to the source of a cone, positions exceed the range of integers
        top, left = np.clip(np.ceil(middle - reach), 0, size).astype(int).tolist()
        below, right = np.clip(np.floor(middle + reach) + 1, 0, size).astype(int).tolist()
        return top, below, left, right


@dataclass(frozen=True)
class Floaters(ImageEffect, Anomaly):
    """Loose particles on the outside of the can or elsewhere in the beam.

    Turning particles turn with the stage. A loose particle beyond the frame's width crosses the frame twice a turn, in
    front of the axis and behind it. Within 180 degrees it crosses once, in a range of projections, on one side.
    Particles with the motion "loose" drift across at their own speed. All rows show a loose particle at its position at
    the time when the first row is exposed.

    Attributes:
        distance: [least, most] mm from the rotation axis; a loose particle is visible within the larger distance.
        count: number of loose particles.
        size: [least, most] mm, standard deviation of the cloud.
        depth: largest optical depth through the middle of a loose particle; the smallest is half of it.
        heights: [least, most] mm, down the rows from z = 0.
        motion: "turning" with the stage, or "loose".
        speed: drift of a loose particle in either direction, mm per projection. views: [first, one after the last]
            projection in which loose particles exist; a particle with the motion "loose" passes the axis within this
            range. seed: seed of sizes, places and depths.
    """

    distance: tuple[Length, Length]
    count: int = setting(3, ge=1, le=10_000)
    size: tuple[Length, Length] = (0.01, 0.03)
    depth: float = setting(0.5, ge=4 * VISIBLE, le=1e6)
    heights: tuple[Height, Height] = (-0.2, 0.2)
    motion: Literal["turning", "loose"] = "turning"
    speed: Length = 0.05
    views: ViewRange | None = None
    seed: Whole = 0

    def __post_init__(self) -> None:
        for name in ("distance", "size", "heights"):
            least, most = getattr(self, name)
            if not least <= most:
                raise ValueError(f"{name} must be [least, most] in mm, got {[least, most]}")
        if self.motion == "loose" and self.views is None:
            raise ValueError(
                "loose floaters need views, [first, one after the last], between which they cross the axis"
            )

    def apply(self, image: Image, shot: Shot) -> Image:
        for crumb in self.crumbs(shot):
            top, below, left, right = crumb.box(shot.detector.shape)
            down, across = (
                np.exp(-0.5 * ((np.arange(*ends) - middle) / crumb.sigma) ** 2)
                for ends, middle in (((top, below), crumb.row), ((left, right), crumb.col))
            )
            image[top:below, left:right] += crumb.depth * down[:, None] * across
        return image

    def labels(self, shot: Shot) -> Sequence[AnomalyLabel]:
        if not (shot.beam and shot.sample):
            return []
        return [AnomalyLabel(self.name, crumb.box(shot.detector.shape), crumb.which) for crumb in self.crumbs(shot)]

    def crumbs(self, shot: Shot) -> Iterator[Crumb]:
        loose = self.motion == "loose"
        if not (loose or within(self.views, shot)):
            return
        rng = fixed_rng(self.name, self.seed)
        detector = shot.detector
        for which in range(self.count):
            distance, size, height = (rng.uniform(*ends) for ends in (self.distance, self.size, self.heights))
            depth, direction, passing = self.depth * rng.uniform(0.5, 1.0), rng.uniform(0, 2 * math.pi), rng.uniform()
            u, b = distance * math.cos(shot.angle - direction), -distance * math.sin(shot.angle - direction)
            if loose:
                first, after = self.views or (0, 0)
                u = math.copysign(self.speed, math.cos(direction)) * (shot.view - first - passing * (after - first))
                b = 0.0 if abs(u) <= distance else math.inf
            if b == math.inf or detector.sod + b <= 0:
                continue
            nearer = 1.0 if math.isinf(detector.sod) else detector.sod / (detector.sod + b)
            crumb = Crumb(
                row=detector.axis_row + height * nearer / detector.pitch,
                col=detector.axis_col + u * nearer / detector.pitch,
                sigma=size * nearer / detector.pitch,
                depth=depth,
                which=which,
            )
            top, below, left, right = crumb.box(detector.shape)
            if top < below and left < right:
                yield crumb


@dataclass(frozen=True)
class Scatter(ImageEffect):
    """Adds `ratio` times the mean, or times a broad blur, of the transmitted image, and a constant background.

    The ratio compares scattered with primary photons (Siewerdsen & Jaffray 2001, Med. Phys. 28:220). A flat has the
    background, but no scatter. Name it before the effects of the scintillator.

    Attributes:
        ratio: scattered photons over transmitted ones, both as means over the frame.
        width_mm: standard deviation of the Gaussian by which the scattered image is blurred, mm at the sample; None:
            evenly spread. The frame's edges are mirrors.
        background: photons/s on an unbinned sensor pixel; p x photons_per_s is a share p of the open beam.
    """

    ratio: NotNegative = 0.0
    width_mm: Positive | None = None
    background: NotNegative = 0.0

    def apply(self, image: Image, shot: Shot) -> Image:
        level = self.background * shot.exposure * shot.binning**2
        if self.ratio > 0 and shot.sample:
            if self.width_mm is None:
                level += self.ratio * float(image.mean())
            else:
                add_enlarged(image, broad_blur(image, self.width_mm / shot.detector.pitch, gaussian), self.ratio)
        if level > 0:
            image += level
        return image
