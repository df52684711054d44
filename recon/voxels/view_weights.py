"""Quadrature weights of projections and their rays for back-projection: any angles, gaps, rays measured twice."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import F64
from recon.base.geometry import Geometry

_GAP_LIMIT = 8.0  # an angular gap this many times the usual one may be missing data, not coarse sampling
# a wider gap is missing data, even if there are many such gaps, unless most projections are as far apart
_WIDEST_USUAL_ANGLE = np.pi / 6
_MOST_USUAL_STEPS = 2.5  # most usual steps between the projections of a part of a scan
_LARGEST_REGULAR_VARIATION = (
    0.4  # standard deviation of gaps over their mean: 0.24 for golden angles, about 0.7 for random ones
)
_SAME_ANGLE = 1e-3  # share of the mean step; projections that are closer share one weight


def angular_weights(angles: ArrayLike, whole_scan: ArrayLike | None = None) -> NDArray[np.float64]:
    """Quadrature weight of each projection in radians: its Voronoi cell on the half circle.

    Projections at θ and θ + π see the same rays, so angles count modulo π; projections with equal angles share their
    cell. The weights sum to π if the half circle is covered, also by projections in groups, and if a part is repeated
    with finer steps. Projections next to a missing wedge (see `_missing`) have weights as if the sampling continued,
    and the sum is the covered angle.

    Args:
        angles: [view], radians, any order and range.
        whole_scan: angles of the scan of which these projections are a part. A missing wedge is then judged by the
            usual step of that scan.

    Raises:
        ValueError: there are no angles, or some are not finite.
    """
    theta = np.mod(np.asarray(angles, dtype=np.float64).ravel(), np.pi)
    if theta.size == 0 or not np.isfinite(theta).all():
        raise ValueError(f"FBP weights need at least one angle, and all angles must be finite; got {theta.size} angles")
    whole = None if whole_scan is None else np.asarray(whole_scan, np.float64).ravel()
    if theta.size == 1:
        return np.full(1, np.pi if whole is None else _usual_step(whole))
    order = np.argsort(theta, kind="stable")
    ordered = theta[order]
    # Group equal angles. Angles are periodic, so a last group just below π may belong to the first group.
    tolerance = _SAME_ANGLE * np.pi / theta.size
    group = np.concatenate([[0], np.cumsum(np.diff(ordered) > tolerance)])
    first_angles = ordered[np.concatenate([[True], np.diff(group) > 0])]
    if group[-1] > 0 and first_angles[0] + np.pi - ordered[-1] <= tolerance:
        group[group == group[-1]] = 0
        first_angles = first_angles[:-1]
    if first_angles.size == 1:
        return np.full(theta.size, (np.pi if whole is None else _usual_step(whole)) / theta.size)
    gaps = np.diff(first_angles, append=first_angles[0] + np.pi)
    if whole is None:
        typical, missing = float(np.median(gaps)), _missing(gaps, math.pi)
    else:
        typical, usual_half_step = _usual_step(whole), _half_step(_different(whole))
        missing = gaps > _GAP_LIMIT * np.clip(_half_step(gaps), usual_half_step, _MOST_USUAL_STEPS * usual_half_step)
    gaps = np.where(missing, typical, gaps)
    cells = (gaps + np.roll(gaps, 1)) / 2
    weights = np.empty_like(theta)
    weights[order] = (cells / np.bincount(group))[group]
    return weights


def _usual_step(angles: F64) -> float:
    """The median step between different angles modulo π."""
    return float(np.median(_different(angles)))


def _different(angles: F64) -> F64:
    """The gaps between different angles modulo π."""
    theta = np.unique(np.mod(angles, np.pi))
    gaps = np.diff(theta, append=theta[0] + np.pi)
    return gaps[gaps > _SAME_ANGLE * np.pi / angles.size]


def _half_step(gaps: F64) -> float:
    """The gap up to which gaps make up half of the angle, without the widest one.

    For groups, it is that between groups.
    """
    without_widest = np.sort(gaps)[:-1] if gaps.size > 1 else gaps
    total = np.cumsum(without_widest)
    return float(without_widest[np.searchsorted(total, total[-1] / 2)])


def covers_the_circle(angles: ArrayLike) -> bool:
    """Whether the projections cover the full circle, without a missing arc."""
    gaps = _gaps(np.mod(np.asarray(angles, np.float64).ravel(), 2 * np.pi))[1]
    return gaps.size > 1 and not _leave_an_arc(gaps)


def circle_weights(angles: ArrayLike) -> F64:
    """Quadrature weight of each projection in radians: its Voronoi cell on the full circle. The weights sum to 2π.

    Args:
        angles: [view], radians, any order and range; projections with equal angles share their cell.

    Raises:
        ValueError: there are fewer than two angles, some are not finite, or an arc is missing.
    """
    theta = np.mod(np.asarray(angles, np.float64).ravel(), 2 * np.pi)
    if theta.size < 2 or not np.isfinite(theta).all():
        raise ValueError(f"FDK needs at least two angles, and all angles must be finite; got {theta.size} angles")
    order, gaps = _gaps(theta)
    if _leave_an_arc(gaps):
        raise ValueError(
            f"for a short scan use `cone_weights`: the angles have a gap of {np.rad2deg(gaps.max()):.4g} degrees, "
            "but weights for a circle need the full circle"
        )
    weights = np.empty_like(theta)
    weights[order] = (gaps + np.roll(gaps, 1)) / 2
    return weights


def ray_weights(geometry: Geometry) -> tuple[F64, tuple[int, int]]:
    """Quadrature weight of each ray of a parallel beam in radians, on a detector extended by columns of zeros.

    In a 360° scan, the ray at u in a projection is measured again at -u in the opposite projection, if the detector
    reaches that far. The two measurements share the weight. If the axis is off the middle, the rays of the far columns
    are measured once and have the full weight. In between, shares rise from 0 to 1 like sin². They rise over as many
    columns as are measured once, but at most half of those measured twice. So columns just off the middle remain means
    of two (Wang 2002, Med. Phys. 29, 1634, for cone beams). Projections that end before -u need zeros up to -u, because
    the part that filtering spreads into them belongs to the integral.

    Projections that do not cover 360° have the weights of `angular_weights` in all columns, because for a far column
    the opposite projection would be missing.

    Returns:
        Weights [view, 1 + col + 1], the first and the last for values beyond the edges (0 if an opposite projection
        sees them), and the numbers of columns of zeros to add before and after.
    """
    weights_of_views = np.repeat(angular_weights(geometry.angles)[:, None], geometry.detector_shape[1] + 2, axis=1)
    if not covers_the_circle(geometry.angles):
        return weights_of_views, (0, 0)
    share, zeros = column_shares(geometry)
    return _weighed(share, weights_of_views, circle_weights(geometry.angles)[:, None]), zeros


def column_shares(geometry: Geometry) -> tuple[F64, tuple[int, int]]:
    """Weight [view, 1 + col + 1] of each ray in a 360° scan, shared with its opposite ray, and the columns of zeros."""
    cols, axis = geometry.detector_shape[1], geometry.axis_col + geometry.shifts[:, 0]
    return _shares(cols, axis, axis[_nearest(geometry.angles, geometry.angles + np.pi)])


def seen_by(geometry: Geometry, rows: F64) -> NDArray[np.bool_]:
    """Which projections of a parallel beam without roll and tilt see which slices, [view, slice].

    Args:
        rows: [slice], detector rows at which an unshifted projection sees the slices.
    """
    detector_rows = rows + geometry.shifts[:, 1:]
    return (detector_rows >= -0.5) & (detector_rows <= geometry.detector_shape[0] - 0.5)


def slice_weights(geometry: Geometry, covered: NDArray[np.bool_], share: F64) -> F64:
    """Weights [view, 1 + col + 1] of the rays of one slice, from the projections that see it; 0 for the others.

    The weights are those of `ray_weights`. If projections step along the axis, each slice is seen from its own set of
    angles, some of them several times.

    Args:
        covered: [view], True for projections that see the slice.
        share: `column_shares` of all projections.
    """
    weights = np.zeros(share.shape)
    if not covered.any():
        return weights
    angles = geometry.angles[covered]
    both = angular_weights(angles, geometry.angles)[:, None]
    weights[covered] = (
        _weighed(share[covered], both, circle_weights(angles)[:, None]) if covers_the_circle(angles) else both
    )
    return weights


def partly_seen(geometry: Geometry, rows: F64) -> NDArray[np.bool_]:
    """Mask [slice] of the slices that are seen over less than 180° while other slices are seen over more.

    Args:
        rows: as for `seen_by`.
    """
    keys, known = list[bytes](), dict[bytes, float]()
    for row_covered in seen_by(geometry, rows).T:
        keys.append(row_covered.tobytes())
        if keys[-1] not in known:
            angles = geometry.angles[row_covered]
            known[keys[-1]] = float(angular_weights(angles, geometry.angles).sum()) if angles.size else 0.0
    covered = np.array([known[key] for key in keys])
    return covered < covered.max() - 1.5 * _usual_step(geometry.angles)


def _weighed(share: F64, both: F64, alone: F64) -> F64:
    return np.where(share <= 0.5, 2 * share * both, both + (2 * share - 1) * (alone - both))


def fan_shares(geometry: Geometry) -> tuple[F64, tuple[int, int]]:
    """Share of each column of a cone beam's detector in a full circle; 1/2 if a ray is measured twice.

    It is computed as in `ray_weights` for a parallel beam (Wang 2002, Med. Phys. 29, 1634): the ray at u is measured
    again at -u by another projection of the circle. All projections are assumed to have the mean axis. Near the
    detector's middle, all shares are 1/2.

    Returns:
        Shares [1 + col + 1] and columns of zeros, as for `ray_weights`.
    """
    cols = geometry.detector_shape[1]
    if not geometry.is_off_middle:
        return np.full(cols + 2, 0.5), (0, 0)
    axis = np.array([geometry.axis_col + geometry.shifts[:, 0].mean()])
    share, zeros = _shares(cols, axis, axis)
    return share[0], zeros


def cone_weights(geometry: Geometry) -> tuple[F64, tuple[int, int]]:
    """Quadrature weight of each ray of a cone in radians, on a detector extended by columns of zeros.

    For a full circle it is `circle_weights` times `fan_shares`. In a short scan (180° plus the fan angle, or more) the
    two measurements of a ray share its weight: one share rises smoothly while the other one falls (Parker 1982). If the
    arc is longer, the transition extends over all of the excess (Silver 2000, Med. Phys. 27, 773).

    Returns:
        Weights [view, 1 + col + 1] and columns of zeros, as for `ray_weights`.

    Raises:
        ValueError: some rays of the field of view are not seen by any projection.
    """
    if covers_the_circle(geometry.angles):
        shares, zeros = fan_shares(geometry)
        return circle_weights(geometry.angles)[:, None] * shares, zeros
    order, beta, cells = _arc(geometry.angles)
    missing = missing_arc(geometry)
    if missing > 0:
        needed_text = f"{np.rad2deg(missing):.4g} degrees more" if missing < math.inf else "angles without several gaps"
        raise ValueError(
            "use an iterative method (fista-tv, sirt), or take a full circle or a short scan of 180 degrees plus the "
            f"fan angle. FDK needs {needed_text}, because some rays through the field of view are in no projection"
        )
    arc, gamma = float(cells.sum()), -_fan_angles(geometry)[order]
    largest_fan_angle = (arc - np.pi) / 2
    rise = np.clip(beta[:, None] / (largest_fan_angle - gamma), 0, 2)
    fall = np.clip((arc - beta[:, None]) / (largest_fan_angle + gamma), 0, 2)
    weights = np.empty_like(gamma)
    weights[order] = (np.sin(np.pi / 4 * rise) * np.sin(np.pi / 4 * fall)) ** 2 * cells[:, None]
    return np.pad(weights, ((0, 0), (1, 1)), mode="edge"), (0, 0)


def missing_arc(geometry: Geometry) -> float:
    """Radians that are missing in a cone-beam scan, so that each ray of the field in the plane of the source is seen.

    0 if a short scan is long enough; infinite if the projections have more than one gap.
    """
    if covers_the_circle(geometry.angles):
        return 0.0
    _, beta, cells = _arc(geometry.angles)
    if beta.size < 3 or np.diff(beta).max() > _GAP_LIMIT * _usual(np.diff(beta)):
        return math.inf
    return max(0.0, np.pi + 2 * float(np.abs(_fan_angles(geometry)).max()) - float(cells.sum()))


class Wedge(NamedTuple):
    """Rays that no projection shows: those of the missing projections from the angle `first` over `size` radians."""

    first: float
    size: float

    @property
    def rays(self) -> tuple[float, float]:
        """Directions of the first and the last ray in degrees from x towards y, each at right angles to u."""
        first = (math.degrees(self.first) + 90) % 180
        return first, first + math.degrees(self.size)


def unseen_wedges(geometry: Geometry) -> list[Wedge]:
    """Rays that no projection shows, as angles of the missing projections modulo π; empty if nothing is missing.

    For a parallel beam, and for a cone whose projections have several gaps, these are rays through the rotation axis.
    For a short scan of a cone, the wedge is `missing_arc`, because rays at the rim of the field are missing before
    those at the axis.
    """
    missing = missing_arc(geometry) if geometry.is_cone else math.inf
    if missing == 0 or (geometry.is_off_middle and covers_the_circle(geometry.angles)):
        return []
    if math.isfinite(missing):
        order, _, cells = _arc(geometry.angles)
        middle = geometry.angles[order[0]] + (float(cells.sum()) - float(cells[0]) + math.pi) / 2
        return [Wedge(float(np.mod(middle - missing / 2, np.pi)), min(missing, math.pi))]
    theta = np.unique(np.mod(geometry.angles, np.pi))
    gaps = np.diff(theta, append=theta[0] + np.pi)
    typical = float(np.median(gaps))
    if math.pi - float(angular_weights(geometry.angles).sum()) < typical / 2:
        return []
    wide_gaps = np.flatnonzero(_missing(gaps, math.pi))
    return [Wedge(float(np.mod(theta[gap] + typical / 2, np.pi)), float(gaps[gap] - typical)) for gap in wide_gaps]


def density_gain(geometry: Geometry) -> float:
    """180° over the angle that the projections of a parallel beam cover, as float32; 1 for a cone.

    FBP times this has the right mean density of a round body, see `density_errors`.
    """
    return 1.0 if geometry.is_cone else float(np.float32(math.pi / angular_weights(geometry.angles).sum()))


def density_errors(missing: float, aspect: float = 2.0) -> tuple[float, float]:
    """Lowest and highest relative error of the density of elliptic bodies in FBP times `density_gain`.

    Each projection adds a b / (a² cos² + b² sin²) to the density inside an ellipse with the semi-axes a and b, and the
    mean of this over 180° is 1. The extremes are a wedge across the thin direction and one across the long direction.

    Args:
        missing: radians without projections, of π.
        aspect: length of the body over its width.
    """
    lost_shares = [2 / math.pi * math.atan(factor * math.tan(missing / 2)) for factor in (aspect, 1 / aspect)]
    highest, lowest = ((1 - share) / (1 - missing / math.pi) - 1 for share in lost_shares)
    return highest, lowest


def _missing(gaps: F64, circle: float) -> NDArray[np.bool_]:
    """Mask of the gaps of a circle in which projections are missing: wider than by chance, and than 8 usual gaps.

    One of n random gaps exceeds a share x of the circle with a probability of at most n (1 - x)^(n - 1). The limit is 1
    in 1000, or 1 in 20 if the other gaps are so similar that the angles are not random.
    """
    probability = 1e-3 if (others := np.sort(gaps)[:-1]).std() > _LARGEST_REGULAR_VARIATION * others.mean() else 0.05
    return gaps > max(_GAP_LIMIT * _usual(gaps), circle * (1 - (probability / gaps.size) ** (1 / (gaps.size - 1))))


def _usual(gaps: F64) -> float:
    """The usual gap, weighted by the angle of the gaps, because the median is small if projections are in groups.

    The median is also small if a part is repeated with finer steps. The usual gap is at most an eighth of 30 degrees,
    or the median if that is larger. So projections are missing in wider gaps, even if there are many such gaps.
    """
    median = float(np.median(gaps))
    return min(max(_half_step(gaps), median), max(_WIDEST_USUAL_ANGLE / _GAP_LIMIT, median))


def _arc(angles: F64) -> tuple[NDArray[np.intp], F64, F64]:
    """The order of projections after the widest gap, their angles from half a step before the first, their cells."""
    theta = np.mod(angles, 2 * np.pi)
    order, gaps = _gaps(theta)
    order = np.roll(order, -1 - int(np.argmax(gaps)))
    beta = np.mod(theta[order] - theta[order[0]], 2 * np.pi)
    steps = np.diff(beta)
    usual_step = float(np.median(steps)) if steps.size else 0.0
    steps = np.concatenate(([usual_step], steps, [usual_step]))
    return order, beta + usual_step / 2, (steps[1:] + steps[:-1]) / 2


def _fan_angles(geometry: Geometry) -> F64:
    """Angle in radians of each column's rays to the central ray, [view, col]."""
    u = np.arange(geometry.detector_shape[1]) - geometry.axis_col - geometry.shifts[:, :1]
    return np.arctan(u * geometry.pixel_pitch / geometry.sdd)


