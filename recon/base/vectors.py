"""Vectors for each projection (source or ray, detector, columns, rows), as ASTRA and programs based on it use them.

Each projection has one row of vectors. All lengths have the same unit; the origin of (x, y, z) is the middle of the
volume (ASTRA Toolbox, 3D geometries, `parallel3d_vec` and `cone_vec`):

    ray or source   direction of the parallel beam, or place of the source
    d               middle of the detector
    u, v            from one pixel to the next one of its row, and of its column

So the middle of pixel (row, col) is d + (col - (cols - 1) / 2) u + (row - (rows - 1) / 2) v. A volume [z, y, x] is the
same array here and in ASTRA. ASTRA has projections as [row, view, col]; tomosipo writes vectors as (z, y, x).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import F64
from recon.base.declared_types import check_arguments
from recon.base.geometry import Geometry
from recon.base.placement import Where

TOLERANCE = 0.1
"""Largest distance, in pixels, that a detector corner of the geometry may have from the corner that the vectors
give."""

_PARALLEL = 1e-6  # u and v count as parallel if the perpendicular part of one is below this share of its length
_CLEAN = 1e-9  # rad, pixels, or share of the distance to the source; smaller values are rounding errors


def geometry_of_vectors(vectors: ArrayLike, detector_shape: tuple[int, int], *, cone: bool) -> Geometry:
    """The geometry of projections that are given as vectors, as in ASTRA. The beam may be parallel in any direction, or
    a cone from any source.

    The detector pixels are squares of one size. For a parallel beam, the detector is perpendicular to the beam. For a
    cone, the distance from the source to the detector is the same in all projections. The origin (x, y, z) = 0 need not
    be projected to the centre of the detector.

    Args:
        vectors: float [view, 12], in mm; the docstring of `recon.base.vectors` defines the twelve numbers.
        detector_shape: (rows, cols) in pixels.
        cone: True: the first three values are the source; False: the first three values are the direction of the beam
            (with either sign).

    Raises:
        ValueError: the shape of the vectors is not [view, 12], the vectors are not finite, or the vectors of a
            projection do not describe a detector with square pixels (tolerance: `TOLERANCE` pixels at the corners).
    """
    check_arguments(geometry_of_vectors, locals())
    table = np.asarray(vectors, np.float64)
    rows, cols = detector_shape
    if table.ndim != 2 or table.shape[1] != 12 or not len(table):
        raise ValueError(f"vectors must have shape [view, 12] (ray direction or source, d, u, v), got {table.shape}")
    if not np.isfinite(table).all():
        bad_view = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
        raise ValueError(f"the vectors of projection {bad_view} are not finite: {table[bad_view].tolist()}")
    first, middle, u, v = table.reshape(-1, 4, 3).transpose(1, 0, 2)
    if not cone:
        u, v = (_across(vector, first) for vector in (u, v))
    frame = _frame(u, v)
    along_cols, along_rows, beam = frame
    sizes = (_dot(u, along_cols) + _dot(v, along_rows)) / 2
    distances = _distances(middle - first, beam) if cone else np.ones(len(table))
    sdd = float(np.median(distances))
    scale = (sdd / distances)[:, None]  # factor that scales to a detector at the common distance
    pitch = float(np.median(sizes * scale[:, 0]))
    _require_pixels(u * scale, v * scale, frame, pitch, (rows, cols))
    foot = first + distances[:, None] * beam if cone else np.zeros_like(middle)  # the origin is projected to this point
    pixels = np.stack((_dot(foot - middle, along_cols), _dot(foot - middle, along_rows)), 1) / sizes[:, None]
    pixels += (cols - 1) / 2, (rows - 1) / 2
    axis_col, axis_row = np.median(pixels, axis=0)
    theta, roll, tilt = _angles(*frame)
    where = Where(
        axis_col=axis_col, axis_row=axis_row, shifts=_clean(pixels - (axis_col, axis_row)), roll=roll, tilt=tilt
    )  # fmt: skip
    if not cone:
        return Geometry.parallel(theta, (rows, cols), pixel_pitch=pitch, **where)
    sod = float(np.median(-_dot(first, beam)))
    if not 0 < sod <= sdd * (1 + _CLEAN):
        raise ValueError(
            "the middle of the volume must lie between the sources and the detectors. The distance from the sources "
            f"is {sod:.6g} mm to the middle of the volume, and {sdd:.6g} mm to the detectors. Measure all vectors "
            "from a point in the sample"
        )
    centres = first + sod * beam
    centres[np.abs(centres).max(axis=1) < _CLEAN * sod] = 0
    return Geometry.cone(theta, (rows, cols), pitch, min(sod, sdd), sdd, **where).about(centres)


def vectors_of(geometry: Geometry) -> F64:
    """The vectors [view, 12] of a geometry in mm. For a parallel beam the first three numbers are the direction of the
    beam.

    Raises:
        ValueError: the geometry has a skew (rolling shutter), so that rows have different angles.
    """
    check_arguments(vectors_of, locals())
    if geometry.skew:
        raise ValueError(
            "vectors hold one angle for each projection, but these projections have a skew, which gives each row its "
            "own angle"
        )
    rows, cols = geometry.detector_shape
    axes = np.array([geometry.axes(view) for view in range(geometry.n_views)])
    along_cols, along_rows, beam = axes.transpose(1, 0, 2)
    offsets = np.array([geometry.origin(view) for view in range(geometry.n_views)]) - ((cols - 1) / 2, (rows - 1) / 2)
    middle = -geometry.pixel_pitch * (offsets[:, :1] * along_cols + offsets[:, 1:] * along_rows)
    first = beam
    if geometry.is_cone:
        first = geometry.centres - geometry.sod * beam
        middle += first + geometry.sdd * beam
    return np.hstack((first, middle, geometry.pixel_pitch * along_cols, geometry.pixel_pitch * along_rows))


def _dot(a: F64, b: F64) -> F64:
    return np.asarray(np.einsum("vi,vi->v", a, b))


def _clean(values: F64) -> F64:
    return np.where(np.abs(values) < _CLEAN, 0.0, values)


def _across(vectors: F64, rays: F64) -> F64:
    """The components of vectors perpendicular to the rays of a parallel beam."""
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    if not lengths.all():
        raise ValueError(f"projection {int(np.flatnonzero(lengths == 0)[0])}: the direction of the beam is zero")
    directions = rays / lengths
    return vectors - _dot(vectors, directions)[:, None] * directions


def _frame(u: F64, v: F64) -> tuple[F64, F64, F64]:
    """The orthonormal pair nearest to each (u, v) (polar decomposition), and the beam perpendicular to them."""
    left, sizes, right = np.linalg.svd(np.stack((u, v), axis=2), full_matrices=False)
    flat = sizes[:, 1] <= _PARALLEL * sizes[:, 0]
    if flat.any():
        view = int(np.flatnonzero(flat)[0])
        raise ValueError(
            f"projection {view}: u and v must be different directions across the beam. One of u and v is zero or lies "
            f"along the beam, or u and v are parallel: {u[view]} and {v[view]}"
        )
    along_cols, along_rows = (left @ right).transpose(2, 0, 1)
    return along_cols, along_rows, np.cross(along_rows, along_cols)


def _distances(to_detector: F64, beam: F64) -> F64:
    """Distances in mm from the sources of a cone to their detectors."""
    distances = _dot(to_detector, beam)
    if (distances <= 0).any():
        raise ValueError(
            f"projection {int(np.flatnonzero(distances <= 0)[0])}: u, v and the direction from source to detector "
            "have the wrong handedness, as in a mirrored image. If rows count from the top, reverse the rows and v "
            "of all projections"
        )
    return distances


def _require_pixels(u: F64, v: F64, frame: tuple[F64, F64, F64], size: float, shape: tuple[int, int]) -> None:
    """Raise ValueError if the corners of a detector differ by more than `TOLERANCE` from those of a detector with
    square pixels of `size`."""
    by_col, by_row = ((vector - size * unit) / size for vector, unit in zip((u, v), frame, strict=False))
    rows, cols = shape
    corners = [by_col * cols / 2 + sign * by_row * rows / 2 for sign in (1, -1)]
    deviations = np.linalg.norm(corners, axis=2).max(axis=0)
    view = int(np.argmax(deviations))
    if deviations[view] > TOLERANCE:
        raise ValueError(
            f"projection {view}: the detector pixels must be squares of {size:.6g} as in the other projections. A "
            f"corner of the detector is off by {deviations[view]:.3g} pixels, and {TOLERANCE} are allowed. Resample "
            "the projections to one detector"
        )


def _angles(along_cols: F64, along_rows: F64, beam: F64) -> tuple[F64, F64, F64]:
    """Angle, roll and tilt of each projection, as in `Geometry.axes`."""
    tilt = -np.arcsin(np.clip(beam[:, 2], -1, 1))
    # beam along the rotation axis: roll and angle have the same effect
    upright = np.hypot(beam[:, 0], beam[:, 1]) < 1e-12
    theta = np.where(upright, np.arctan2(along_cols[:, 1], along_cols[:, 0]), np.arctan2(-beam[:, 0], beam[:, 1]))
    c, s = np.cos(theta), np.sin(theta)
    level = np.stack((c, s, np.zeros_like(c)), 1)
    roll = np.arctan2(-_dot(along_rows, level), _dot(along_cols, level))
    return np.unwrap(theta), _clean(roll), _clean(tilt)
