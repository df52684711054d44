"""Edge: finds the edge and the white line of an absorption curve, if it has them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from beamline.features.xafs.contrast import local_parabolas

Reals = NDArray[np.float64]

LEAST = 9  # Energies that a curve must have
WINDOW = 5  # points of a local parabola
SURE = 5.0  # least ratio of the misfit of a smooth curve to the noise
FALSE_ALARM = 1e-6  # probability for a curve without an edge, under normal noise of any size
SMOOTH = 1e-3  # of the absorption: tolerated difference of a noiseless smooth curve from Victoreen's


@dataclass(frozen=True)
class AbsorptionEdge:
    """Edge and white line of a curve."""

    found: bool  # there is an edge within the range
    reason: str  # why no edge was found, as a sentence
    energy: float | None  # keV of the steepest rise; None where no edge is found
    white_line: float | None  # keV of the maximum above the edge; None without a maximum within the range
    misfit: float  # rms difference from the best smooth curve, in units of the absorption
    noise: float  # rms noise of the curve, likewise


def find_edge(energies: Reals, absorption: Reals) -> AbsorptionEdge:
    """The edge of a curve.

    A curve without an edge is Victoreen's, a + b E^-3 + c E^-4 (J. Appl. Phys. 19, 855, 1948), within its noise. There
    is an edge where a step upwards at one of the energies improves the fit more than chance would in one of a million
    such curves. The test is Student's t of the step, times the number of its possible places. There is also one where
    the curve differs from Victoreen's by five times its noise, estimated from second differences. The edge is the
    maximum of the slope near that step (of parabolas through five points). The white line is the maximum above it, if
    it exceeds the noise and the extrapolation of the curve's far end.

    Args:
        energies: keV, rising, [n].
        absorption: [n], of any unit.

    Raises:
        ValueError: fewer than nine energies, or energies that do not rise.
    """
    if energies.size < LEAST or not (np.diff(energies) > 0).all():
        raise ValueError(f"an edge needs at least {LEAST} rising energies, got {energies.size}")
    noise = _noise(absorption)
    basis = np.linalg.qr(_victoreen(energies))[0]
    rest = absorption - basis @ (basis.T @ absorption)
    misfit = float(np.sqrt(np.mean(rest**2)))
    step, chance = _step(rest, basis)

    def none(reason: str) -> AbsorptionEdge:
        return AbsorptionEdge(False, reason, None, None, misfit, noise)

    stands_out = chance < FALSE_ALARM or misfit > SURE * noise
    if not stands_out or misfit <= SMOOTH * float(np.abs(absorption).mean()):
        return none("the curve is as smooth as one without an edge, to within its noise")
    _, slope = local_parabolas(energies, absorption, WINDOW)
    first = max(step - max(WINDOW, energies.size // 10), 0)
    steepest = first + int(np.argmax(slope[first : step + max(WINDOW, energies.size // 10)]))
    if slope[steepest] <= 0:
        return none("the absorption rises nowhere")
    if steepest < 2 or steepest > energies.size - 3:
        return none("it is steepest at the end of the range; widen the range there")
    return AbsorptionEdge(
        True, "", _top(energies, slope, steepest, 1), _white_line(energies, absorption, steepest, noise), misfit, noise
    )


def _step(rest: Reals, basis: Reals) -> tuple[int, float]:
    """The step upwards that explains most of a residual: the index of the first energy above it, and the probability
    (at most 1) that noise alone explains as much.

    Args:
        rest: [n], residual after a projection on `basis`.
        basis: orthonormal, [n, k].
    """
    at = np.arange(2, rest.size - 1)
    above, held = (np.cumsum(values[::-1], axis=0)[::-1][at] for values in (rest, basis))
    free = np.maximum(rest.size - at - (held**2).sum(axis=1), 1e-9)  # squared norm outside of the basis
    gain = np.where(above > 0, above**2 / free, 0.0)
    best, left = int(np.argmax(gain)), rest.size - basis.shape[1] - 1
    noise = max(float(rest @ rest) - float(gain[best]), 0.0) / left
    t = math.sqrt(float(gain[best]) / noise) if noise > 0 else math.inf
    return int(at[best]), min(float(stdtr(left, -t)) * at.size, 1.0)


def _white_line(energies: Reals, absorption: Reals, edge: int, noise: float) -> float | None:
    top = edge + int(np.argmax(absorption[edge:]))
    rises = float(absorption[top] - absorption[: edge + 1].min())
    far = energies > (energies[top] + energies[-1]) / 2
    if top > energies.size - 3 or far.sum() < 3:
        return None
    # The far end as a + b E^-3: over a long range the top of a bare step is above the end, too.
    basis = _victoreen(energies)[:, :2]
    of_far = np.linalg.pinv(basis[far]).T @ basis[top]
    height = float(absorption[top] - of_far @ absorption[far])
    if height <= max(SURE * noise * math.sqrt(1 + float(of_far @ of_far)), 0.05 * rises):
        return None
    return _top(energies, absorption, top, 2)


def _noise(values: Reals) -> float:
    """rms of white noise in smooth values: second differences of it have a variance of six."""
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6))


def _victoreen(energies: Reals) -> Reals:
    """1, E^-3 and E^-4, [n, 3]."""
    x = energies.mean() / energies
    return np.stack([np.ones_like(x), x**3, x**4], axis=1)


def _top(energies: Reals, values: Reals, at: int, reach: int) -> float:
    """Where the parabola through the points around a maximum is highest, within a step of it."""
    part = slice(max(at - reach, 0), at + reach + 1)
    _, slope, bend = np.polynomial.polynomial.polyfit(energies[part] - energies[at], values[part], 2)
    low, high = energies[max(at - 1, 0)], energies[min(at + 1, energies.size - 1)]
    vertex = energies[at] - slope / (2 * bend) if bend < 0 else energies[at]
    return float(np.clip(vertex, low, high))
