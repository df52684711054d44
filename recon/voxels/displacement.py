"""Displacement: shift and rotation of a sample that slipped on its stage, from the projections before and after.

Projections of one part of the scan predict those of another part if both see the sample from similar directions. So a
volume from the longest part is projected into the directions of the other parts. A shift and a rotation of the sample
are fitted to the differences. Then all projections together, corrected, give the next volume (joint reconstruction and
reprojection: Gürsoy et al. 2017, Sci. Rep. 7, 11818; here with one rigid displacement per part instead of one shift per
projection). If the optics change between parts, a shift of the image and its magnification are found, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, gaussian_filter1d

from recon.base.decisions import GoesOn
from recon.base.empirical import ONE_IN
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.iterative import solve
from recon.voxels.methods import OsSirtTv
from recon.voxels.projector import Projector, seen_rays

F32 = NDArray[np.float32]
Parts = NDArray[np.integer]

SWEEPS = 10
# columns over which a mean is taken. Residuals are relative to this mean, because effects of air and of outside
# material are smooth.
SMOOTH = 8.0
# radians from the nearest projection of the longest part; farther projections cannot be predicted
NEAR = math.radians(5)
TRIAL = 0.25  # pixels; step of the sample for numerical derivatives
FARTHEST = 4.0  # largest step in pixels
RELAXED = 1.5  # factor on a step: the corrected projections are also in the volume, so steps come out too small
_NO_TRIALS = GoesOn(trials=GoesOn(lambda *_: False))
_STEPS = 4  # number of steps of the first registration
_LEAST_MEASURED_SHARE = 0.99  # least share of measured pixels in an interpolated pixel


@dataclass(frozen=True)
class Displacement:
    """How the sample moved on its stage (first rotated about the axis, then shifted), and how the optics changed.

    Attributes:
        x, y, z: mm, in the sample's frame.
        turn: radians, in the direction in which angles grow.
        image: mm by which the image is shifted along the rows, the same in all projections.
        magnification: magnification of the image about the axis and the middle row, relative to the other parts.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn: float = 0.0
    image: float = 0.0
    magnification: float = 1.0


@dataclass(frozen=True)
class DisplacementFit:
    """How well a volume predicts held-out projections, see `judge`.

    Attributes:
        alone: deviation of the projections of the longest part from a volume of this part.
        together: deviation of the same projections from a volume of all parts.
        others: deviation of the projections of each part from a volume of all parts.
        longest: number of the longest part.
        overall: mean deviation of all projections from a volume of all parts.
    """

    alone: float
    together: float
    others: tuple[float, ...]
    longest: int
    overall: float


def displaced(geometry: Geometry, parts: Parts, moves: Sequence[Displacement]) -> Geometry:
    """The geometry of the projections of a sample that moved in some parts of the scan; parallel beam.

    The geometry does not contain the magnification: `unmagnified` corrects the projections for it.

    Args:
        parts: [view] number of the part of each projection.
        moves: the displacement of each part.

    Raises:
        ValueError: the beam is a cone, in which a shift of the sample changes more than the position of the image.
    """
    if geometry.is_cone:
        raise ValueError(
            "displacements can be corrected only in a parallel beam; in a cone beam a displacement of the sample "
            "changes not only the position of its image"
        )
    x, y, z, rotation, image = np.array([(m.x, m.y, m.z, m.turn, m.image) for m in moves])[parts].T
    c, s = np.cos(geometry.angles), np.sin(geometry.angles)
    column_shifts, row_shifts = (x * c + y * s + image) / geometry.pixel_pitch, z / geometry.pixel_pitch
    return replace(
        geometry,
        angles=geometry.angles + rotation,
        shifts=geometry.shifts + np.stack((column_shifts, row_shifts), axis=1),
    )


def unmagnified(images: F32, factor: float, centre: tuple[float, float], order: int = 3) -> F32:
    """Images [view, row, col] with the magnification `factor` removed; 0 outside the field of view.

    Args:
        centre: row and column of the fixed point.
        order: order of the interpolation: 3 cubic, 1 linear.
    """
    if factor == 1:
        return images
    scale, resampled = np.full(2, factor), np.empty_like(images)
    for view, image in enumerate(images):
        affine_transform(image, scale, (1 - scale) * centre, output=resampled[view], order=order)
    return resampled


