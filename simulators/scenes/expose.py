"""Expose: computes one frame of a scene, from the turning sample to counts, with only the effects that the scene names.

Without effects a frame is photons x exposure x exp(-line integral) / conversion, rounded: Beer-Lambert.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simulators.effects.catalogue import Domain
from simulators.effects.chain import StepHook
from simulators.frame.pose import Pose
from simulators.frame.sensor import digitise, largest_count
from simulators.frame.shot import Image, Shot
from simulators.samples.sample import sample_at
from simulators.scenes.scene import Scene


def expose(scene: Scene, shot: Shot, on_step: StepHook = nullcontext) -> NDArray[np.uint16]:
    """One frame, counts uint16 [row, col].

    Args:
        shot: the conditions; the same shot gives the same frame.
        on_step: entered around each step with its name: "line_integrals", "beer_lambert", "digitise" and the effects'.
    """
    chain = scene.chain
    if shot.beam:
        photons = _photons(scene, shot, on_step)
        electrons = chain.apply(Domain.PHOTONS, photons, shot, on_step)
    else:
        electrons = np.zeros(shot.detector.shape)
    electrons = chain.apply(Domain.ELECTRONS, electrons, shot, on_step)
    with on_step("digitise"):
        electrons /= shot.conversion
    counts = chain.apply(Domain.COUNTS, electrons, shot, on_step)
    with on_step("digitise"):
        return digitise(counts, largest_count(shot.readout, shot.binning))


def _photons(scene: Scene, shot: Shot, on_step: StepHook) -> Image:
    """Photons behind the sample, averaged over the moments of the effects of motion; float64 [row, col]."""
    open_beam = scene.beam.photons_per_s * shot.exposure * shot.binning**2  # photons of a pixel
    if not shot.sample:
        with on_step("beer_lambert"):
            return np.full(shot.detector.shape, open_beam)
    if not scene.chain.moves:
        angle = np.full(shot.detector.shape[0], shot.angle)
        return _transmission(scene, shot, angle, np.zeros_like(angle), open_beam, on_step)
    moments = scene.chain.moments(shot)
    parts = (
        _transmission(scene, shot, _row_angles(times, shot), times, weight * open_beam, on_step)
        for times, weight in zip(moments.times, moments.weights, strict=True)
    )
    photons = next(parts)
    for part in parts:
        photons += part
    return photons


def _transmission(
    scene: Scene,
    shot: Shot,
    angles: NDArray[np.float64],
    times: NDArray[np.float64],
    open_beam: float,
    on_step: StepHook,
) -> Image:
    """open_beam x exp(-line integral) with the sample's pose at one moment of each row, mean over a pixel's rays."""
    pose = scene.chain.pose(Pose(angles), times, shot)
    now, rays = shot.later(float(times[0])), scene.chain.rays
    sample = sample_at(scene.sample, shot.elapsed + float(times[0]))

    def through(row: float, col: float) -> Image:
        detector = shot.detector.aimed(row, col)
        with on_step("line_integrals"):
            depth = sample.line_integrals(pose, detector)
        depth = scene.chain.apply(Domain.OPTICAL_DEPTH, depth, replace(now, detector=detector), on_step)
        with on_step("beer_lambert"):
            np.exp(np.negative(depth, out=depth), out=depth)
            depth *= open_beam / len(rays)
            return depth

    photons = through(*rays[0])
    for ray in rays[1:]:
        photons += through(*ray)
    return photons


def _row_angles(times: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
    """Angles of the rows at `times` after the trigger, float64 [row].

    Only the angles of the first and the last row are read: within the milliseconds of a readout the angle is linear to
    1e-5 rad even while the stage accelerates at 1 rad/s2.
    """
    first, last = shot.angle_at(shot.time + times[0]), shot.angle_at(shot.time + times[-1])
    span = times[-1] - times[0]
    return first + (last - first) * (times - times[0]) / (span if span > 0 else 1.0)
