"""correct: counts to line integrals by dark and flat; dead pixels, beam drift and zingers; then -log, or likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.arrays import I64, Mask, without_mask
from recon.base.declared_types import check_arguments, check_settings
from recon.base.masks import Image, areas, fill, plan_fill
from recon.prep.counts import Photons, of_view
from recon.prep.references import References as References
from recon.prep.references import (
    air_columns,
    air_light,
    check,
    dead_pixels,
    edge_depth,
    edge_profiles,
    flat_at,
    zingers,
)
from recon.prep.unmeasured import runs_of, unmeasured

NO_RUNS = np.zeros((0, 4), np.int64)
NO_RUNS.flags.writeable = False


class UnlitViewsError(ValueError):
    """The air columns of some views are dark."""


@dataclass(frozen=True)
class CorrectionSettings:
    """Settings of the correction from counts to line integrals.

    Attributes:
        floor: lowest transmission; below it, also for zero and negative values, the line integral is -log(floor).
        hot_threshold: robust standard deviations by which a pixel's dark, or its response to the beam, must differ from
            its neighbours to be masked; inf masks none.
        zinger_threshold: robust standard deviations by which a pixel must be brighter than its neighbours, and than
            itself in the neighbouring views, to be replaced; inf replaces none.
        air: columns (left, right) that see no sample in any view, or "auto" to find them, or "none". Each view is
        divided by their level, or by the line through the levels of both sides.
        sample_from: line integral at the edges from which "auto" takes them for sample, see `references.edge_depth`.
    """

    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = 8.0
    air: Literal["none", "auto"] | tuple[int, int] = "auto"
    sample_from: float = np.inf

    def __post_init__(self) -> None:
        check_settings(self)
        if not 0 < self.floor < 1:
            raise ValueError(f"floor is a transmission between 0 and 1, got {self.floor}")
        if not (self.hot_threshold > 0 and self.zinger_threshold > 0):
            raise ValueError(
                f"thresholds must be positive (inf turns one off), got hot {self.hot_threshold}, "
                f"zinger {self.zinger_threshold}"
            )


@dataclass(frozen=True, eq=False)
class Projections:
    """Line integrals, and what the correction changed.

    Attributes:
        data: float32 [view, row, col], dimensionless, finite.
        view_ids: int64 [view].
        floored: fraction of the live pixels that were set to -log(floor).
        air: float32 [view], transmission of the air, by which each view was divided, on average; 1 without air columns.
        masked: bool [row, col], dead and hot pixels, filled from their neighbours in every view.
        air_columns: (left, right) number of columns in which `air` was measured; (0, 0): none.
        replaced: fraction of the live pixels that were zingers or not finite in one view; filled from their neighbours.
        weights: float32 [view, row, col], inverse variances of the line integrals by the photons expected, 0 for masked
            pixels; None: photons were not counted.
        unmeasured: int64 [run, 4], pixels that measured nothing in one view, filled from their neighbours: its number
            in `view_ids`, row, first column, column after the last.
    """

    data: NDArray[np.float32]
    view_ids: NDArray[np.int64]
    floored: float
    air: NDArray[np.float32]
    masked: Mask
    air_columns: tuple[int, int] = (0, 0)
    replaced: float = 0.0
    weights: NDArray[np.float32] | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)


@dataclass(frozen=True, eq=False)
class Transmission:
    """Views divided by the flat, before the correction of air and zingers.

    Attributes:
        data: float32 [view, row, col], finite; `Correction.line_integrals` takes it over.
        view_ids: int64 [view].
        repaired: int64 [view], live pixels that were not finite; filled from their neighbours.
        beam: float32 [view, row, col], photons without the sample; None: photons are not counted.
        unmeasured: as of `Projections`.
    """

    data: NDArray[np.float32]
    view_ids: NDArray[np.int64]
    repaired: NDArray[np.int64]
    beam: NDArray[np.float32] | None = None
    unmeasured: I64 = field(default_factory=NO_RUNS.copy)


class Correction:
    """Correction of one scan's views, which come in the order they were taken, in batches of any size.

    For each batch: `transmission`, then `survey`, then `line_integrals`. A view depends on the references, on the air
    columns found in all views surveyed so far, and on its two neighbours. So the newest view waits for the next one.
    With the same references and air columns the line integrals are the same to the bit for any split into batches.
    """

    def __init__(
        self,
        references: References,
        settings: CorrectionSettings | None = None,
        masked: Mask | None = None,
        photons: Photons | None = None,
        foreign: Mask | None = None,
    ) -> None:
        """Take the references.

        Args:
            references: darks and flats of the detector area of the views.
            masked: bool [row, col], pixels to fill; None: `dead_pixels` of the references.
            photons: the line integrals and weights carry the likelihood of the counts, see `counts.line_integrals`;
                None: the line integrals are logarithms.
            foreign: bool [row], rows in which what is dark is not the sample, see `unmeasured`; None: none.

        Raises:
            ValueError: for shapes that do not fit, no flats, or no beam in the flats.
        """
        self._settings = CorrectionSettings() if settings is None else settings
        check(references)
        self._dark = np.asarray(references.dark, np.float32)
        air, cols = self._settings.air, self._dark.shape[1]
        if isinstance(air, tuple) and not (min(air) >= 0 and 0 < sum(air) <= cols):
            raise ValueError(f"air columns (left, right) {air} do not fit {cols} columns")
        if masked is not None and np.shape(masked) != self._dark.shape:
            raise ValueError(f"masked must have shape {self._dark.shape}, got {np.shape(masked)}")
        if masked is None:
            masked = dead_pixels(self._dark, [flat for _, flat in references.flats], self._settings.hot_threshold)
        self.masked, self._hidden, self._foreign = masked, areas(masked), foreign
        self._fill, self._photons, self._dynamic = plan_fill(masked), photons, references.dynamic
        with np.errstate(invalid="ignore", over="ignore"):
            self._flats = [
                (position, np.where(masked, np.float32(1), np.asarray(flat, np.float32) - self._dark))
                for position, flat in sorted(references.flats, key=lambda group: group[0])
            ]
        self._part_starts = references.part_starts
        self._profiles: list[NDArray[np.float32]] = []
        self._surveyed: list[NDArray[np.int64]] = []
        self._before: Image | None = None  # the last returned view, before the logarithm
        self._waiting: tuple[Transmission, NDArray[np.float32]] | None = None  # the newest view, and its air

    @property
    def waiting(self) -> bool:
        """Whether the newest view waits for the one after it."""
        return self._waiting is not None

    def provisional(self) -> Projections | None:
        """Line integrals of the waiting view, as if no view followed; None if no view waits.

        It keeps waiting, because all its zingers show only beside both neighbours."""
        if self._waiting is None:
            return None
        waiting, before = self._waiting, self._before
        lines = self.line_integrals(None)
        self._waiting, self._before = waiting, before
        return lines

    @property
    def air_columns(self) -> tuple[int, int]:
        """(left, right) columns of air from the views surveyed so far; (0, 0) if there are none."""
        air = self._settings.air
        if air != "auto":
            return (0, 0) if air == "none" else air
        if not self._profiles:
            return 0, 0
        profiles, ids = np.concatenate(self._profiles), np.concatenate(self._surveyed)
        columns = air_columns(profiles, self._dark.shape[1])
        if not any(columns) or not np.isfinite(self._settings.sample_from):
            return columns
        depth = edge_depth(profiles, ids, [position for position, _ in self._flats], columns)
        return (0, 0) if depth > self._settings.sample_from else columns

    def transmission(
        self,
        counts: NDArray[np.generic],
        positions: NDArray[np.float64],
        view_ids: NDArray[np.int64] | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Transmission:
        """(counts - dark) / (flat - dark) with bad pixels filled from their neighbours.

        Args:
            counts: [view, row, col], any real type, in the order of acquisition.
            positions: [view], number of the frame in the scan, as in the flats' positions.
            view_ids: int64 [view]; None: 0, 1, 2 ...
            progress: how many views are done, after each.

        Raises:
            ValueError: for shapes that do not fit, positions or more than half of a view not finite.
        """
        self._check_views(counts, positions)
        ids = np.arange(len(counts), dtype=np.int64) if view_ids is None else np.asarray(view_ids, np.int64)
        if ids.shape != counts.shape[:1]:
            raise ValueError(f"view_ids must have shape {counts.shape[:1]}, got {ids.shape}")
        data, repaired = np.empty(counts.shape, np.float32), np.zeros(len(counts), np.int64)
        beam, runs = None if self._photons is None else np.empty(counts.shape, np.float32), [NO_RUNS]
        for v, view in enumerate(data):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                np.subtract(counts[v], self._dark, out=view, casting="unsafe")
                flat = self._flat_of(view, float(positions[v]))
                view /= flat
            if beam is not None and self._photons is not None:
                np.divide(flat, np.float32(self._photons.gain), out=beam[v])
                fill(beam[v], self._fill)
            bad = ~np.isfinite(view) & ~self.masked
            repaired[v] = bad.sum()
            if repaired[v] > view.size / 2:
                raise ValueError(
                    f"view {ids[v]}: {repaired[v]} of {view.size} pixels are not finite; leave this view out"
                )
            if (unseen := unmeasured(counts[v], view, self._hidden, self._foreign)) is not None:
                runs.append(runs_of(unseen, int(ids[v])))
                repaired[v] -= np.count_nonzero(bad & unseen)
                bad |= unseen
            fill(view, plan_fill(bad | self.masked) if repaired[v] or unseen is not None else self._fill)
            progress(v + 1)
        return Transmission(data, ids, repaired, beam, np.concatenate(runs))

    def _flat_of(self, view: Image, position: float) -> Image:
        """Net flat of a view [row, col] without its dark; 1 in masked pixels."""
        between = flat_at(position, self._flats, self._part_starts)
        if self._dynamic is None:
            return between
        live = ~self.masked
        level = between[live].mean() / self._dynamic.mean[live].mean()
        return np.where(self.masked, np.float32(1), level * self._dynamic.flat_of(view / level, self._settings.floor))

    def survey(self, views: Transmission) -> None:
        """Use the views in the search for air columns."""
        if self._settings.air == "auto":
            self._profiles.append(edge_profiles(views.data))
            self._surveyed.append(views.view_ids)

    def line_integrals(
        self, views: Transmission | None, last: bool = True, progress: Callable[[int], None] = lambda done: None
    ) -> Projections:
        """Line integrals of these views and of the waiting one; without `last` the newest view then waits.

        Args:
            views: the next ones, whose memory the result takes over; None: the scan has ended with the waiting view.
            last: no view comes after these.
            progress: how many views are free of zingers, after each; the logarithm that follows takes little time.

        Raises:
            UnlitViewsError: the air columns of some views are dark; it has their numbers.
        """
        settings, columns = self._settings, self.air_columns
        if views is None:
            rows, cols = self._dark.shape
            none, empty = np.empty((0, rows, cols), np.float32), np.empty(0, np.int64)
            views = Transmission(none, empty, empty, None if self._photons is None else none)
        light = air_light(views.data, *columns)
        air = light.mean(axis=1)
        unlit = views.view_ids[~(light.min(axis=1) > settings.floor)]
        if unlit.size:
            raise UnlitViewsError(
                f"no beam in {unlit.size} of {air.size} views ({unlit[:8].tolist()} ...): the air columns, "
                f"{columns[0]} left and {columns[1]} right, are dark; leave these views out"
            )
        data, ids, repaired, runs = views.data, views.view_ids, views.repaired, views.unmeasured
        data /= light[:, None]
        beam = None if views.beam is None else views.beam * light[:, None]
        if self._waiting is not None:
            first, first_air = self._waiting
            data = np.concatenate((first.data, data))
            ids, air = np.concatenate((first.view_ids, ids)), np.concatenate((first_air, air))
            repaired = np.concatenate((first.repaired, repaired))
            runs = np.concatenate((first.unmeasured, runs))
            if beam is not None and first.beam is not None:
                beam = np.concatenate((first.beam, beam))
        n = len(data) if last else max(len(data) - 1, 0)
        replaced = int(repaired[:n].sum()) + self._remove_zingers(data, n, progress)
        self._waiting, done = None, np.isin(runs[:, 0], ids[:n])
        if n < len(data):
            waits = None if beam is None else beam[n:].copy()
            self._waiting = Transmission(data[n:].copy(), ids[n:], repaired[n:], waits, runs[~done]), air[n:]
        if n:
            self._before = data[n - 1].copy()
        data, floored, beam = data[:n], 0, None if beam is None else beam[:n]
        for v, view in enumerate(data):
            if beam is not None:
                self._likelihood(view, beam[v])
                continue
            low = view < settings.floor
            floored += int((low & ~self.masked).sum())
            view[low] = settings.floor
            np.negative(np.log(view, out=view), out=view)
        live = max(int((~self.masked).sum()) * n, 1)
        return Projections(
            data, ids[:n], floored / live, air[:n], self.masked, columns, replaced / live, beam, runs[done]
        )

    def _likelihood(self, view: Image, beam: Image) -> None:
        """Replace a view's transmission by line integrals, and the photons of its beam by their weights."""
        assert self._photons is not None
        light = beam.astype(np.float64)
        extra = np.full(view.shape, self._photons.variance / self._photons.gain**2)
        p, w = of_view(np.maximum(view * light, -extra), light, extra)
        view[...] = np.where(w > 0, p, 0)
        beam[...] = np.where(self.masked, 0, w)

    def _remove_zingers(self, data: NDArray[np.float32], n: int, progress: Callable[[int], None]) -> int:
        """Take zingers out of the first `n` views; how many pixels they hit."""
        if not np.isfinite(self._settings.zinger_threshold):
            return 0
        replaced = 0
        for v in range(n):
            before = data[v - 1] if v else self._before
            after = data[v + 1] if v + 1 < len(data) else None
            others = [image for image in (before, after) if image is not None]
            r, c, value = zingers(data[v], others, self._settings.zinger_threshold)
            data[v, r, c] = value
            replaced += r.size
            progress(v + 1)
        return replaced

    def _check_views(self, counts: NDArray[np.generic], positions: NDArray[np.float64]) -> None:
        if counts.ndim != 3 or counts.size == 0:
            raise ValueError(f"counts must be [view, row, col] with at least one view, got shape {counts.shape}")
        if counts.shape[1:] != self._dark.shape:
            raise ValueError(f"the dark has shape {self._dark.shape}, the views {counts.shape[1:]}")
        if np.shape(positions) != counts.shape[:1]:
            raise ValueError(
                f"positions must hold one number for each of {len(counts)} views, got shape {np.shape(positions)}"
            )
        if not np.isfinite(positions).all():
            raise ValueError(
                f"the positions of views {np.flatnonzero(~np.isfinite(positions))[:8].tolist()} are not finite"
            )


