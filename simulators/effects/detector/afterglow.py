"""Afterglow: the scintillator still emits light of earlier moments, so that a frame contains a little of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from simulators.effects.chain import SamplingEffect
from simulators.frame.mapping import NotNegative, Positive
from simulators.frame.shot import Moments, Shot

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Afterglow(SamplingEffect):
    """The prompt share of the light is 1 - sum of shares; a share p is delayed by an exponential time with its decay.

    The delays of all components and the moments of earlier effects (name it after motion_blur) form one distribution of
    times. A Gauss rule of `samples` moments replaces it, exact for its powers up to 2 x samples - 1 (Golub & Welsch
    1969). So only `samples` line integrals are added. An edge that moves by many pixels within a decay time
    appears as that many ghosts instead of a trail.

    Shutter, sample and beam are assumed unchanged over the delays. Not simulated are the light that is missing just
    after the shutter opens, and the light in a dark just after it closes. The weights sum to 1.

    Figures: a maker's table (Crytur, scintillation materials) gives the light 6 ms after the X-rays. It is below 2 %
    for CsI:Tl and below 0.005 % for YAG:Ce. Decay constants of the prompt light are 900 ns and 70 ns (LuAG:Ce: 70 ns,
    no afterglow stated). It depends on dose and temperature: measure.

    Attributes:
        shares: of the light, one for each component; their sum below 1.
        decay_times: s to fall to 1/e, one for each component.
        samples: moments in the past, for all components together.
    """

    shares: tuple[NotNegative, ...]
    decay_times: tuple[Positive, ...]
    samples: Annotated[int, Field(ge=1, le=32)] = 3

    def __post_init__(self) -> None:
        if not self.shares or len(self.shares) != len(self.decay_times):
            raise ValueError(f"each component needs a share and a decay time, got {self}")
        if not 0 < sum(self.shares) < 1:
            raise ValueError(f"the sum of the shares must lie in 0 ... 1 (both excluded), got {sum(self.shares)}")

    def moments(self, moments: Moments, shot: Shot) -> Moments:
        """The given moments with smaller weights, and moments of the past. The moments of the rows must differ only by
        shifts, as after blur and rolling shutter."""
        share = sum(self.shares)
        middle = moments.weights @ moments.times  # [row]
        spread = moments.times[:, 0] - middle[0]
        age, chance = np.polynomial.laguerre.laggauss(self.samples)  # of the exponential law with decay time 1
        ages = np.concatenate([decay * age for decay in self.decay_times])
        chances = np.concatenate([part / share * chance for part in self.shares])
        past, weights = gauss_rule(
            np.subtract.outer(spread, ages).reshape(-1), np.outer(moments.weights, chances).reshape(-1), self.samples
        )
        return Moments(
            np.concatenate([moments.times, middle + past[:, None]]),
            np.concatenate([(1 - share) * moments.weights, share * weights]),
        )


def gauss_rule(points: Reals, weights: Reals, n: int) -> tuple[Reals, Reals]:
    """n points and weights (or fewer, if these suffice) with the same moments up to order 2n - 1 as the given ones.

    By Lanczos' recursion (Golub & Welsch 1969, Math. Comp. 23:221; Gautschi 2004)."""
    scale = float(np.abs(points).max()) or 1.0
    basis = [np.sqrt(weights / weights.sum())]
    diagonal, beside = [], []
    for _ in range(min(n, points.size)):
        following = points / scale * basis[-1]
        diagonal.append(float(basis[-1] @ following))
        for _ in range(2):  # twice is enough (Parlett 1980)
            for vector in basis:
                following = following - (vector @ following) * vector
        beside.append(float(np.linalg.norm(following)))
        if beside[-1] < 1e-12:
            break
        basis.append(following / beside[-1])
    size = len(diagonal)
    jacobi = np.diag(diagonal) + np.diag(beside[: size - 1], 1) + np.diag(beside[: size - 1], -1)
    nodes, vectors = np.linalg.eigh(jacobi)
    return nodes * scale, vectors[0] ** 2 * weights.sum()
