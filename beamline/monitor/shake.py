"""Shake: random displacement of the sample from view to view, by vibration or runout of the stage.

A view that stands x beside its way changes its own comparison with the views before by x, and the next one by -4/3 x:
there it is the view before, and a third of the velocity. So changes that follow one another have a covariance of -4/3
of the variance of x. What a model of the turning sample does not know changes slowly: its covariance is positive. This
tells both apart, whatever the sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from beamline.monitor.change import SampleChange
from beamline.monitor.scatter import FrameScatter

PAIRS = 32  # changes that follow one another, before anything is told
MEMORY = 0.02  # weight of the newest pair
CLIPPED = 4.0  # mean absolute deviations that count of a change, so that a jump is no vibration
OWN = 4 / 3  # of the variance of x: minus the covariance of changes that follow one another
FROM_NOISE = math.sqrt(1 + OWN**2 + 1 / 9)  # sigma of a change over that of a view's own displacement
SIGMAS = 6.0  # standard deviations of the estimate: a false alarm in 10**9 estimates
CONFIRMED = 0.5  # share of the changes' variance that their covariance must show
SPREAD = 2.6  # standard deviation of the estimate for noise alone, over the variance by noise, times sqrt(pairs)


@dataclass(frozen=True)
class Axis:
    """One direction: the changes' usual size, the last one, and running means of squares, of products of those that
    follow one another, and of variances by noise."""

    usual: FrameScatter = field(default_factory=FrameScatter)
    last: float = math.nan
    square: float = 0.0
    product: float = 0.0
    noise: float = 0.0

    def with_figure(self, figure: float, sigma: float, pairs: int) -> Axis:
        usual = self.usual.with_figure(figure)
        most = CLIPPED * max(usual.deviation, 1e-9)
        away = min(max(figure - usual.mean, -most), most)
        if math.isnan(self.last):
            return replace(self, usual=usual, last=away)
        weight = max(MEMORY, 1 / (pairs + 1))
        square = self.square + weight * (away**2 - self.square)
        product = self.product + weight * (away * self.last - self.product)
        noise = self.noise + weight * ((sigma / FROM_NOISE) ** 2 - self.noise)
        return Axis(usual, away, square, product, noise)

    def size(self, pairs: int) -> float:
        """Standard deviation of x in pixels, without the part of the noise; 0 where noise alone may give as much.

        The squares tell it more exactly than the products, where these confirm it.
        """
        variance, n = -self.product / OWN, min(pairs, round(2 / MEMORY))
        if pairs < PAIRS or variance < self.noise * (1 + SIGMAS * SPREAD / math.sqrt(n)):
            return 0.0
        whole = self.square / FROM_NOISE**2
        return math.sqrt(max(whole if variance > CONFIRMED * whole else variance, self.noise) - self.noise)


@dataclass(frozen=True)
class Shake:
    """Shake across and down, over the views so far."""

    across: Axis = field(default_factory=Axis)
    down: Axis = field(default_factory=Axis)
    pairs: int = 0

    def with_change(self, change: SampleChange | None) -> Shake:
        """The state after the next view; None, or a gap of views, begins a new chain of changes."""
        if change is None or not 0.5 < change.steps < 1.5 or not math.isfinite(change.across + change.down):
            return Shake(replace(self.across, last=math.nan), replace(self.down, last=math.nan), self.pairs)
        figures = (change.across, change.sigma[0]), (change.down, change.sigma[1])
        across, down = (
            axis.with_figure(*figure, self.pairs)
            for axis, figure in zip((self.across, self.down), figures, strict=True)
        )
        return Shake(across, down, self.pairs + (not math.isnan(self.across.last)))

    @property
    def size(self) -> tuple[float, float]:
        """Standard deviations across and down, in pixels."""
        return self.across.size(self.pairs), self.down.size(self.pairs)