def measured_unmagnified(measured: NDArray[np.bool_], factor: float, centre: tuple[float, float]) -> NDArray[np.bool_]:
    """Mask [view, row, col] of the pixels of `unmagnified` that come from measured pixels only."""
    return unmagnified(measured.astype(np.float32), factor, centre, order=1) > _LEAST_MEASURED_SHARE


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

    The precision is about 0.1 pixel if the material has edges. Motion is not found if it exceeds a tenth of the field
    of view, or if the sample deforms; see `judge`.

    Args:
        projections: [view, row, col], line integrals.
        geometry: geometry of a parallel beam.
        parts: [view] number of the part of each projection, from 0.
        known: [row, col] True for pixels that were measured.
        start: displacements from coarser pixels; None: begin with the longest part alone.
        rounds: number of volumes from all projections.
        optics: True: also find the shift and the magnification of the image; False: keep those of `start`.
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
            weight = np.exp(-0.5 * (_angular_distances(geometry, views, own) / NEAR) ** 2)
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
    """Deviations of held-out projections, for volumes of the longest part and of all parts.

    The arguments are those of `displacements`. If the displacement is right, the other parts improve the prediction of
    the projections of the longest part.
    """
    problem = _Problem(projections, geometry, parts, known)
    views = np.arange(geometry.n_views)
    held = views[ONE_IN // 2 :: ONE_IN]
    used = np.setdiff1d(views, held)
    whole = problem.volume(moves, used)
    alone = problem.volume(moves, used[parts[used] == problem.longest])

    def deviations(volume: Volume) -> NDArray[np.float64]:
        residual, weight = problem.residual(volume, moves, held)
        return np.sqrt((residual**2).sum(axis=(1, 2)) / np.maximum(weight.sum(axis=(1, 2)), 1))

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
    """Projections in several parts. The volume has the position that the sample has in the longest part."""

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
        """Some projections corrected for these displacements, their geometry, and the weights of their rays."""
        geometry, parts = self.geometry.select(views), self.parts[views]
        data = self.projections[views]
        known = np.repeat(self.known[None], views.size, 0)
        centre = geometry.axis_row, geometry.axis_col
        for part in np.unique(parts):
            own, factor = parts == part, moves[part].magnification
            data[own] = unmagnified(data[own], factor, centre)
            known[own] = measured_unmagnified(self.known[None], factor, centre)
        displaced_geometry = displaced(geometry, parts, moves)
        return data, displaced_geometry, (seen_rays(displaced_geometry, self.grid) & known).astype(np.float32)

    def volume(self, moves: Sequence[Displacement], views: NDArray[np.integer]) -> Volume:
        data, geometry, weight = self.corrected(moves, views)
        # The weight follows the noise. Held-out projections would judge a sample that is still in two positions.
        method, projector = OsSirtTv(SWEEPS, still=0.0), Projector(geometry, self.grid)
        return solve(method, projector, data, weight=weight, go_on=_NO_TRIALS)

    def residual(self, volume: Volume, moves: Sequence[Displacement], views: NDArray[np.integer]) -> tuple[F32, F32]:
        """Measured minus computed projections, without smooth differences. Also the weights of the rays."""
        data, geometry, weight = self.corrected(moves, views)
        return _without_smooth(data - Projector(geometry, self.grid).forward(volume.data), weight), weight

    def registered(
        self, volume: Volume, move: Displacement, views: NDArray[np.integer], weight: NDArray[np.float64],
        relaxation: float = 1.0,
    ) -> Displacement:  # fmt: skip
        """The displacement of these projections after one least-squares step (Gauss-Newton) towards the volume."""
        geometry = self.geometry.select(views)
        pitch, all_one = geometry.pixel_pitch, np.zeros(views.size, np.int64)
        half_width = geometry.detector_shape[1] / 2  # in columns
        trial = TRIAL * np.array([pitch, pitch, pitch, 1 / half_width, pitch, 1 / half_width])
        values_before = np.array([move.x, move.y, move.z, move.turn, move.image, move.magnification])

        def projected(values: NDArray[np.float64]) -> F32:
            moved_geometry = displaced(geometry, all_one, [Displacement(*values.tolist())])
            return Projector(moved_geometry, self.grid).forward(volume.data)

        data, _, rays = _Problem(self.projections[views], geometry, all_one, self.known).corrected(
            [move], np.arange(views.size)
        )
        image = projected(values_before)
        residual = _without_smooth(data - image, rays)
        change: list[NDArray[np.floating]] = []
        for i in range(5 if self.optics else 4):
            step = np.where(np.arange(values_before.size) == i, trial, 0)
            change.append(_without_smooth(projected(values_before + step) - projected(values_before - step), rays) / 2)
        if self.optics:
            change.append(_without_smooth(trial[5] * _outwards(image, geometry), rays))
        derivatives = np.stack(change).reshape(len(change), views.size, -1)
        normal = np.einsum("avp,bvp,v->ab", derivatives, derivatives, weight, optimize=True)
        slope = np.einsum("avp,vp,v->a", derivatives, residual.reshape(views.size, -1), weight, optimize=True)
        solution = np.zeros(values_before.size)
        solution[: len(change)] = np.linalg.lstsq(normal, slope, rcond=1e-6)[0] * relaxation
        longest = float(np.abs(solution).max()) * TRIAL
        values_after = values_before + solution * trial * min(1.0, FARTHEST / max(longest, 1e-12))
        return Displacement(*values_after.tolist())


def _outwards(image: F32, geometry: Geometry) -> F32:
    """Derivative of projections [view, row, col] with respect to a magnification about the axis and the middle row."""
    rows, cols = geometry.detector_shape
    columns_from_axis = np.arange(cols) - geometry.axis_col
    rows_from_axis = np.arange(rows)[:, None] - geometry.axis_row
    along_rows = -columns_from_axis * np.gradient(image, axis=2)
    return np.asarray(along_rows - rows_from_axis * np.gradient(image, axis=1) if rows > 1 else along_rows, np.float32)


def _angular_distances(
    geometry: Geometry, views: NDArray[np.integer], others: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Radians [view] from each projection to the nearest one of the others. Those 180° apart count as the same."""
    distances = np.abs(np.subtract.outer(geometry.angles[views], geometry.angles[others])) % geometry.period
    return np.asarray(np.minimum(distances, geometry.period - distances).min(axis=1))


def _without_smooth(images: F32, weight: F32) -> F32:
    """Differences from the surroundings along the row, for rays with a weight above 0."""
    weighted = images * weight
    smooth = gaussian_filter1d(weighted, SMOOTH, axis=2) / np.maximum(gaussian_filter1d(weight, SMOOTH, axis=2), 1e-3)
    return np.asarray((weighted - smooth * weight), np.float32)
