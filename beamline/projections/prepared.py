"""Prepared projections: line integrals ready for reconstruction, weights of their rays, and held-out projections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.projections.step import StepDone
from beamline.storage.flag_legend import FrameFlags
from recon.base.arrays import F32, I64, Mask
from recon.base.geometry import Geometry
from recon.base.view_data import RayWeights, Views
from recon.base.volume import Grid, Volume
from recon.prep.align import AxisEstimate
from recon.prep.projections import Projections
from recon.voxels.projector import seen_rays


@dataclass(frozen=True, eq=False)
class Corrected:
    """What the correction changed in projections. The attributes have the same meaning as in `Projections`."""

    floored: float
    air: F32
    masked: Mask
    air_columns: tuple[int, int]
    replaced: float
    unmeasured: I64
    spots_left: int

    @classmethod
    def of(cls, projections: Projections) -> Corrected:
        return cls(**{each.name: getattr(projections, each.name) for each in fields(cls)})


@dataclass(frozen=True, eq=False)
class ScanOrigin:
    """Where projections come from. Only files, reports and messages state these facts.

    Attributes:
        axis_col: rotation axis in columns of the full detector.
        axis: how the axis was found; None if the user gave it.
        n_projections: number of projections of the scan.
        length_unit: "mm" or "px".
        quantity: quantity of the stored pixels: "counts", which were corrected, or "line_integrals".
        left_out: projections with an alarm of the monitor, or after a jump of the sample. The selection never includes
            these.
        flags: flags of all frames of the scan; None if the file has no flags.
        done: what each step did, by name, in the order of the steps.
        consistency: the residuals of the consistency conditions in words, by name.
    """

    axis_col: float
    axis: AxisEstimate | None
    n_projections: int
    length_unit: str
    quantity: str
    left_out: int = 0
    flags: FrameFlags | None = None
    done: Mapping[str, StepDone] = field(default_factory=dict)
    consistency: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class WeightSources:
    """What lowers the weights of rays, in addition to the noise of counted photons.

    Attributes:
        view_weights: float32 [view used], less than 1 for projections with a warning of the monitor; None: 1 for all.
        measured: bool [row, col], pixels that were measured or could be interpolated well; None: all pixels.
        region_weights: float32 [view used, row, col], weights of rays in the regions of flags; None: all weights are 1.
        region_weights_of: function that computes `region_weights` of some projections and rows on request, if line
            integrals are on disk; None: use `region_weights`.
    """

    view_weights: F32 | None = None
    measured: Mask | None = None
    region_weights: F32 | None = None
    region_weights_of: Callable[[slice, slice], F32 | None] | None = None

    def views(self, views: I64) -> WeightSources:
        """Those of only these of the projections used."""
        return replace(
            self, view_weights=_part_of(self.view_weights, views), region_weights=_part_of(self.region_weights, views)
        )

    def rows(self, rows: slice) -> WeightSources:
        """Those of only these detector rows, with the weights in regions computed."""
        part = (..., rows, slice(None))
        weights = (
            _part_of(self.region_weights, part)
            if self.region_weights_of is None
            else self.region_weights_of(slice(None), rows)
        )
        return replace(self, measured=_part_of(self.measured, part), region_weights=weights, region_weights_of=None)

    @property
    def without_warnings(self) -> WeightSources:
        """Those without the warnings of the monitor: missing rays have weight 0, all others weight 1."""
        weights = None if self.region_weights is None else (self.region_weights > 0).astype(np.float32)
        return replace(self, view_weights=None, region_weights=weights, region_weights_of=None)


def _part_of(array: NDArray[Any] | None, part: Any) -> Any:
    return None if array is None else array[part]


@dataclass(frozen=True, eq=False)
class PreparedProjections:
    """Line integrals that are ready for reconstruction, and facts about their origin.

    Attributes:
        lines: line integrals of all projections; the projections that are used come first. `ids` are rows of the file.
            `used` is False for held-out projections. `weights` are inverse variances from photon counts; None: photons
            were not counted. `reach` is measured on the projections used. The geometry is binned, in mm, or in px if
            the pixel size is unknown.
        corrected: what the correction changed in the projections used.
        origin: where the projections come from.
        sources: what lowers the weights of rays.
        times: [view used] time of the exposure of each projection in s; None: the method does not need it.
        pixel_aspect: height of a pixel divided by its width. `geometry` has square pixels; the distance between slices
            is larger by this factor.
    """

    lines: Views
    corrected: Corrected
    origin: ScanOrigin
    sources: WeightSources = WeightSources()
    times: NDArray[np.float64] | None = None
    pixel_aspect: float = 1.0

    def stating(self, **facts: Any) -> PreparedProjections:
        """The same projections with these facts about their origin."""
        return replace(self, origin=replace(self.origin, **facts))

    @property
    def views(self) -> Views:
        """All projections, with weights that are computed when they are needed."""
        return replace(self.lines, weights=self._ray_factors())

    @property
    def seen(self) -> Views:
        """The projections used, with weights from photon counts only."""
        return self.lines.seen

    @property
    def ids(self) -> I64:
        """Rows of the file of the projections used."""
        assert self.lines.ids is not None
        return self.lines.ids[: self.n_used]

    @property
    def with_gaps(self) -> F32:
        """The line integrals used, with NaN for pixels without data."""
        fields_of_projections = {each.name: getattr(self.corrected, each.name) for each in fields(Corrected)}
        return Projections(self.seen.data, self.ids, **fields_of_projections).measured

    @property
    def geometry(self) -> Geometry:
        """The geometry of the projections used."""
        geometry = self.lines.geometry
        return geometry.select(slice(self.n_used)) if self.lines.held_out.size else geometry

    @property
    def n_used(self) -> int:
        """Number of the projections used."""
        return len(self.lines.data) - self.lines.held_out.size

    def with_true_heights(self, volume: Volume) -> Volume:
        """A volume of `geometry`, resampled to the true heights of its slices."""
        if self.pixel_aspect == 1:
            return volume
        grid, (z, y, x) = volume.grid, volume.grid.centre
        true_grid = replace(grid, centre=(z * self.pixel_aspect, y, x), slice_pitch=grid.spacing[0] * self.pixel_aspect)
        return Volume(volume.data, true_grid)

    @property
    def box(self) -> Grid:
        """The box of the field of view; or, if the measured reach of the sample is larger, a box that contains the
        sample.
        """
        grid, reach = Grid.matching(self.geometry), self.lines.reach
        return grid if reach is None else reach.box(grid, self.geometry)

    def of_rows(self, rows: slice, geometry: Geometry) -> PreparedProjections:
        """The same projections restricted to the detector rows of `geometry`; line integrals are not copied."""

        lines = self.lines
        geometry_of_rows = lines.geometry.rows(rows.start, rows.stop) if lines.held_out.size else geometry
        weights = _part_of(lines.weights, (..., rows, slice(None)))
        return replace(
            self,
            lines=replace(lines, data=lines.data[:, rows], geometry=geometry_of_rows, weights=weights),
            corrected=replace(self.corrected, masked=self.corrected.masked[rows]),
            sources=self.sources.rows(rows),
        )

    @property
    def centred(self) -> PreparedProjections:
        """The same projections without laterally offset ones, in which the sample is displaced by more than half a
        field of view.
        """
        return self.selecting(self.geometry.is_centred)

    def selecting(self, chosen: NDArray[np.bool_]) -> PreparedProjections:
        """The same data with only the projections that `chosen` selects, bool [view used]."""
        return self if chosen.all() else self.of_views(np.flatnonzero(chosen))

    def of_views(self, views: I64) -> PreparedProjections:
        """The same data with only these of the projections used, by number and in this order. Held-out projections are
        unchanged.
        """
        return self._with_lines(self.lines.using(views), views)

    def _with_lines(self, lines: Views, views: I64) -> PreparedProjections:
        """These line integrals. The projections with the numbers `views` are used."""

        air = replace(self.corrected, air=self.corrected.air[views])
        return replace(
            self, lines=lines, corrected=air, sources=self.sources.views(views), times=_part_of(self.times, views)
        )

    def holding_out(self, held: I64) -> PreparedProjections:
        """The same data with the projections of these numbers (sorted) held out. All of them were used before."""
        return self._with_lines(self.lines.holding_out(held), np.setdiff1d(np.arange(self.n_used), held))

    def with_held_out(self, others: Projections, geometry: Geometry, room: F32 | None = None) -> PreparedProjections:
        """The same projections, which are all used, followed by other projections that are held out.

        Args:
            geometry: geometry of the other projections.
            room: array that begins with the line integrals of these projections and has room for the others; None: a
                new array is made.
        """
        lines, n, n_others = self.lines, len(self.lines.data), len(others.data)
        if room is None:
            data = np.concatenate((lines.data, others.data))
        else:
            data = room[: n + n_others]
            data[n:] = others.data
        other_weights: Any = others.weights
        weights = None if lines.weights is None else np.concatenate((lines.weights, other_weights))
        ids, used = np.concatenate((self.ids, others.view_ids)), np.arange(n + n_others) < n
        joined_geometry = lines.geometry.followed_by(geometry)
        return replace(self, lines=Views(data, joined_geometry, weights, ids, used, lines.reach))

    @property
    def whole_views(self) -> I64:
        """Numbers of the projections in which every pixel has data, except for pixels that are masked in all
        projections.
        """
        return np.flatnonzero(~np.isin(self.ids, self.corrected.unmeasured[:, 0]))

    @property
    def unmeasured_rows(self) -> tuple[I64, I64]:
        """Two sets of binned detector rows. (1) Rows that no ray measured. (2) Those of them that lie between measured
        rows and are interpolated, such as a line that the camera does not read.
        """
        ids, (height, width) = self.ids, self.geometry.detector_shape
        runs = self.corrected.unmeasured
        measured = np.ones((height, width), np.bool_) if self.sources.measured is None else self.sources.measured
        # [row, col + 1], number of known pixels to the left of the column
        measured_before = np.pad(np.cumsum(measured, axis=1), ((0, 0), (1, 0)))
        _, row, left, right = runs[np.isin(runs[:, 0], ids)].T  # runs of these projections
        lengths = measured_before[row, right] - measured_before[row, left]  # a run ends at a masked area
        unseen = np.bincount(row, lengths, height) >= measured_before[:, -1] * ids.size
        without_data = unseen | self.corrected.masked.all(axis=1)
        return np.flatnonzero(without_data), np.flatnonzero(without_data & ~unseen)

    @property
    def leaves_slices(self) -> bool:
        """True if projections of a parallel beam also see material above or below the slices of the volume, because
        they are shifted along the axis or tilted.
        """
        geometry = self.geometry
        shifted = np.ptp(geometry.shifts[:, 1]) > 0
        return not geometry.is_cone and (bool(shifted) or not geometry.is_straight)

    @property
    def without_warnings(self) -> PreparedProjections:
        """The same projections without the warnings of the monitor, see `WeightSources`."""
        return replace(self, sources=self.sources.without_warnings)

    def _ray_factors(self) -> RayWeights | None:
        """Weights of all projections, computed when they are needed; None if all rays have weight 1.

        Rays of held-out projections get the usual weight of the projections used, unless their photons were counted,
        too.
        """
        factors: list[NDArray[np.float32]] = []
        n, geometry, sources = self.n_used, self.geometry, self.sources
        n_held_out = len(self.lines.data) - n
        if sources.view_weights is not None:
            factors.append(_and_ones(sources.view_weights, n_held_out)[:, None, None])
        if (photon_weights := self.lines.weights) is not None:
            factors.append(photon_weights / (used := photon_weights[:n]).mean(where=used > 0))
        if sources.measured is not None:
            factors.append(sources.measured.astype(np.float32)[None])
        if self.leaves_slices:
            grid = Grid.matching(geometry)
            factors.append(seen_rays(self.lines.geometry, grid).astype(np.float32))
        if sources.region_weights is not None:
            factors.append(_and_ones(sources.region_weights, n_held_out))
        if not factors:
            return None
        shape = (n + n_held_out, *geometry.detector_shape)
        return RayWeights(tuple(np.broadcast_to(factor, shape) for factor in factors))


def _and_ones(values: NDArray[np.float32], n_others: int) -> NDArray[np.float32]:
    """The values of the projections used, followed by ones for the other projections."""
    return np.concatenate((values, np.ones((n_others, *values.shape[1:]), np.float32)))


def hold_out(
    prepared: PreparedProjections, one_in: int, *, most: int | None = None, advice: str
) -> PreparedProjections:
    """Hold out every `one_in`-th projection, evenly spread. Nothing changes if the selection already holds some out.

    Args:
        most: largest number of held-out projections.
        advice: what the user can do instead, for the error message.

    Raises:
        ConfigError: fewer than two projections would be left.
    """
    if prepared.lines.held_out.size:
        return prepared
    n = prepared.n_used
    count = max(1, n // one_in)
    count = count if most is None else min(count, most)
    if n - count < 2:
        raise ConfigError(f"{n} projections are too few to hold some out; choose more with --views, or {advice}.")
    # The first and the last projection are not held out, because each has a neighbour on one side only.
    return prepared.holding_out(np.unique((np.arange(count) + 0.5) * n // count).astype(np.int64))
