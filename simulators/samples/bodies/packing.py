"""Packing: solids as flat arrays for the kernels, the rays of a frame, and the bodies that may shadow each row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulators.frame.shot import CannotExposeError, Detector, Pose
from simulators.samples.bodies.solids import Cylinder, Ellipsoid, Quaternion, Solid

Reals = NDArray[np.float64]
Wholes = NDArray[np.int64]

CYLINDER, ELLIPSOID, POLYHEDRON = 0, 1, 2


class Packed(NamedTuple):
    """Solids as flat arrays for numba, one entry a solid.

    Attributes:
        kind: int64 [n], CYLINDER, ELLIPSOID or POLYHEDRON.
        attenuation: float64 [n], 1/mm.
        centre, extent: float64 [n, 3], middle and half size of the axis-aligned box around the body, mm.
        size: float64 [n, 2]. CYLINDER: (radius, half height); ELLIPSOID: (smallest, largest semi-axis); POLYHEDRON: (0,
            distance of the farthest corner).
        matrix: float64 [n, 3, 3]. ELLIPSOID: W with |W q| <= 1 inside, q from the centre.
        first_face: int64 [n + 1]; a POLYHEDRON's faces are first_face[i] to first_face[i + 1] of the next.
        faces: float64 [face, 4], unit normal and distance from the centre: normal · q <= distance inside.
        first_vertex: int64 [n + 1], in the same way.
        vertices: float64 [vertex, 3], from the centre.
    """

    kind: Wholes
    attenuation: Reals
    centre: Reals
    extent: Reals
    size: Reals
    matrix: Reals
    first_face: Wholes
    faces: Reals
    first_vertex: Wholes
    vertices: Reals


def pack(solids: Sequence[Solid]) -> Packed:
    """Flat arrays for the kernels; see Packed."""
    n = len(solids)
    kind, size, matrix = np.zeros(n, np.int64), np.zeros((n, 2)), np.zeros((n, 3, 3))
    centre, extent = np.array([solid.centre for solid in solids]).reshape(n, 3), np.zeros((n, 3))
    faces, vertices = [np.zeros((0, 4))] * n, [np.zeros((0, 3))] * n
    for i, solid in enumerate(solids):
        if isinstance(solid, Cylinder):
            kind[i], size[i] = CYLINDER, (solid.radius, solid.height / 2)
            extent[i] = solid.radius, solid.radius, solid.height / 2
        elif isinstance(solid, Ellipsoid):
            axes, half = rotation(solid.quaternion).T, np.array(solid.semi_axes)
            kind[i], size[i], matrix[i] = ELLIPSOID, (half.min(), half.max()), axes / half[:, None]
            extent[i] = np.linalg.norm(axes * half[:, None], axis=0)
        else:
            kind[i] = POLYHEDRON
            hull, axes = solid.hull(), rotation(solid.quaternion).T
            normals, corners = hull.normals @ axes, hull.vertices @ axes
            low, high = corners.min(axis=0), corners.max(axis=0)
            middle, extent[i] = (low + high) / 2, (high - low) / 2
            centre[i] += middle
            faces[i] = np.column_stack([normals, hull.distances - normals @ middle])
            vertices[i] = corners - middle
            size[i, 1] = np.linalg.norm(vertices[i], axis=1).max()
    attenuation = np.array([solid.attenuation for solid in solids], dtype=np.float64)
    return Packed(
        kind, attenuation, centre, extent, size, matrix,
        _starts(faces), np.concatenate([np.zeros((0, 4)), *faces]),
        _starts(vertices), np.concatenate([np.zeros((0, 3)), *vertices]),
    )  # fmt: skip


def rotation(quaternion: Quaternion) -> Reals:
    """Rotation matrix [3, 3] of a quaternion (w, x, y, z) of any length but zero."""
    length = math.hypot(*quaternion)  # numpy's norm overflows or underflows for 1e200 and 1e-200
    w, x, y, z = (part / length for part in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _starts(parts: list[Reals]) -> Wholes:
    """Start of each part in their concatenation, and the end of the last."""
    return np.cumsum([0] + [len(part) for part in parts], dtype=np.int64)


class View(NamedTuple):
    """The rays of a frame, for numba.

    Attributes:
        u, v: float64 [col], [row], mm.
        pitch: mm.
        sod: mm, infinite in a parallel beam.
        axes: float64 [pose, 3, 3] and
        origin: float64 [pose, 3], see Pose.frames; one pose for the frame, or one a row.
        upright: True if the beam is parallel and z of the sample is v of the laboratory. first: int64 [row + 1]; the
            entries first[j] to first[j + 1] of `bodies` may shadow row j. bodies: int64, indices of bodies in ascending
            order.
    """

    u: Reals
    v: Reals
    pitch: float
    sod: float
    axes: Reals
    origin: Reals
    upright: bool
    first: Wholes
    bodies: Wholes


def view_of(p: Packed, names: Sequence[str], pose: Pose, detector: Detector) -> View:
    """The rays of a frame.

    Args:
        names: of the solids, for messages.

    Raises:
        ValueError: the number of the pose's angles differs from the number of rows.
        CannotExposeError: a body at or behind the source of a cone.
    """
    rows = detector.shape[0]
    if pose.angle.shape != (rows,):
        raise ValueError(f"the pose has {pose.angle.size} angles and the detector {rows} rows; give one angle per row")
    shift, tilt = pose.shift, pose.tilt
    if all(a is None or bool((a == a[:1]).all()) for a in (pose.angle, shift, tilt)):  # one pose for all rows
        shift, tilt = None if shift is None else shift[:1], None if tilt is None else tilt[:1]
        axes, origin = Pose(pose.angle[:1], shift, tilt).frames()
    else:
        axes, origin = pose.frames()
    upright = math.isinf(detector.sod) and (pose.tilt is None or not pose.tilt.any())
    low, high = _reach(p, axes, origin, 2)
    ahead = np.ones(p.kind.size, dtype=np.bool_)
    if math.isfinite(detector.sod):
        nearest, farthest = _reach(p, axes, origin, 1)
        ahead = nearest > -detector.sod
        _check_ahead(p, names, axes, origin, detector.sod, np.flatnonzero(~ahead))
        large, small = (detector.sod / np.where(ahead, detector.sod + b, np.inf) for b in (nearest, farthest))
        low, high = np.minimum(low * large, low * small), np.maximum(high * large, high * small)
    above = np.clip(np.ceil(low / detector.pitch + detector.axis_row - 1e-9), 0, rows)
    below = np.clip(np.floor(high / detector.pitch + detector.axis_row + 1e-9) + 1, 0, rows)
    above, below = np.where(ahead, above, 0).astype(np.int64), np.where(ahead, below, rows).astype(np.int64)
    first, bodies = _by_row(above, below, rows)
    pitch, sod = float(detector.pitch), float(detector.sod)
    return View(detector.u(), detector.v(), pitch, sod, axes, origin, bool(upright), first, bodies)


def _reach(p: Packed, axes: Reals, origin: Reals, k: int) -> tuple[Reals, Reals]:
    """Bounds of each body along the laboratory's k-th axis in all poses, mm.

    The bounds are the box of the body in the first pose, widened by the difference of the poses."""
    axis, at = axes[:, :, k], np.einsum("ri,ri->r", axes[:, :, k], origin)
    drift = np.linalg.norm(axis - axis[0], axis=1).max(initial=0.0)
    far = np.linalg.norm(p.centre, axis=1) + np.linalg.norm(p.extent, axis=1)
    reach = p.extent @ np.abs(axis[0]) + drift * far + np.abs(at - at[0]).max(initial=0.0)
    middle = p.centre @ axis[0] - at[0]
    return middle - reach, middle + reach


def _check_ahead(p: Packed, names: Sequence[str], axes: Reals, origin: Reals, sod: float, doubtful: Wholes) -> None:
    """Raises CannotExposeError if a doubtful body, by its exact shape, is not wholly in front of the source."""
    for i in doubtful:
        axis = axes[:, :, 1]
        if p.kind[i] == CYLINDER:
            reach = p.size[i, 0] * np.hypot(axis[:, 0], axis[:, 1]) + p.size[i, 1] * np.abs(axis[:, 2])
        elif p.kind[i] == ELLIPSOID:
            reach = np.linalg.norm(np.linalg.solve(p.matrix[i].T, axis.T), axis=0)
        else:
            corners = p.vertices[p.first_vertex[i] : p.first_vertex[i + 1]]
            reach = -(axis @ corners.T).min(axis=1)
        gap = float((np.einsum("ri,ri->r", axis, p.centre[i] - origin) - reach).min() + sod)
        if not gap > 1e-9 * sod:
            raise CannotExposeError(
                f"solid {i} ({names[i]}) extends {-gap:.3g} mm behind the source, which is {sod:g} mm in "
                "front of the rotation axis. All of it must be between source and detector: move it, or "
                "increase sod. No frame was computed"
            )


def _by_row(above: Wholes, below: Wholes, rows: int) -> tuple[Wholes, Wholes]:
    """The bodies that touch each row, and the start of the entries of each row. The work is linear in the number of
    entries."""
    height = np.maximum(below - above, 0)
    bodies = np.repeat(np.arange(above.size), height)
    row = np.arange(bodies.size) - np.repeat(np.cumsum(height) - height, height) + above[bodies]
    return np.append(0, np.cumsum(np.bincount(row, minlength=rows))), bodies[np.argsort(row, kind="stable")]
