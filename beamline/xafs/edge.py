"""Edge: where an absorption curve has its edge and its white line, and whether it has any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beamline.xafs.local import local_parabolas

Reals = NDArray[np.float64]

LEAST = 9
"""Energies that a curve must have."""
WINDOW = 5  # points of a local parabola
SURE = 5.0  # times the noise that what is not smooth must be
SMOOTH = 1e-3  # of the absorption: what a smooth curve may differ from Victoreen's by without any noise


@dataclass(frozen=True)
class Edge:
    """What a curve shows.

    Attributes:
        seen: there is an edge within the range.
        why: in a sentence, where there is none.
        energy: keV of the steepest rise; None where no edge is seen.
        white_line: keV of the top above it; None where there is none, or it is not within the range.
        misfit: rms difference from the best smooth curve, in units of the absorption.
        noise: rms noise of the curve, likewise.
    """

    seen: bool
    why: str
    energy: float | None
    white_line: float | None
    misfit: float
    noise: float


def find_edge(energies: Reals, absorption: Reals) -> Edge:
    """The edge of a curve.

    A curve without an edge is Victoreen's, a + b E^-3 + c E^-4 (J. Appl. Phys. 19, 855, 1948), within its noise; the
    noise is taken from second differences, which see hardly anything else. Where it is not, the edge is the maximum of
    the slope (of parabolas through five points), and the white line the first
    maximum above it that stands out of the noise.

    Args:
        energies: keV, rising, [n].
        absorption: [n], of any unit.

    Raises:
        ValueError: fewer than nine energies, or energies that do not rise.
    """
    if energies.size < LEAST or not (np.diff(energies) > 0).all():
        raise ValueError(f"an edge needs at least {LEAST} rising energies, got {energies.size}")
    noise = _noise(absorption)
    misfit = float(np.sqrt(np.mean((absorption - _victoreen(energies, absorption)) ** 2)))

    def none(why: str) -> Edge:
        return Edge(False, why, None, None, misfit, noise)

    if misfit <= max(SURE * noise, SMOOTH * float(np.abs(absorption).mean())):
        return none("the curve is as smooth as one without an edge, to within its noise")
    _, slope = local_parabolas(energies, absorption, WINDOW)
    steepest = int(np.argmax(slope))
    if slope[steepest] <= 0:
        return none("the absorption rises nowhere")
    if steepest < 2 or steepest > energies.size - 3:
        return none("it is steepest at the end of the range; widen the range there")
    return Edge(
        True, "", _top(energies, slope, steepest, 1), _white_line(energies, absorption, steepest, noise), misfit, noise
    )


def _white_line(energies: Reals, absorption: Reals, edge: int, noise: float) -> float | None:
    above = absorption[edge:]
    top = edge + int(np.argmax(above))
    falls = float(absorption[top] - absorption[top:].min())
    rises = float(absorption[top] - absorption[: edge + 1].min())
    if top > energies.size - 3 or falls <= max(SURE * noise, 0.05 * rises):
        return None
    return _top(energies, absorption, top, 2)


def _noise(values: Reals) -> float:
    """rms of white noise in smooth values: second differences of it have a variance of six."""
    return float(np.median(np.abs(np.diff(values, 2))) / 0.6745 / np.sqrt(6))


def _victoreen(energies: Reals, absorption: Reals) -> Reals:
    x = energies.mean() / energies
    basis = np.stack([np.ones_like(x), x**3, x**4], axis=1)
    return np.asarray(basis @ np.linalg.lstsq(basis, absorption, rcond=None)[0])


def _top(energies: Reals, values: Reals, at: int, reach: int) -> float:
    """Where the parabola through the points around a maximum is highest, within a step of it."""
    part = slice(max(at - reach, 0), at + reach + 1)
    _, slope, bend = np.polynomial.polynomial.polyfit(energies[part] - energies[at], values[part], 2)
    low, high = energies[max(at - 1, 0)], energies[min(at + 1, energies.size - 1)]
    vertex = energies[at] - slope / (2 * bend) if bend < 0 else energies[at]
    return float(np.clip(vertex, low, high))
