"""Arrangement: no two bodies overlap and none leaves the cylinder, by checks of another kind than the package's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import get_args

import numpy as np
from scipy.optimize import minimize_scalar, nnls
from scipy.spatial.transform import Rotation

from simulators.samples.bodies.packing import pack
from simulators.samples.bodies.solids import Box, Cylinder, Ellipsoid, Polyhedron, Solid
from simulators.samples.builders.packed.arrangement import arrange, bodies_of
from simulators.samples.builders.packed.cathode import Habit, grain
from tests.messages import refused
from tests.simulators.bodies import volume


def corners(solid: Solid) -> np.ndarray:
    p = pack([solid])
    return p.centre[0] + p.vertices


def spread(solid: Ellipsoid) -> np.ndarray:
    """Matrix that makes the ellipsoid of the unit ball."""
    w, x, y, z = solid.quaternion
    return Rotation.from_quat([x, y, z, w]).as_matrix() * np.array(solid.semi_axes)


def to_hull(points: np.ndarray) -> float:
    """Distance of the origin from the hull of points: least squares over weights >= 0 whose sum is 1 (a heavy row)."""
    scale = 1e3 * np.abs(points).max()
    _, rest = nnls(np.vstack([points.T, np.full(len(points), scale)]), np.append(np.zeros(3), scale))
    return float(rest)


def apart(one: Solid, other: Solid) -> bool:
    """Whether two bodies share no point: two ellipsoids by the contact function of Perram and Wertheim (J. Comput.
    Phys. 58, 1985), others by distances of hulls, in the ellipsoid's own space where there is one."""
    if isinstance(one, Ellipsoid) and isinstance(other, Ellipsoid):
        a, b = (m @ m.T for m in (spread(one), spread(other)))
        r = np.array(one.centre) - np.array(other.centre)
        found = minimize_scalar(
            lambda s: -s * (1 - s) * r @ np.linalg.solve((1 - s) * a + s * b, r), bounds=(0, 1), method="bounded"
        )
        return -found.fun > 1
    if isinstance(other, Ellipsoid):
        one, other = other, one
    if isinstance(one, Ellipsoid):
        return to_hull(np.linalg.solve(spread(one), (corners(other) - one.centre).T).T) > 1
    return to_hull((corners(one)[:, None] - corners(other)).reshape(-1, 3)) > 1e-9


def overlapping(solids: list[Solid], grown: float = 1.0) -> list[tuple[int, int]]:
    """Pairs that share a point."""
    centres = np.array([solid.centre for solid in solids])
    reach = bodies_of([replace(solid, centre=(0.0, 0.0, 0.0)) for solid in solids]).reach
    near = np.linalg.norm(centres[:, None] - centres, axis=2) < reach[:, None] + reach
    return [(i, j) for i, j in combinations(range(len(solids)), 2) if near[i, j] and not apart(solids[i], solids[j])]


def _placed(solids: Sequence[Solid], centres: np.ndarray) -> list[Solid]:
    return [replace(solid, centre=tuple(centre)) for solid, centre in zip(solids, centres.tolist(), strict=True)]


def _loose(rng: np.random.Generator, n: int = 120) -> list[Solid]:
    return [grain(rng, get_args(Habit)[i % 5], rng.uniform(0.02, 0.03), 0.2, 3.0) for i in range(n)]


def test_no_two_bodies_overlap_and_all_are_inside(rng: np.random.Generator) -> None:
    loose = _loose(rng)
    height = radius = (sum(volume(solid) for solid in loose) / 0.36 / math.pi) ** (1 / 3)
    placed = _placed(loose, arrange(rng, bodies_of(loose), radius, height))
    assert overlapping(placed) == []
    for solid in placed:
        if isinstance(solid, Ellipsoid):
            ball = rng.normal(size=(500, 3))
            points = solid.centre + (ball / np.linalg.norm(ball, axis=1, keepdims=True)) @ spread(solid).T
        else:
            points = corners(solid)
        assert np.hypot(points[:, 0], points[:, 1]).max() <= radius * (1 + 1e-9)
        assert np.abs(points[:, 2]).max() <= height / 2 * (1 + 1e-9)


def test_the_check_sees_overlaps(rng: np.random.Generator) -> None:
    """Balls and boxes that touch at a known distance, moved a little nearer and a little apart."""
    ball, box = Ellipsoid((0.1,) * 3, 1.0), Box((0.2, 0.1, 0.1), 1.0)
    for one, other, touch in ((ball, ball, 0.2), (box, box, 0.2), (ball, box, 0.2), (box, ball, 0.2)):
        for factor, pairs in ((0.999, [(0, 1)]), (1.001, [])):
            assert overlapping([one, replace(other, centre=(touch * factor, 0.0, 0.0))]) == pairs
    loose = _loose(rng)
    scattered = _placed(loose, rng.uniform(-0.06, 0.06, (len(loose), 3)))
    assert len(overlapping(scattered)) > 50


def test_a_gap_is_kept(rng: np.random.Generator) -> None:
    balls = [Ellipsoid((0.01,) * 3, 1.0)] * 150
    centres = arrange(rng, bodies_of(balls), 0.1, 0.15, gap=0.002)
    distance = np.linalg.norm(centres[:, None] - centres, axis=2) + np.eye(150)
    assert distance.min() >= 0.022
    boxes = [grain(rng, "octahedron", 0.02, 0.0, 1.0) for _ in range(40)]
    placed = _placed(boxes, arrange(rng, bodies_of(boxes), 0.06, 0.1, gap=0.002))
    gaps = [to_hull((corners(a)[:, None] - corners(b)).reshape(-1, 3)) for a, b in combinations(placed, 2)]
    assert min(gaps) >= 0.002 * (1 - 1e-5)  # the heavy row is not infinitely heavy


def test_balls_fill_half_of_a_cylinder(rng: np.random.Generator) -> None:
    """Well beyond random sequential addition, which stalls at 0.38."""
    balls = [Ellipsoid((0.01,) * 3, 1.0)] * 300
    side = (300 * 4 / 3 * 0.01**3 / 0.5) ** (1 / 3)  # of a cylinder as high as its radius
    centres = arrange(rng, bodies_of(balls), side, side)
    distance = np.linalg.norm(centres[:, None] - centres, axis=2) + np.eye(300)
    assert distance.min() >= 0.02


def test_places_do_not_depend_on_how_a_processor_rounds(rng: np.random.Generator) -> None:
    """Each sweep enlarges a difference of the last digit: without rounding, the same seed gave another sample."""
    bodies = bodies_of(_loose(np.random.default_rng(3), 30))
    elsewhere = bodies._replace(
        **{
            name: lengths * (1 + 2e-16 * rng.choice((-1, 1), lengths.shape))
            for name in ("reach", "across", "up", "spread", "corners")
            for lengths in (getattr(bodies, name),)
        }
    )
    assert (elsewhere.corners != bodies.corners).any()
    here, there = (arrange(np.random.default_rng(1), some, 0.08, 0.08) for some in (bodies, elsewhere))
    np.testing.assert_array_equal(here, there)


def test_what_cannot_be_is_refused(rng: np.random.Generator) -> None:
    balls = [Ellipsoid((0.01,) * 3, 1.0)] * 50
    with refused(ValueError):
        arrange(rng, bodies_of(balls), 0.009, 0.1)
    with refused(ValueError):
        arrange(rng, bodies_of(balls), 0.03, 0.05, sweeps=30)
    with refused(ValueError):
        bodies_of([Cylinder(0.1, 0.1, 1.0)])
    with refused(ValueError):
        bodies_of([Polyhedron(((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), 1.0)])
