"""Displacement: the shift and turn of a sample that slipped on its stage, from the views before and after.

Views of one part of the scan predict those of another if both see the sample from near directions. So a volume of
the longest part is projected into the views of the others. A shift and a turn of the sample explain the differences.
Then all views together, corrected, give the next volume (joint reconstruction and reprojection: Gürsoy et al. 2017,
Sci. Rep. 7, 11818; here with one rigid displacement a part in place of one shift a view).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.iterative import solve
from recon.voxels.methods.os_sirt_tv import OsSirtTv
from recon.voxels.projector import Projector, seen_rays

F32 = NDArray[np.float32]
Parts = NDArray[np.integer]

SWEEPS = 10
SMOOTH = 8.0  # columns: residuals are relative to means of this width, since air and matter beyond the field are smooth
NEAR = math.radians(5)  # radians from the longest part's views: farther views are hardly predicted
TRIAL = 0.25  # pixels by which the sample is moved for derivatives
FARTHEST = 4.0  # most pixels of a step
RELAXED = 1.5  # factor on a step: the corrected views are in the volume, too, and make steps too small
_STEPS = 4  # steps of the first registration
_HELD_OUT = 8  # one of so many views judges


@dataclass(frozen=True)
class Displacement:
    """How the sample was moved on its stage: first turned about the axis, then shifted.

    Attributes:
        x, y, z: mm, in the sample's frame.
        turn: radians, in the sense in which angles grow.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn: float = 0.0

    def farthest(self, radius: float) -> float:
        """Approximate upper bound of the motion, mm, of a point at this distance from the axis."""
        return math.hypot(self.x, self.y, self.z) + abs(self.turn) * radius


@dataclass(frozen=True)
class Judgement:
    """How well a volume predicts views held out of it, see `judge`.

    Attributes:
        alone: deviation of the longest part's views from a volume of that part.
        together: deviation of the same views from a volume of all parts.
        others: deviation of the views of each part from a volume of all parts.
        longest: the longest part.
        overall: mean deviation of all views from a volume of all parts.
    """

    alone: float
    together: float
    others: tuple[float, ...]
    longest: int
    overall: float


def displaced(geometry: Geometry, parts: Parts, moves: Sequence[Displacement]) -> Geometry:
    """The geometry of views of a sample that was moved in some parts of the scan; parallel beam.

    Args:
        parts: [view] number of the part that each belongs to.
        moves: of each part.

    Raises:
        ValueError: for a cone, whose rays a shift of the sample turns.
    """
    if geometry.is_cone:
        raise ValueError("views of a cone beam are not corrected by shifts: they differ by more than these")
    x, y, z, turn = np.array([(m.x, m.y, m.z, m.turn) for m in moves])[parts].T
    c, s = np.cos(geometry.angles), np.sin(geometry.angles)
    across, down = (x * c + y * s) / geometry.pixel_pitch, z / geometry.pixel_pitch
    return replace(geometry, angles=geometry.angles + turn, shifts=geometry.shifts + np.stack((across, down), axis=1))


def displacements(
    projections: F32,
    geometry: Geometry,
    parts: Parts,
    known: NDArray[np.bool_],
    start: Sequence[Displacement] | None = None,
    rounds: int = 3,
) -> list[Displacement]:
    """The displacement of each part against the longest one.

    Precise to some 0.1 pixel if matter has edges. Motion by more than a tenth of the field, or with deformation, is
    not found, see `judge`.

    Args:
        projections: [view, row, col], line integrals.
        geometry: of a parallel beam.
        parts: [view] number of the part that each belongs to, from 0.
        known: [row, col] pixels that were measured.
        start: displacements from coarser pixels; None: begin with the longest part alone.
        rounds: number of volumes of all views.
    """
    problem = _Problem(projections, geometry, parts, known)
    moves = list(start) if start is not None else [Displacement()] * problem.count
    if not problem.others:
        return moves
    if start is None:
        own = np.flatnonzero(parts == problem.longest)
        volume = problem.volume(geometry, own)
        for part in problem.others:
            views = np.flatnonzero(parts == part)
            weight = np.exp(-0.5 * (_apart(geometry, views, own) / NEAR) ** 2)
            for _ in range(_STEPS):
                moves[part] = problem.registered(volume, moves[part], views, weight)
    for _ in range(rounds):
        volume = problem.volume(displaced(geometry, parts, moves), np.arange(geometry.n_views))
        for part in problem.others:
            views = np.flatnonzero(parts == part)
            moves[part] = problem.registered(volume, moves[part], views, np.ones(views.size), RELAXED)
    return moves


