"""Displacement: the shift and turn of a sample that slipped on its stage, from the views before and after.

Views of one part of the scan predict those of another if both see the sample from near directions. So a volume of
the longest part is projected into the views of the others. A shift and a turn of the sample explain the differences.
Then all views together, corrected, give the next volume (joint reconstruction and reprojection: Gürsoy et al. 2017,
Sci. Rep. 7, 11818; here with one rigid displacement a part in place of one shift a view). Where the optics change
between parts, a shift of the image and its magnification are found, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter1d

from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.iterative import Watch, solve
from recon.voxels.methods import OsSirtTv
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
_MEASURED = 0.99  # of the weight that interpolation gives a pixel: less, and a neighbour was not measured


@dataclass(frozen=True)
class Displacement:
    """How the sample was moved on its stage, first turned about the axis, then shifted; and how the optics changed.

    Attributes:
        x, y, z: mm, in the sample's frame.
        turn: radians, in the sense in which angles grow.
        image: mm by which the image is shifted along the rows, in all views alike.
        magnification: of the image about the axis and the middle of the rows, over that of the other views.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn: float = 0.0
    image: float = 0.0
    magnification: float = 1.0


@dataclass(frozen=True)
class DisplacementFit:
    """How well a volume predicts held-out views, see `judge`.

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

    A magnification is no part of it: `unmagnified` corrects the views.

    Args:
        parts: [view] number of the part that each belongs to.
        moves: of each part.

    Raises:
        ValueError: for a cone, whose rays a shift of the sample turns.
    """
    if geometry.is_cone:
        raise ValueError("shifts cannot correct projections of a cone beam, because they differ by more than shifts")
    x, y, z, turn, image = np.array([(m.x, m.y, m.z, m.turn, m.image) for m in moves])[parts].T
    c, s = np.cos(geometry.angles), np.sin(geometry.angles)
    across, down = (x * c + y * s + image) / geometry.pixel_pitch, z / geometry.pixel_pitch
    return replace(geometry, angles=geometry.angles + turn, shifts=geometry.shifts + np.stack((across, down), axis=1))


def unmagnified(images: F32, factor: float, centre: tuple[float, float], order: int = 3) -> F32:
    """Images [view, row, col] with the magnification `factor` removed; 0 outside the field.

    Args:
        centre: row and column that keep their place.
        order: of the interpolation, 3 cubic, 1 linear.
    """
    if factor == 1:
        return images
    scale, made = np.full(2, factor), np.empty_like(images)
    for view, image in enumerate(images):
        affine_transform(image, scale, (1 - scale) * centre, output=made[view], order=order)
    return made


def measured_unmagnified(there: NDArray[np.bool_], factor: float, centre: tuple[float, float]) -> NDArray[np.bool_]:
    """Pixels [view, row, col] of `unmagnified` that are determined by measured pixels only."""
    return unmagnified(there.astype(np.float32), factor, centre, order=1) > _MEASURED


def displacements(
    projections: F32,
    geometry: Geometry,
    parts: Parts,
    known: NDArray[np.bool_],
    start: Sequence[Displacement] | None = None,
    rounds: int = 3,
    optics: bool = False,
) -> list[Displacement]:
    """The displacement of each part relative to the longest one.

    Precise to some 0.1 pixel if matter has edges. Motion by more than a tenth of the field, or with deformation, is
    not found, see `judge`.

    Args:
        projections: [view, row, col], line integrals.
        geometry: of a parallel beam.
        parts: [view] number of the part that each belongs to, from 0.
        known: [row, col] pixels that were measured.
        start: displacements from coarser pixels; None: begin with the longest part alone.
        rounds: number of volumes of all views.
        optics: find shift and magnification of the image, too; else they stay those of `start`.
    """
    problem = _Problem(projections, geometry, parts, known, optics)
    moves = list(start) if start is not None else [Displacement()] * problem.count
    if not problem.others:
        return moves
    if start is None:
        own = np.flatnonzero(parts == problem.longest)
        volume = problem.volume(moves, own)
        for part in problem.others:
            views = np.flatnonzero(parts == part)
            weight = np.exp(-0.5 * (_apart(geometry, views, own) / NEAR) ** 2)
            for _ in range(_STEPS):
                moves[part] = problem.registered(volume, moves[part], views, weight)
    for _ in range(rounds):
        volume = problem.volume(moves, np.arange(geometry.n_views))
        for part in problem.others:
            views = np.flatnonzero(parts == part)
            moves[part] = problem.registered(volume, moves[part], views, np.ones(views.size), RELAXED)
    return moves


