"""Motion of a sample: the transpose, gradients by finite differences, and a known motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.joint.energy_fit import EnergyFit, EnergyViews
from recon.features.joint.motion import MIDDLE, Motion, Seen, descent, improved, moved
from recon.voxels.projector import Projector, projection_lines

SHAPE = (16, 16, 12)  # [y, x, z]
TIMES = np.array([0.0, 0.3, 0.6, 1.0])
PER_TIME = 6


def some_motion(rng: np.random.Generator) -> Motion:
    """Of a voxel or so, differing along each axis."""
    none = Motion.none(SHAPE, TIMES, 3, 3)
    return replace(none, control=rng.standard_normal(none.control.shape))


def blobs() -> F32:
    """Smooth bodies, none near the border."""
    places = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in SHAPE), indexing="ij"), -1)
    centres = [(-0.3, 0.1, 0.2), (0.35, -0.2, -0.3), (0.0, 0.4, 0.3), (-0.1, -0.4, -0.2)]
    return np.sum([np.exp(-((places - at) ** 2).sum(-1) / 0.05) for at in centres], 0).astype(np.float32)


def views(truth: Motion) -> tuple[Geometry, list[Seen]]:
    """Of the moved blobs at each time: noise-free, by the projector of the fit."""
    geometry = Geometry.parallel(np.pi * (np.sqrt(5) - 1) / 2 * np.arange(PER_TIME * TIMES.size), (SHAPE[2], SHAPE[0]))
    whole, seen = Projector(geometry, Grid.matching(geometry)), []
    for time in range(TIMES.size):
        part = whole.subset(np.arange(PER_TIME * time, PER_TIME * (time + 1)))
        seen.append(Seen(time, part, part.forward_lines(moved(blobs(), truth.at(time))), None))
    return geometry, seen


@pytest.mark.parametrize("controls", [1, 2, 3, 4])
def test_back_is_the_transpose_of_at(rng: np.random.Generator, controls: int) -> None:
    motion = Motion.none(SHAPE, TIMES, 3, controls)
    control = rng.standard_normal(motion.control.shape)
    for time in range(TIMES.size):
        field = rng.standard_normal((3, *SHAPE)).astype(np.float32)
        there = float(np.vdot(motion.at(time, control).astype(float), field))
        assert there == pytest.approx(float(np.vdot(control, motion.back(time, field))), rel=1e-4, abs=1e-3)


def test_nothing_moves_in_the_middle_and_control_points_are_displacements(rng: np.random.Generator) -> None:
    motion = replace(some_motion(rng), times=np.array([MIDDLE, 1.0]))
    assert np.abs(motion.at(0)).max() == 0
    corner = motion.control[2, :, 0, 0, 0] - motion.control[1, :, 0, 0, 0]
    np.testing.assert_allclose(motion.at(1)[:, 0, 0, 0], corner, rtol=1e-5)


def test_the_descent_of_the_control_points_is_minus_the_gradient(rng: np.random.Generator) -> None:
    _, seen = views(Motion.none(SHAPE, TIMES, 3, 3))
    heavy = [replace(part, weight=rng.uniform(0.5, 2, part.data.shape).astype(np.float32)) for part in seen]
    motion = some_motion(rng)
    along = rng.standard_normal(motion.control.shape)

    def half_squares(step: float) -> float:
        at, total = replace(motion, control=motion.control + step * along), 0.0
        for part in heavy:
            left = part.data - part.projector.forward_lines(moved(blobs(), at.at(part.time)))
            total += float((part.weight * left.astype(float) ** 2).sum()) / 2
        return total

    slope = (half_squares(0.001) - half_squares(-0.001)) / 0.002  # short: the slope jumps from cell to cell
    found, _ = descent(motion, heavy, lambda time: blobs())
    assert -float(np.vdot(found, along)) == pytest.approx(slope, rel=3e-3)


def test_the_descent_of_volumes_that_move_is_minus_the_gradient(rng: np.random.Generator) -> None:
    """Two knots of densities, displaced; exact: the squares are quadratic in the volumes."""
    motion = some_motion(rng)
    geometry, seen = views(motion)
    data = np.concatenate([part.data for part in seen]).transpose(0, 2, 1).copy()
    assert np.array_equal(projection_lines(data), np.concatenate([part.data for part in seen]))
    timed = EnergyViews(data, geometry, np.repeat(np.arange(TIMES.size), PER_TIME), np.stack([1 - TIMES, TIMES], 1))
    fit = EnergyFit(timed, Grid.matching(geometry), rng, motion)
    at, along = (rng.standard_normal(fit.z.shape).astype(np.float32) for _ in range(2))

    def half_squares(z: F32) -> float:
        fit.z = z
        return sum(fit.descent(subset, np.empty_like(z)) for subset in fit.subsets) / 2

    slope = half_squares(at + np.float32(0.5) * along) - half_squares(at - np.float32(0.5) * along)
    fit.z, total = at, np.zeros(at.shape)
    for subset in fit.subsets:
        out = np.empty_like(at)
        fit.descent(subset, out)
        total += out
    assert -float(np.vdot(total, along)) == pytest.approx(slope, rel=1e-3)


def test_a_known_motion_is_found_from_the_views() -> None:
    """A sample settles by 2.4 voxels at its top. What bounds the error is the weight of differences between control
    points, which do differ here. The error is 4 % of the motion."""
    none = Motion.none(SHAPE, TIMES, 3, 3)
    settles = np.zeros_like(none.control)
    settles[:, 2] = np.linspace(0, 2.4, 3)[:, None, None, None] * np.array([0, 0.5, 1])
    truth = replace(none, control=settles)
    _, seen = views(truth)
    motion = none
    for _ in range(10):
        motion = improved(motion, seen, lambda time: blobs())
    matter = blobs() > 0.3
    error, size = (
        np.sqrt(np.mean([u[:, matter] ** 2 for u in some]))
        for some in (
            [motion.at(t) - truth.at(t) for t in range(TIMES.size)],
            [truth.at(t) for t in range(TIMES.size)],
        )
    )
    assert error < 0.1 * size