def _shares(cols: int, axis: F64, opposite: F64) -> tuple[F64, tuple[int, int]]:
    """Shares [view, 1 + col + 1] about `axis` [view], for opposite projections about `opposite`.

    Zeros before and after.
    """
    left, right = -0.5 - axis, cols - 0.5 - axis
    mirrored_left, mirrored_right = opposite + 0.5 - cols, opposite + 0.5
    low, high = np.maximum(left, mirrored_left), np.minimum(right, mirrored_right)
    u = np.arange(cols) - axis[:, None]
    share = 0.5 + _rise(u - high[:, None], right - mirrored_right, high - low)
    share += _rise(low[:, None] - u, mirrored_left - left, high - low)
    share[high <= low] = 1
    share_beyond_right = np.where(
        right > mirrored_right, share[:, -1], 1 - share[:, 0]
    )  # for the values beyond the right edge
    share = np.column_stack((1 - share_beyond_right, share, share_beyond_right))
    zeros_before, zeros_after = (
        math.ceil(wanted.max() - 1e-6) for wanted in (left - mirrored_left, mirrored_right - right)
    )
    most_zeros = 2 * cols  # if the axis is farther away, the hole in the middle cannot be filled
    return share, (min(max(0, zeros_before), most_zeros), min(max(0, zeros_after), most_zeros))