def correct(
    counts: NDArray[np.generic],
    positions: ArrayLike,
    references: References,
    settings: CorrectionSettings | None = None,
    view_ids: ArrayLike | None = None,
    masked: Mask | None = None,
) -> Projections:
    """Line integrals -log((counts - dark) / (flat - dark)) of a stack of views, by a `Correction` fed at once.

    All results are finite: dead pixels and single bad values take the mean of their good neighbours and are counted.
    Memory beyond the result: a few frames. Arguments and errors are those of `Correction` and of its `transmission`.
    """
    counts = without_mask(counts)
    check_arguments(correct, locals())
    correction = Correction(references, settings, masked)
    ids = None if view_ids is None else np.asarray(view_ids, np.int64)
    views = correction.transmission(counts, np.asarray(positions, np.float64), ids)
    correction.survey(views)
    return correction.line_integrals(views)


def merge_and_empty(parts: list[Projections], data: NDArray[np.float32] | None = None) -> Projections:
    """Join batches of a scan's views. The list is emptied meanwhile, so that only few views are in memory twice.

    The air columns and the mask are those of the last batch.

    Args:
        data: the line integrals of all, if they are together already; those of the batches do not count then.
    """
    n = np.array([part.view_ids.size for part in parts], np.float64)
    weights, last = n / max(n.sum(), 1), parts[-1]
    ids, air, runs = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("view_ids", "air", "unmeasured")
    )
    floored, replaced = (float(weights @ [getattr(part, name) for part in parts]) for name in ("floored", "replaced"))
    each = [part.weights for part in parts if part.weights is not None]
    counted = np.concatenate(each) if each else None
    if data is None:
        data, at = np.empty((len(ids), *last.data.shape[1:]), np.float32), 0
        while parts:
            part = parts.pop(0).data
            data[at : at + len(part)] = part
            at += len(part)
    return Projections(data, ids, floored, air, last.masked, last.air_columns, replaced, counted, runs)
