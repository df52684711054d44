"""CorrectionPlan: converts the counts of one scan to line integrals, with its darks and flats. `survey` makes the
plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon.base.arrays import F32, F64, I64, Mask
from recon.base.choices import SPOT_ERRORS
from recon.base.declared_types import check_settings
from recon.base.masks import Fill, Image, areas, fill, plan_fill
from recon.prep.counts import Photons, of_view
from recon.prep.dynamic_flats import DynamicFlats
from recon.prep.projections import Projections
from recon.prep.references import (
    References,
    air_columns,
    air_transmission,
    check,
    dead_pixels,
    edge_depth,
    edge_profiles,
    flat_at,
)
from recon.prep.spots import SpotFilter, Transmission
from recon.prep.unmeasured import NO_RUNS, runs_of, unmeasured


class ViewsWithoutBeamError(ValueError):
    """The air columns of some projections are dark (the beam was off)."""


@dataclass(frozen=True)
class CorrectionSettings:
    """Settings of the correction from counts to line integrals.

    A transmission below `floor`, including zero and negative values, is replaced by `floor`; the line integral is then
    -log(floor). A pixel is masked if its dark, or its response to the beam, differs from its neighbours by more than
    `hot_threshold`. A pixel is a zinger if it exceeds both its surroundings and the same pixel in the neighbouring
    projections by `zinger_threshold`, see `recon.prep.spots.spots`.

    Each projection is divided by the level of its air columns. If both sides have air columns, the projection is
    divided by a straight line between the levels of the left and the right side. If the line integral at the edges is
    larger than `sample_from`, the setting "auto" of `air` assumes that the edges show the sample and not air, see
    `references.edge_depth`.

    Attributes:
        floor: smallest transmission; a smaller transmission is replaced by `floor`.
        hot_threshold: limit in robust standard deviations; inf: no pixel is masked.
        zinger_threshold: limit in standard deviations; inf: no zinger is removed.
        air: number of columns (left, right) that see no sample in any projection, or "auto" to find them, or "none".
        sample_from: line integral at the edges of the detector above which the edges show the sample, not air.
    """

    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = SPOT_ERRORS
    air: Literal["none", "auto"] | tuple[int, int] = "auto"
    sample_from: float = np.inf

    def __post_init__(self) -> None:
        check_settings(self)
        if not 0 < self.floor < 1:
            raise ValueError(f"floor must be a transmission between 0 and 1, got {self.floor}")
        if not (self.hot_threshold > 0 and self.zinger_threshold > 0):
            raise ValueError(
                f"thresholds must be positive (inf switches a threshold off), got hot {self.hot_threshold}, zinger "
                f"{self.zinger_threshold}"
            )


@dataclass(frozen=True, eq=False)
class CorrectionPlan:
    """All that is needed to convert the counts of one scan to line integrals. `survey` makes this plan, and `apply`
    uses it.

    Give the projections in the order in which they were taken, in batches of any size. The result for a projection
    depends on four things: the flats, the darks, the air columns found in all projections so far, and its two
    neighbours. Because of the neighbours, the newest projection waits for the next one. If flats, darks and air columns
    are the same, the line integrals are bit-identical for any split into batches.

    Attributes:
        settings: settings of the correction.
        dark: float32 [row, col].
        flats: (position, float32 [row, col]) of each group of flats, in order. The images are flat minus dark, with 1
            in masked pixels.
        part_starts, dynamic: as in `References`.
        masked: bool [row, col], pixels that are filled in every projection.
        hidden: bool [row, col], `masks.areas` of `masked`.
        filling: order in which masked pixels are filled, see `masks.plan_fill`.
        photons: how photons are counted; the line integrals and weights then represent the likelihood, see
            `counts.line_integrals`. None: line integrals are logarithms.
        foreign: bool [row], rows in which dark pixels do not show the sample, see `unmeasured`. None: there are no such
            rows.
        intensity_factors: float64 [frame of the scan], factor on the intensity of each projection; None: 1 for all.
        spots: state of the zinger filter after the projections so far.
        profiles: for each batch of projections so far, the `edge_profiles` and the numbers int64 [view] of its
            projections.
    """

    settings: CorrectionSettings
    dark: Image
    flats: tuple[tuple[float, Image], ...]
    part_starts: tuple[int, ...]
    dynamic: DynamicFlats | None
    masked: Mask
    hidden: Mask
    filling: Fill
    spots: SpotFilter
    photons: Photons | None = None
    foreign: Mask | None = None
    intensity_factors: F64 | None = None
    profiles: tuple[tuple[F32, I64], ...] = ()

    @cached_property
    def air_columns(self) -> tuple[int, int]:
        """(left, right) number of air columns, found from the projections so far; (0, 0) if there are none."""
        air = self.settings.air
        if air != "auto":
            return (0, 0) if air == "none" else air
        if not self.profiles:
            return 0, 0
        profiles, ids = (np.concatenate(each) for each in zip(*self.profiles, strict=True))
        columns = air_columns(profiles, self.dark.shape[1])
        if not any(columns) or not np.isfinite(self.settings.sample_from):
            return columns
        depth = edge_depth(profiles, ids, [position for position, _ in self.flats], columns)
        return (0, 0) if depth > self.settings.sample_from else columns

    def transmission(
        self,
        counts: NDArray[np.generic],
        positions: NDArray[np.float64],
        view_ids: NDArray[np.int64],
        progress: Callable[[int], None] = lambda done: None,
    ) -> Transmission:
        """Transmission (counts - dark) / (flat - dark), with bad pixels filled from their neighbours.

        Args:
            counts: [view, row, col], any real type, in the order of acquisition.
            positions: [view], number of the frame in the scan, as in the flats' positions.
            view_ids: int64 [view].
            progress: function called with the number of projections done.

        Raises:
            ValueError: shapes do not match, a position is not finite, or more than half of a projection is not finite.
        """
        _check_views(counts, positions, self.dark.shape)
        if view_ids.shape != counts.shape[:1]:
            raise ValueError(f"view_ids must have shape {counts.shape[:1]}, got {view_ids.shape}")
        data, repaired = np.empty(counts.shape, np.float32), np.zeros(len(counts), np.int64)
        beam, runs = None if self.photons is None else np.empty(counts.shape, np.float32), [NO_RUNS]
        for v, view in enumerate(data):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                np.subtract(counts[v], self.dark, out=view, casting="unsafe")
                flat = self._flat_of(view, float(positions[v]))
                view /= flat
            if beam is not None and self.photons is not None:
                np.divide(flat, np.float32(self.photons.gain), out=beam[v])
                fill(beam[v], self.filling)
            not_finite = ~np.isfinite(view) & ~self.masked
            repaired[v] = not_finite.sum()
            if repaired[v] > view.size / 2:
                raise ValueError(
                    f"leave out projection {view_ids[v]}: {repaired[v]} of its {view.size} pixels are not finite"
                )
            if (unseen := unmeasured(counts[v], view, self.hidden, self.foreign)) is not None:
                runs.append(runs_of(unseen, int(view_ids[v])))
                repaired[v] -= np.count_nonzero(not_finite & unseen)
                not_finite |= unseen
            fill(view, plan_fill(not_finite | self.masked) if repaired[v] or unseen is not None else self.filling)
            progress(v + 1)
        if self.intensity_factors is not None:
            factors = self.intensity_factors[view_ids].astype(np.float32)[:, None, None]
            np.multiply(data, factors, out=data)
            if beam is not None:
                np.divide(beam, factors, out=beam)
        return Transmission(data, view_ids, repaired, np.ones(len(data), np.float32), beam, np.concatenate(runs))

    def _flat_of(self, view: Image, position: float) -> Image:
        """Flat minus dark [row, col] for a projection; 1 in masked pixels."""
        interpolated = flat_at(position, self.flats, self.part_starts)
        if self.dynamic is None:
            return interpolated
        unmasked = ~self.masked
        level = interpolated[unmasked].mean() / self.dynamic.mean[unmasked].mean()
        return np.where(self.masked, np.float32(1), level * self.dynamic.flat_of(view / level, self.settings.floor))

    def surveyed(self, views: Transmission) -> CorrectionPlan:
        """The plan after the search for air columns has also used these projections."""
        if self.settings.air != "auto":
            return self
        return replace(self, profiles=(*self.profiles, (edge_profiles(views.data), views.view_ids)))

    def line_integrals(
        self,
        views: Transmission | None,
        last: bool = True,
        progress: Callable[[int], None] = lambda done: None,
        order: NDArray[np.intp] | None = None,
    ) -> tuple[Projections, CorrectionPlan]:
        """Line integrals of the waiting projection and of the given ones, and the plan for the projections that follow.

        Args:
            views: the next projections; their memory is reused for the result. None: the waiting projection was the
                last one.
            last: True if no projection comes after these. False: the newest projection waits.
            progress: function called with the number of projections whose zingers are removed. (The logarithm, which
                follows, takes little time.)
            order: order of neighbours, see `SpotFilter.feed`.

        Raises:
            ViewsWithoutBeamError: the air columns of some projections are dark; the error contains their numbers.
        """
        settings, columns, floored = self.settings, self.air_columns, 0
        views, spots = self.spots.feed(views and self._levelled(views), last, progress, order)
        for v, view in enumerate(views.data):
            if views.beam is not None:
                self._likelihood(view, views.beam[v])
                continue
            low = view < settings.floor
            floored += int((low & ~self.masked).sum())
            view[low] = settings.floor
            np.negative(np.log(view, out=view), out=view)
        n_unmasked = max(int((~self.masked).sum()) * len(views.data), 1)
        replaced = int(views.repaired.sum()) / n_unmasked
        return Projections(
            views.data, views.view_ids, floored / n_unmasked, views.air, self.masked, columns, replaced, views.beam,
            views.unmeasured, spots.n_unfilled,
        ), replace(self, spots=spots)  # fmt: skip

    def _levelled(self, views: Transmission) -> Transmission:
        """Divide the projections by the level of their air columns, in place."""
        level, columns = air_transmission(views.data, *self.air_columns), self.air_columns
        without_beam = views.view_ids[~(level.min(axis=1) > self.settings.floor)]
        if without_beam.size:
            raise ViewsWithoutBeamError(
                f"leave out the projections without beam: {without_beam.size} of {len(level)} "
                f"({without_beam[:8].tolist()} ...). Their air columns, {columns[0]} on the left and {columns[1]} on "
                "the right, are dark"
            )
        views.data[...] /= level[:, None]
        beam = None if views.beam is None else views.beam * level[:, None]
        return replace(views, air=level.mean(axis=1), beam=beam)

    def _likelihood(self, view: Image, beam: Image) -> None:
        """Replace the transmission of a projection by line integrals, and the number of photons in its beam by
        weights."""
        assert self.photons is not None
        open_beam = beam.astype(np.float64)
        dark_variance = np.full(view.shape, self.photons.variance / self.photons.gain**2)
        lines, weights = of_view(np.maximum(view * open_beam, -dark_variance), open_beam, dark_variance)
        view[...] = np.where(weights > 0, lines, 0)
        beam[...] = np.where(self.masked, 0, weights)


def survey(
    references: References,
    settings: CorrectionSettings | None = None,
    masked: Mask | None = None,
    shadow: Mask | None = None,
    photons: Photons | None = None,
    foreign: Mask | None = None,
    intensity_factors: F64 | None = None,
) -> CorrectionPlan:
    """The correction plan for these flats and darks.

    Args:
        references: darks and flats of the same detector area as the projections.
        masked: bool [row, col], pixels to fill; None: `dead_pixels` of the darks and flats.
        shadow: bool [row, col], further pixels to fill, which are in the shadow of a fixed object; None: there are
            none.
        photons, foreign, intensity_factors: those of the plan.

    Raises:
        ValueError: shapes do not match, there are no flats, or the flats show no beam.
    """
    settings = CorrectionSettings() if settings is None else settings
    check(references)
    dark = np.asarray(references.dark, np.float32)
    air, cols = settings.air, dark.shape[1]
    if isinstance(air, tuple) and not (min(air) >= 0 and 0 < sum(air) <= cols):
        raise ValueError(f"air columns (left, right) {air} do not fit into {cols} columns")
    if masked is not None and np.shape(masked) != dark.shape:
        raise ValueError(f"masked must have shape {dark.shape}, got {np.shape(masked)}")
    if masked is None:
        masked = dead_pixels(dark, [flat for _, flat in references.flats], settings.hot_threshold)
    masked = masked if shadow is None else masked | shadow
    with np.errstate(invalid="ignore", over="ignore"):
        flats = tuple(
            (position, np.where(masked, np.float32(1), np.asarray(flat, np.float32) - dark))
            for position, flat in sorted(references.flats, key=lambda group: group[0])
        )
    spots = SpotFilter(settings.zinger_threshold, lambda transmission: np.sqrt(np.maximum(transmission, 0)))
    starts, hidden, filling = references.part_starts, areas(masked), plan_fill(masked)
    return CorrectionPlan(
        settings, dark, flats, starts, references.dynamic, masked, hidden, filling, spots, photons, foreign,
        intensity_factors,
    )  # fmt: skip


def _check_views(counts: NDArray[np.generic], positions: NDArray[np.float64], shape: tuple[int, ...]) -> None:
    if counts.ndim != 3 or counts.size == 0:
        raise ValueError(f"counts must be [view, row, col] with at least one projection, got shape {counts.shape}")
    if counts.shape[1:] != shape:
        raise ValueError(
            f"the dark has shape {shape}, the projections {counts.shape[1:]}; both must have the same shape"
        )
    if np.shape(positions) != counts.shape[:1]:
        raise ValueError(
            f"positions must hold one number for each of the {len(counts)} projections, got shape {np.shape(positions)}"
        )
    if not np.isfinite(positions).all():
        raise ValueError(
            f"the positions of projections {np.flatnonzero(~np.isfinite(positions))[:8].tolist()} are not finite"
        )