def _rise(beyond: F64, excess: F64, overlap: F64) -> F64:
    """0 inside the overlap, ± 1/2 at its edge, where `beyond` [view, col] is 0.

    + if a projection sees `excess` more.
    """
    ramp = np.clip(np.minimum(np.abs(excess), overlap / 2), 1e-9, None)[:, None]
    return np.asarray(np.sign(excess)[:, None] * np.sin(np.pi / 2 * np.clip(1 + beyond / ramp, 0, 1)) ** 2 / 2)


def _nearest(angles: F64, wanted: F64) -> NDArray[np.intp]:
    """Index of the projection nearest to each wanted angle on the circle."""
    theta, target = np.mod(angles, 2 * np.pi), np.mod(wanted, 2 * np.pi)
    order = np.argsort(theta, kind="stable")
    extended = np.concatenate((theta[order[-1:]] - 2 * np.pi, theta[order], theta[order[:1]] + 2 * np.pi))
    following = np.clip(np.searchsorted(extended, target), 1, extended.size - 1)
    closer = following - (target - extended[following - 1] < extended[following] - target)
    return order[(closer - 1) % theta.size]


def _gaps(theta: F64) -> tuple[NDArray[np.intp], F64]:
    """The order of angles on the circle, and the gap after each angle."""
    order = np.argsort(theta, kind="stable")
    return order, np.diff(theta[order], append=theta[order[0]] + 2 * np.pi)


def _leave_an_arc(gaps: F64) -> bool:
    widest, typical = float(gaps.max()), float(np.median(gaps))
    arc = widest > np.pi / 4 and widest > 3 * typical
    return bool(arc or widest >= np.pi or _missing(gaps, 2 * math.pi).any())
