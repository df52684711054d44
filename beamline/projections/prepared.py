"""Prepared projections: line integrals ready for reconstruction, weights of their rays, and held-out projections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.projections.step import StepDone
from beamline.storage.flag_legend import FrameFlags
from recon.base.arrays import F32, I64
from recon.base.geometry import Geometry
from recon.base.masks import RayWeights
from recon.base.reach import Reach
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.prep.align import AxisEstimate
from recon.prep.projections import Projections
from recon.voxels.projector import seen_rays


@dataclass(frozen=True, eq=False)
class PreparedProjections:
    """Line integrals ready for reconstruction.

    Attributes:
        projections: line integrals of the projections used; their `view_ids` are rows in the file.
        geometry: of these projections, binned; mm, or px if the pixel size is unknown.
        axis_col: rotation axis in columns of the full detector.
        axis: how the axis was found; None if it was given.
        held_out: some projections that are not used, with weights as `projections.weights` of those used (None: the
            weight of a usual ray of these); None if all are used.
        held_out_ids: rows of the file of these projections; None: unknown.
        n_projections: how many projections the scan has.
        length_unit: "mm" or "px".
        quantity: what the pixels were: "counts", which were corrected, or "line_integrals".
        view_weights: float32 [view], less than 1 for projections with a warning of the monitor; None: 1 for all.
        left_out: projections with an alarm of the monitor, or after a jump of the sample: the selection never includes
            them.
        flags: of all frames of the scan; None if the file has no flags.
        measured: bool [row, col], pixels that were measured, or interpolated well; None: all.
        shares: float32 [view, row, col], weights of rays in the regions of flags; None: all 1.
        done: what each step did, by name, in the order of the steps.
        shares_of: function that computes `shares` of some projections and rows on request, if line integrals are on
            disk; None: use `shares`.
        times: [view] time of the exposure of each projection in s; None: the method does not need it.
        laws: the residuals of the consistency conditions, in words, by name.
        reach: how far the sample goes beyond the field of view, as these projections show it; lengths are in the
            geometry's unit.
        stretch: height of a pixel divided by its width. `geometry` has square pixels; slices are this much farther
            apart.
    """

    projections: Projections
    geometry: Geometry
    axis_col: float
    axis: AxisEstimate | None
    held_out: Views | None
    n_projections: int
    length_unit: str
    quantity: str
    view_weights: NDArray[np.float32] | None = None
    left_out: int = 0
    flags: FrameFlags | None = None
    measured: NDArray[np.bool_] | None = None
    shares: NDArray[np.float32] | None = None
    done: Mapping[str, StepDone] = field(default_factory=dict)
    shares_of: Callable[[slice, slice], NDArray[np.float32] | None] | None = None
    held_out_ids: NDArray[np.int64] | None = None
    times: NDArray[np.float64] | None = None
    reach: Reach | None = None
    stretch: float = 1.0
    laws: Mapping[str, str] = field(default_factory=dict)

    def stretched(self, volume: Volume) -> Volume:
        """A volume of `geometry`, resampled to the heights of its slices."""
        if self.stretch == 1:
            return volume
        grid, (z, y, x) = volume.grid, volume.grid.centre
        high = replace(grid, centre=(z * self.stretch, y, x), slice_pitch=grid.spacing[0] * self.stretch)
        return Volume(volume.data, high)

    @property
    def box(self) -> Grid:
        """The box of the field of view, or one that contains all of the sample, as far as its reach was measured."""
        grid = Grid.matching(self.geometry)
        return grid if self.reach is None else self.reach.box(grid, self.geometry)

    @property
    def on_disk(self) -> bool:
        """True if line integrals are stored on disk, with rays of zero weight replaced from their neighbours."""
        return isinstance(self.projections.data, np.memmap)

    def of_rows(self, rows: slice, geometry: Geometry) -> PreparedProjections:
        """The same projections restricted to the detector rows of `geometry`; line integrals are not copied."""

        def cut(array: NDArray[Any] | None) -> NDArray[Any] | None:
            return None if array is None else array[..., rows, :]

        whole = self.projections
        shares = cut(self.shares) if self.shares_of is None else self.shares_of(slice(None), rows)
        return replace(
            self,
            projections=replace(whole, data=whole.data[:, rows], masked=whole.masked[rows], weights=cut(whole.weights)),
            geometry=geometry,
            held_out=None if self.held_out is None else self.held_out.rows(rows),
            measured=cut(self.measured),
            shares=shares,
            shares_of=None,
        )

    @property
    def centred(self) -> PreparedProjections:
        """The same projections without laterally offset ones, in which the sample is displaced by more than half a
        field of view.
        """
        return self.wanted(self.geometry.is_centred)

    def wanted(self, views: NDArray[np.bool_]) -> PreparedProjections:
        """The same projections, restricted to those that are wanted, bool [view]."""
        return self if views.all() else self.of_views(np.flatnonzero(views))

    def of_views(self, views: I64) -> PreparedProjections:
        """Some of the projections used, by number and in this order; held-out projections are unchanged."""

        def some(array: Any) -> Any:
            return None if array is None else array[views]

        whole, geometry = self.projections, self.geometry.select(views)
        return replace(
            self,
            projections=replace(
                whole,
                data=whole.data[views],
                view_ids=whole.view_ids[views],
                air=whole.air[views],
                weights=some(whole.weights),
            ),
            geometry=geometry,
            view_weights=some(self.view_weights),
            shares=some(self.shares),
            times=some(self.times),
        )

    @property
    def whole_views(self) -> I64:
        """Numbers of the projections in which every pixel measured something, except for pixels that are masked in
        all.
        """
        return np.flatnonzero(~np.isin(self.projections.view_ids, self.projections.unmeasured[:, 0]))

    @property
    def unmeasured_rows(self) -> tuple[I64, I64]:
        """Detector rows, binned, that no ray measured; and those of them that lie between measured rows, such as a
        line that the camera does not read, and are interpolated.
        """
        runs, (height, width) = self.projections.unmeasured, self.geometry.detector_shape
        known = np.ones((height, width), np.bool_) if self.measured is None else self.measured
        # [row, col + 1], number of known pixels to the left
        before = np.pad(np.cumsum(known, axis=1), ((0, 0), (1, 0)))
        _, row, left, right = runs[np.isin(runs[:, 0], self.projections.view_ids)].T  # of these projections
        lengths = before[row, right] - before[row, left]  # runs end at masked areas
        unseen = np.bincount(row, lengths, height) >= before[:, -1] * self.projections.view_ids.size
        lost = unseen | self.projections.masked.all(axis=1)
        return np.flatnonzero(lost), np.flatnonzero(lost & ~unseen)

    @property
    def leaves_slices(self) -> bool:
        """True if projections of a parallel beam see beyond the slices of the volume, because they are shifted along
        the axis or tilted.
        """
        moved = np.ptp(self.geometry.shifts[:, 1]) > 0
        return not self.geometry.is_cone and (bool(moved) or not self.geometry.is_straight)

    @property
    def views(self) -> Views:
        """The projections used, with weights that are computed on request."""
        weights: Any = self.ray_factors()
        return Views(self.projections.data, self.geometry, weights, self.reach)

    @property
    def views_held_out(self) -> Views | None:
        """The held-out projections, with weights that are computed on request; None if all projections are used."""
        if self.held_out is None:
            return None
        weights, n = self.ray_factors(self.held_out.geometry.n_views), self.geometry.n_views
        later: Any = None if weights is None else RayWeights(tuple(factor[n:] for factor in weights.factors))
        return replace(self.held_out, weights=later)

    def ray_weights(self, others: int = 0) -> NDArray[np.float32] | None:
        """Weights [view, row, col] from `ray_factors`, read-only."""
        factors = self.ray_factors(others)
        return None if factors is None else factors[...]

    @property
    def without_warnings(self) -> PreparedProjections:
        """The same projections without the warnings of the monitor: missing rays have weight 0, all others weight 1."""
        shares = None if self.shares is None else (self.shares > 0).astype(np.float32)
        return replace(self, view_weights=None, shares=shares, shares_of=None)

    def ray_factors(self, others: int = 0) -> RayWeights | None:
        """Weights [view, row, col], computed only on request; None if all rays have weight 1.

        Args:
            others: held-out projections, appended to these. Without weights of their own they get weight 1, the
                weight of a usual ray of these.
        """
        factors: list[NDArray[np.float32]] = []
        if self.view_weights is not None:
            factors.append(_and_ones(self.view_weights, others)[:, None, None])
        if (counted := self.projections.weights) is not None:
            usual, unseen = counted.mean(where=counted > 0), None if self.held_out is None else self.held_out.weights
            if unseen is not None and len(unseen) == others:
                factors.append(np.concatenate((counted, unseen)) / usual)
            else:
                factors.append(_and_ones(counted / usual, others))
        if self.measured is not None:
            factors.append(self.measured.astype(np.float32)[None])
        if self.leaves_slices:
            seen = seen_rays(self.geometry, grid := Grid.matching(self.geometry))
            held = np.ones((others, 1, 1), np.bool_)
            if self.held_out is not None and others == self.held_out.geometry.n_views:
                held = seen_rays(self.held_out.geometry, grid)
            rays = np.broadcast_shapes(seen.shape[1:], held.shape[1:])
            factors.append(np.concatenate([np.broadcast_to(part, (len(part), *rays)) for part in (seen, held)]))
            factors[-1] = factors[-1].astype(np.float32)
        if self.shares is not None:
            factors.append(_and_ones(self.shares, others))
        if not factors:
            return None
        shape = (self.geometry.n_views + others, *self.geometry.detector_shape)
        return RayWeights(tuple(np.broadcast_to(factor, shape) for factor in factors))


def _and_ones(values: NDArray[np.float32], others: int) -> NDArray[np.float32]:
    """The values of projections, and ones for others after them."""
    return np.concatenate((values, np.ones((others, *values.shape[1:]), np.float32)))


def with_held_out(projections: F32, geometry: Geometry, held_out: Views | None) -> tuple[F32, Geometry, list[int]]:
    """Used and held-out projections as one set, and the indices of the held-out projections in this set. The geometries
    of both belong to the same set-up.
    """
    if held_out is None:
        return projections, geometry, []
    together = geometry.followed_by(held_out.geometry)
    return np.concatenate((projections, held_out.data)), together, list(range(geometry.n_views, together.n_views))


def hold_out(
    prepared: PreparedProjections, one_in: int, *, most: int | None = None, advice: str
) -> PreparedProjections:
    """Hold out every `one_in`-th projection, evenly spread; unchanged if the selection already holds some out.

    Args:
        most: number of held-out projections at most.
        advice: what the user can do instead, for the error message.

    Raises:
        ConfigError: fewer than two projections would be left.
    """
    if prepared.held_out is not None:
        return prepared
    n = prepared.geometry.n_views
    count = max(1, n // one_in)
    count = count if most is None else min(count, most)
    if n - count < 2:
        raise ConfigError(f"{n} projections are too few to hold some out; choose more with --views, or {advice}.")
    # Neither the first nor the last: these have a neighbour on one side only.
    held = np.unique((np.arange(count) + 0.5) * n // count).astype(np.int64)
    return with_views_held_out(prepared, held)


def with_views_held_out(prepared: PreparedProjections, held: I64) -> PreparedProjections:
    """The same projections with those of these numbers, sorted, held out."""
    projections = prepared.projections
    return replace(
        prepared.of_views(np.setdiff1d(np.arange(prepared.geometry.n_views), held)),
        held_out=Views(projections.data, prepared.geometry, projections.weights).select(held),
        held_out_ids=projections.view_ids[held],
    )