def judge(
    projections: F32, geometry: Geometry, parts: Parts, known: NDArray[np.bool_], moves: Sequence[Displacement]
) -> DisplacementFit:
    """Deviations of held-out views, for volumes of the longest part and of all parts; arguments as for `displacements`.

    If the displacement is right, the other parts improve the prediction of the longest part's views.
    """
    problem = _Problem(projections, geometry, parts, known)
    views = np.arange(geometry.n_views)
    held = views[ONE_IN // 2 :: ONE_IN]
    used = np.setdiff1d(views, held)
    whole = problem.volume(moves, used)
    alone = problem.volume(moves, used[parts[used] == problem.longest])

    def deviations(volume: Volume) -> NDArray[np.float64]:
        left, weight = problem.residual(volume, moves, held)
        return np.sqrt((left**2).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1))

    def typical(each: NDArray[np.float64], part: int) -> float:
        own = each[parts[held] == part]
        return float(np.median(own)) if own.size else math.nan

    together = deviations(whole)
    return DisplacementFit(
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
    optics: bool = False

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

    def corrected(self, moves: Sequence[Displacement], views: NDArray[np.integer]) -> tuple[F32, Geometry, F32]:
        """Some views corrected for these displacements, their geometry, and the weights of their rays."""
        geometry, parts = self.geometry.select(views), self.parts[views]
        data = self.projections[views]
        known = np.repeat(self.known[None], views.size, 0)
        centre = geometry.axis_row, geometry.axis_col
        for part in np.unique(parts):
            own, factor = parts == part, moves[part].magnification
            data[own] = unmagnified(data[own], factor, centre)
            known[own] = measured_unmagnified(self.known[None], factor, centre)
        there = displaced(geometry, parts, moves)
        return data, there, (seen_rays(there, self.grid) & known).astype(np.float32)

    def volume(self, moves: Sequence[Displacement], views: NDArray[np.integer]) -> Volume:
        data, geometry, weight = self.corrected(moves, views)
        # The weight follows the noise: views held out would judge a sample that still stands in two places.
        method, projector = OsSirtTv(SWEEPS, still=0.0), Projector(geometry, self.grid)
        return solve(method, projector, data, weight=weight, watch=Watch(on_trial=lambda: True))

    def residual(self, volume: Volume, moves: Sequence[Displacement], views: NDArray[np.integer]) -> tuple[F32, F32]:
        """Views minus projections of the volume, without smooth differences, and the weights of their rays."""
        data, geometry, weight = self.corrected(moves, views)
        return _without_smooth(data - Projector(geometry, self.grid).forward(volume.data), weight), weight

    def registered(
        self, volume: Volume, move: Displacement, views: NDArray[np.integer], weight: NDArray[np.float64],
        relaxation: float = 1.0,
    ) -> Displacement:  # fmt: skip
        """The displacement of these views after a step of least squares (Gauss-Newton) towards the volume's views."""
        geometry = self.geometry.select(views)
        pitch, all_one = geometry.pixel_pitch, np.zeros(views.size, np.int64)
        half = geometry.detector_shape[1] / 2  # columns
        trial = TRIAL * np.array([pitch, pitch, pitch, 1 / half, pitch, 1 / half])
        now = np.array([move.x, move.y, move.z, move.turn, move.image, move.magnification])

        def shown(at: NDArray[np.float64]) -> F32:
            moved = displaced(geometry, all_one, [Displacement(*at.tolist())])
            return Projector(moved, self.grid).forward(volume.data)

        data, _, rays = _Problem(self.projections[views], geometry, all_one, self.known).corrected(
            [move], np.arange(views.size)
        )
        image = shown(now)
        left = _without_smooth(data - image, rays)
        change: list[NDArray[np.floating]] = []
        for i in range(5 if self.optics else 4):
            step = np.where(np.arange(now.size) == i, trial, 0)
            change.append(_without_smooth(shown(now + step) - shown(now - step), rays) / 2)
        if self.optics:
            change.append(_without_smooth(trial[5] * _outwards(image, geometry), rays))
        across = np.stack(change).reshape(len(change), views.size, -1)
        normal = np.einsum("avp,bvp,v->ab", across, across, weight, optimize=True)
        slope = np.einsum("avp,vp,v->a", across, left.reshape(views.size, -1), weight, optimize=True)
        best = np.zeros(now.size)
        best[: len(change)] = np.linalg.lstsq(normal, slope, rcond=1e-6)[0] * relaxation
        longest = float(np.abs(best).max()) * TRIAL
        after = now + best * trial * min(1.0, FARTHEST / max(longest, 1e-12))
        return Displacement(*after.tolist())


def _outwards(image: F32, geometry: Geometry) -> F32:
    """Derivative of views [view, row, col] by a magnification about the axis and the middle of the rows."""
    rows, cols = geometry.detector_shape
    across, down = np.arange(cols) - geometry.axis_col, np.arange(rows)[:, None] - geometry.axis_row
    along_rows = -across * np.gradient(image, axis=2)
    return np.asarray(along_rows - down * np.gradient(image, axis=1) if rows > 1 else along_rows, np.float32)


def _apart(geometry: Geometry, views: NDArray[np.integer], others: NDArray[np.integer]) -> NDArray[np.float64]:
    """[view] radians from each view to the nearest of the others, views half a turn apart counting as the same."""
    away = np.abs(np.subtract.outer(geometry.angles[views], geometry.angles[others])) % geometry.period
    return np.asarray(np.minimum(away, geometry.period - away).min(axis=1))


def _without_smooth(images: F32, weight: F32) -> F32:
    """Differences from the surroundings along the row, on rays that have weight."""
    seen = images * weight
    smooth = gaussian_filter1d(seen, SMOOTH, axis=2) / np.maximum(gaussian_filter1d(weight, SMOOTH, axis=2), 1e-3)
    return np.asarray((seen - smooth * weight), np.float32)