def judge(
    projections: F32, geometry: Geometry, parts: Parts, known: NDArray[np.bool_], moves: Sequence[Displacement]
) -> Judgement:
    """Deviations of views held out, from volumes of the longest part and of all parts; arguments as `displacements`.

    If the displacement is right, the other parts improve the prediction of the longest part's views.
    """
    problem, corrected = _Problem(projections, geometry, parts, known), displaced(geometry, parts, moves)
    views = np.arange(geometry.n_views)
    held = views[_HELD_OUT // 2 :: _HELD_OUT]
    used = np.setdiff1d(views, held)
    whole = problem.volume(corrected, used)
    alone = problem.volume(corrected, used[parts[used] == problem.longest])

    def deviations(volume: Volume) -> NDArray[np.float64]:
        left, weight = problem.residual(volume, corrected, held)
        return np.sqrt((left**2).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1))

    def typical(each: NDArray[np.float64], part: int) -> float:
        own = each[parts[held] == part]
        return float(np.median(own)) if own.size else math.nan

    together = deviations(whole)
    return Judgement(
        typical(deviations(alone), problem.longest),
        typical(together, problem.longest),
        tuple(typical(together, part) for part in range(problem.count)),
        problem.longest,
        float(together.mean()),
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """Views in parts; the volume is that of the longest part."""

    projections: F32
    geometry: Geometry
    parts: Parts
    known: NDArray[np.bool_]

    @property
    def count(self) -> int:
        return int(self.parts.max()) + 1

    @property
    def longest(self) -> int:
        return int(np.bincount(self.parts).argmax())

    @property
    def others(self) -> list[int]:
        return [part for part in range(self.count) if part != self.longest and (self.parts == part).any()]

    @property
    def grid(self) -> Grid:
        return Grid.matching(self.geometry)

    def weights(self, geometry: Geometry) -> F32:
        seen = seen_rays(geometry, self.grid)
        return (seen & self.known).astype(np.float32)

    def volume(self, geometry: Geometry, views: NDArray[np.integer]) -> Volume:
        geometry, projections = geometry.select(views), self.projections[views]
        # The weight follows the noise: views held out would judge a sample that still stands in two places.
        projector, weight = Projector(geometry, self.grid), self.weights(geometry)
        return solve(OsSirtTv(SWEEPS, momentum=True), projector, projections, weight=weight, on_trial=lambda: True)

    def residual(self, volume: Volume, geometry: Geometry, views: NDArray[np.integer]) -> tuple[F32, F32]:
        """Views less those of the volume, without smooth differences, and the weights of their rays."""
        geometry = geometry.select(views)
        weight = self.weights(geometry)
        left = self.projections[views] - Projector(geometry, self.grid).forward(volume.data)
        return _without_smooth(left, weight), weight

    def registered(
        self, volume: Volume, move: Displacement, views: NDArray[np.integer], weight: NDArray[np.float64],
        relaxation: float = 1.0,
    ) -> Displacement:  # fmt: skip
        """The displacement of these views after a step of least squares (Gauss-Newton) towards the volume's views."""
        geometry = self.geometry.select(views)
        pitch, all_one = geometry.pixel_pitch, np.zeros(views.size, np.int64)
        now = np.array([move.x, move.y, move.z, move.turn])
        trial = TRIAL * pitch * np.array([1, 1, 1, 2 / (geometry.detector_shape[1] * pitch)])

        def shown(at: NDArray[np.float64]) -> tuple[F32, F32]:
            moved = displaced(geometry, all_one, [Displacement(*at.tolist())])
            return Projector(moved, self.grid).forward(volume.data), self.weights(moved)

        image, rays = shown(now)
        left = _without_smooth(self.projections[views] - image, rays)
        change = []
        for i in range(now.size):
            step = np.where(np.arange(now.size) == i, trial, 0)
            change.append(_without_smooth(shown(now + step)[0] - shown(now - step)[0], rays) / 2)
        across = np.stack(change).reshape(now.size, views.size, -1)
        normal = np.einsum("avp,bvp,v->ab", across, across, weight, optimize=True)
        slope = np.einsum("avp,vp,v->a", across, left.reshape(views.size, -1), weight, optimize=True)
        best = np.linalg.lstsq(normal, slope, rcond=1e-6)[0] * relaxation
        longest = float(np.abs(best).max()) * TRIAL
        after = now + best * trial * min(1.0, FARTHEST / max(longest, 1e-12))
        return Displacement(*after.tolist())


def _apart(geometry: Geometry, views: NDArray[np.integer], others: NDArray[np.integer]) -> NDArray[np.float64]:
    """[view] radians from each view to the nearest of the others, views half a turn apart counting as the same."""
    away = np.abs(np.subtract.outer(geometry.angles[views], geometry.angles[others])) % geometry.period
    return np.asarray(np.minimum(away, geometry.period - away).min(axis=1))


def _without_smooth(images: F32, weight: F32) -> F32:
    """Differences from the surroundings along the row, on rays that have weight."""
    seen = images * weight
    smooth = gaussian_filter1d(seen, SMOOTH, axis=2) / np.maximum(gaussian_filter1d(weight, SMOOTH, axis=2), 1e-3)
    return np.asarray((seen - smooth * weight), np.float32)
