"""Exposure: one frame of a scene, from the turning sample to counts; only the effects that it names are computed.

Without effects a frame is photons x exposure x exp(-line integral) / conversion, rounded: Beer-Lambert and no more.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulators.effects.chain import Domain, Image, Shot
from simulators.scene import Scene
from simulators.sensor import CONVERSION, digitise

AngleAt = Callable[[float], float]


def expose(scene: Scene, shot: Shot, angle_at: AngleAt, *, beam: bool, sample: bool) -> NDArray[np.uint16]:
    """One frame, counts uint16 [row, col].

    Args:
        shot: the circumstances; its rng is used up: the same frame again needs the same seed anew.
        angle_at: true angle in radians at a time in s; asked only where the scene names a motion effect.
        beam: the shutter is open (otherwise a dark).
        sample: the sample is in the beam (otherwise a flat).
    """
    chain = scene.chain
    if beam:
        photons = np.full(shot.detector.shape, scene.beam.photons_per_s * shot.exposure * shot.binning**2)
        if sample:
            photons *= _transmission(scene, shot, angle_at)
        electrons = chain.apply(Domain.PHOTONS, photons, shot)
    else:
        electrons = np.zeros(shot.detector.shape)
    electrons = chain.apply(Domain.ELECTRONS, electrons, shot)
    return digitise(chain.apply(Domain.COUNTS, electrons / CONVERSION, shot))


def _transmission(scene: Scene, shot: Shot, angle_at: AngleAt) -> Image:
    """exp(-line integral), averaged over the moments that the motion effects ask for; float64 [row, col]."""

    def at(angle: ArrayLike) -> Image:
        depth = scene.line_integrals(angle, shot.detector)
        return np.exp(-scene.chain.apply(Domain.OPTICAL_DEPTH, depth, shot))

    if not scene.chain.motion:
        return at(shot.angle)
    times = np.zeros((1, shot.detector.shape[0]))
    for effect in scene.chain.motion:
        times = effect.times(times, shot)
    return np.mean([at(_row_angles(row, shot.time, angle_at)) for row in times], axis=0)


def _row_angles(times: NDArray[np.float64], start: float, angle_at: AngleAt) -> NDArray[np.float64]:
    """Angles of the rows at `times` after `start`, float64 [row].

    Only the first and the last row are asked for: within the milliseconds of a readout the angle is straight to 1e-5
    rad even while the stage speeds up at 1 rad/s2.
    """
    first, last = angle_at(start + times[0]), angle_at(start + times[-1])
    span = times[-1] - times[0]
    return first + (last - first) * (times - times[0]) / (span if span > 0 else 1.0)
