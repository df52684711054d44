"""Bodies: one solid of each kind, a test by definition of whether a point is inside, and chords that a search with only
this test finds."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from simulators.frame.shot import Detector, Pose
from simulators.samples.bodies.solids import (
    Box,
    Cylinder,
    Ellipsoid,
    Polyhedron,
    Solid,
    Vector,
    octahedron,
    plate,
    truncated_octahedron,
)

Reals = NDArray[np.float64]

CENTRE, QUATERNION = (0.11, -0.07, 0.05), (0.8, -0.3, 0.5, 0.4)
CORNERS = ((-0.2, -0.15, -0.1), (0.3, -0.1, -0.12), (0.05, 0.28, -0.08), (0.1, 0.05, 0.3), (-0.15, 0.2, 0.15))
SPIRAL = [(k * 2.4, (2 * k - 23) / 24) for k in range(24)]  # points all over a ball, no four in a plane
GEM = tuple(
    (0.3 * math.cos(a) * math.sqrt(1 - z * z), 0.25 * math.sin(a) * math.sqrt(1 - z * z), 0.2 * z) for a, z in SPIRAL
)
SOLIDS: dict[str, Solid] = {
    "cylinder": Cylinder(0.3, 0.5, 2.0, CENTRE),
    "sphere": Ellipsoid((0.25, 0.25, 0.25), 1.5, CENTRE),
    "ellipsoid": Ellipsoid((0.35, 0.2, 0.1), 1.5, CENTRE, QUATERNION),
    "upright box": Box((0.5, 0.3, 0.4), 1.2, CENTRE),
    "box": Box((0.5, 0.3, 0.4), 1.2, CENTRE, QUATERNION),
    "octahedron": Polyhedron(octahedron((0.3, 0.25, 0.35)), 1.2, CENTRE, QUATERNION),
    "plate": Polyhedron(plate(0.5, 0.15), 1.3, CENTRE, QUATERNION),
    "upright plate": Polyhedron(plate(0.5, 0.15), 1.3, CENTRE),
    "truncated octahedron": Polyhedron(truncated_octahedron((0.3, 0.25, 0.35), 0.7), 1.2, CENTRE, QUATERNION),
    "corners": Polyhedron(CORNERS, 1.4, CENTRE, QUATERNION),
    "gem": Polyhedron(GEM, 1.4, CENTRE, QUATERNION),
}


def level(solid: Solid, points: Reals) -> Reals:
    """A convex function of points [..., 3], <= 0 inside, written from the definition of each solid alone."""
    q = points - np.array(solid.centre)
    if isinstance(solid, Cylinder):
        return np.maximum(np.hypot(q[..., 0], q[..., 1]) - solid.radius, np.abs(q[..., 2]) - solid.height / 2)
    q = q @ _axes(solid.quaternion)
    if isinstance(solid, Ellipsoid):
        return np.linalg.norm(q / np.array(solid.semi_axes), axis=-1) - 1
    if isinstance(solid, Box):
        return (np.abs(q) - np.array(solid.edges) / 2).max(-1)
    planes = _hull(solid.vertices)
    return (q @ planes[:, :3].T + planes[:, 3]).max(-1)


@cache
def _axes(quaternion: tuple[float, ...]) -> Reals:
    """The body's axes, a column each."""
    w, x, y, z = quaternion
    return Rotation.from_quat([x, y, z, w]).as_matrix()


@cache
def _hull(vertices: tuple[Vector, ...]) -> Reals:
    """Planes n · p + d <= 0, [face, 4]."""
    return np.asarray(ConvexHull(vertices).equations)


def inside(solid: Solid, points: Reals) -> NDArray[np.bool_]:
    """Indicator of a solid at points [..., 3]."""
    return level(solid, points) <= 0


def volume(solid: Solid) -> float:
    """mm³."""
    if isinstance(solid, Cylinder):
        return math.pi * solid.radius**2 * solid.height
    if isinstance(solid, Ellipsoid):
        return 4 / 3 * math.pi * math.prod(solid.semi_axes)
    return math.prod(solid.edges) if isinstance(solid, Box) else float(ConvexHull(solid.vertices).volume)


def reach(solid: Solid) -> float:
    """mm from its centre, beyond which it is not."""
    if isinstance(solid, Cylinder):
        return math.hypot(solid.radius, solid.height / 2)
    if isinstance(solid, Ellipsoid):
        return max(solid.semi_axes)
    corners = [np.array(solid.edges) / 2] if isinstance(solid, Box) else solid.vertices
    return max(float(np.linalg.norm(corner)) for corner in corners)


def chords(solid: Solid, start: Reals, ray: Reals, far: float) -> Reals:
    """Lengths of rays start + t ray/|ray| [..., 3], |t| <= far, inside a solid: the least level by golden section, then
    both crossings by bisection; no formula of a chord."""
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    # From the point nearest to the body's middle, so that digits are not lost on the way from a far source.
    start = start + ray * ((np.array(solid.centre) - start) * ray).sum(-1, keepdims=True)
    found = np.zeros(start.shape[:-1])
    near = np.linalg.norm(start - solid.centre, axis=-1) <= 1.001 * reach(solid)  # the others pass it by
    start, ray = start[near], ray[near]

    def at(t: Reals) -> Reals:
        return level(solid, start + t[..., None] * ray)

    golden = (math.sqrt(5) - 1) / 2
    low, high = np.full(start.shape[:-1], -far), np.full(start.shape[:-1], far)
    for _ in range(46):
        a, b = high - golden * (high - low), low + golden * (high - low)
        left = at(a) < at(b)
        low, high = np.where(left, low, a), np.where(left, b, high)
    best = (low + high) / 2
    hit = at(best) <= 0
    near[near] = hit
    start, ray, best = start[hit], ray[hit], best[hit]

    def crossing(outside: float) -> Reals:
        within, without = best.copy(), np.full(best.shape, outside)
        for _ in range(40):
            middle = (within + without) / 2
            is_in = at(middle) <= 0
            within, without = np.where(is_in, middle, within), np.where(is_in, without, middle)
        return within

    found[near] = crossing(far) - crossing(-far)
    return found


def rays(pose: Pose, detector: Detector) -> tuple[Reals, Reals]:
    """Start and direction [row, col, 3] of each pixel's ray in the sample's axes, from the definitions in pose.py: the
    laboratory point p is where the sample's point Rv Rb Ru Rz(angle) x + shift lies."""
    starts, directions = [], []
    for j, v in enumerate(detector.v()):
        c, s = math.cos(pose.angle[j]), math.sin(pose.angle[j])
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # (x, y, z) -> (u, b, v)
        about_u, about_b = (0.0, 0.0) if pose.tilt is None else pose.tilt[j]
        lean = Rotation.from_rotvec([0, about_b, 0]) * Rotation.from_rotvec([about_u, 0, 0])
        to_sample = (lean.as_matrix() @ turn).T
        shift = np.zeros(3) if pose.shift is None else pose.shift[j]
        u = detector.u()
        pixel = np.stack([u, np.zeros_like(u), np.full_like(u, v)], axis=-1)
        source = np.array([0, -detector.sod, 0]) if math.isfinite(detector.sod) else pixel - [0, 1, 0]
        starts.append((np.broadcast_to(source, pixel.shape) - shift) @ to_sample.T)
        directions.append((pixel - source) @ to_sample.T)
    return np.array(starts), np.array(directions)
