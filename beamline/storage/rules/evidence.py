"""Evidence of a scan: facts computed from its darks, flats and some projections. Each job reads the frames and computes
the facts once, and then passes them on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import Finding
from beamline.monitor.digest import block_means, check_block, is_valid, subsampled
from beamline.monitor.evidence import DRIFT, LEAST_NOISE, Evidence, FrameStatistics, full_scale, lit_places
from beamline.monitor.references import ReferenceLimits, reference_findings
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules.illumination import VIEWS, Illumination
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, F64, I64
from recon.base.views import spread
from recon.prep.references import dark_at
from recon.prep.unmeasured import with_borders_filled

BESIDE = 2  # number of projections, on each side of each group of flats, with which the flats are compared
# flats are compared with projections by means over groups of pixels: a frame has about so many groups across
CELLS_ACROSS = 32
WORST = 99.0  # percentile of the groups of pixels of a projection; not the largest value, because of zingers
EXPOSURE_TOLERANCE = 1e-3  # cameras round an exposure time by up to this share


class ReferenceGroups(NamedTuple):
    """Rows of the darks and of the flats, by groups, in the order of the file."""

    darks: tuple[I64, ...]
    flats: tuple[I64, ...]


class EvidenceRequest(NamedTuple):
    """Settings with which the evidence of a scan is computed.

    Attributes:
        accepted: True if the user accepts the darks and flats as they are. Their faults are then only warnings.
        cone: distances in mm from the source to the rotation axis and to the detector, which replace the values in the
            file.
        judge: function that computes flags, which replace the flags in the file; None: the flags in the file are used.
        limits: limits for darks and flats; None: the default limits.
    """

    accepted: bool = False
    cone: tuple[float, float] | None = None
    judge: Callable[[ScanSource], FrameFlags] | None = None
    limits: ReferenceLimits | None = None


@dataclass(frozen=True, eq=False)
class ScanEvidence:
    """Facts that the darks, flats and some projections of a scan show, in addition to what the file states.

    A job creates it once and passes it on. For a running scan, `renewed` adds the new frames. Each fact is computed
    when it is first used, and each frame is read once.

    Attributes:
        source: reads the frames.
        table: table of the frames at the time when the evidence was created.
    """

    source: ScanSource
    request: EvidenceRequest = field(default_factory=EvidenceRequest)
    table: FrameTable = field(init=False)
    _statistics: dict[int, FrameStatistics] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "table", self.source.table)

    def renewed(self) -> ScanEvidence:
        """The evidence with all frames that have been recorded until now."""
        return self if self.source.table is self.table else replace(self)

    @property
    def in_counts(self) -> bool:
        """True if pixels are counts, so that darks and flats are needed."""
        return self.source.quantity == "counts"

    @property
    def cone(self) -> tuple[float, float] | None:
        """mm from the source to the rotation axis and to the detector; None for a parallel beam."""
        return self.source.cone if self.request.cone is None else self.request.cone

    @cached_property
    def flags(self) -> FrameFlags | None:
        """The flags of all frames that count; None: there are no flags."""
        return self.table.flags if self.request.judge is None else self.request.judge(self.source)

    # Darks and flats, by groups

    @cached_property
    def all_references(self) -> ReferenceGroups:
        """All groups of references, faulty ones included."""
        return ReferenceGroups(*(groups_of(self.table, kind) for kind in (FrameKind.DARK, FrameKind.FLAT)))

    @cached_property
    def good_references(self) -> ReferenceGroups:
        """The darks and flats without a fault. If all frames of a kind have a fault, all of them."""
        bad = [row for each in self.findings if each.severity != "error" for row in each.frames]
        good = ((np.setdiff1d(group, bad) for group in groups) for groups in self.all_references)
        return ReferenceGroups(*(tuple(group for group in groups if group.size) for groups in good))

    @property
    def used_references(self) -> ReferenceGroups:
        """The darks and flats that are used to correct the projections."""
        return self.all_references if self.request.accepted else self.good_references

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about darks and flats. They are errors if all frames of a kind have a fault. Flats are compared with
        the other flats, and with the projections of the same part of the scan. There are no findings if the pixels are
        not counts.
        """
        if not self.in_counts:
            return ()
        darks, findings = tuple(self._readable(group) for group in self.all_references.darks), dict[Finding, None]()
        for start, end in pairwise([*self.table.part_starts.tolist(), len(self.table)]):
            flats = [group for group in self.all_references.flats if start <= group[0] < end]
            readable_flats, views = tuple(self._readable(group) for group in flats), self.table.views_of(start, end)
            if flats or not self.all_references.flats:
                evidence = Evidence((*darks, *readable_flats), self._views_near_flats(views, flats))
                findings |= dict.fromkeys(reference_findings(evidence, self.request.limits))
        faulty = {row for finding in findings for row in finding.frames}
        good = {
            self.table.kind(row)
            for groups in self.all_references
            for group in groups
            for row in group
            if row not in faulty
        }
        return tuple(
            replace(each, severity="warning") if each.frames and self.table.kind(each.frames[0]) in good else each
            for each in findings
        )

    def _views_near_flats(self, views: I64, flats: list[I64]) -> tuple[FrameStatistics, ...]:
        """Some projections from the whole part of the scan, and some next to its flats."""
        chosen = set(spread(views, VIEWS).tolist())
        for group in flats:
            position = int(np.searchsorted(views, group[0]))
            chosen.update(views[max(position - BESIDE, 0) : position + BESIDE].tolist())
        return self._readable(np.array(sorted(chosen), np.int64))

    def _readable(self, rows: I64) -> tuple[FrameStatistics, ...]:
        """The rows that can be read; all rows if none can be read."""
        read = tuple(self.frame(row) for row in rows.tolist())
        return tuple(frame for frame in read if frame.row not in self.source.unreadable) or read

    # Frames

    def frame(self, row: int) -> FrameStatistics:
        """Statistics of a frame of any kind, with its cells (means over groups of pixels). The frame is read once.

        The dark with the shortest exposure is used. If the exposures of projections differ, the projections are scaled
        to the usual exposure.
        """
        frame, groups = self._as_recorded(row), self._darks_by_exposure
        views_differ = self.views_differ and groups[0][1].size > 0
        if not frame.exposure > 0 or not (len(groups) > 1 or views_differ):
            return frame
        usual = self.usual_exposure if views_differ and frame.kind is FrameKind.PROJECTION else frame.exposure

        def levelled(part: str) -> F32:
            darks = [
                (seconds, np.mean([getattr(self._as_recorded(dark_row), part) for dark_row in rows.tolist()], axis=0))
                for seconds, rows in groups
            ]
            dark = dark_at(frame.exposure, darks) if len(darks) > 1 else darks[0][1]
            level = darks[0][1] + (getattr(frame, part) - dark) * np.float32(usual / frame.exposure)
            return np.asarray(level, np.float32)

        return replace(frame, blocks=levelled("blocks"), cells=levelled("cells"), exposure=usual)

    def _as_recorded(self, row: int) -> FrameStatistics:
        table = self.table if row < len(self.table) else self.source.table  # the scan is running and has grown
        kind = table.kind(row)
        if row not in self._statistics:
            image = read_known(self.source, [row])[0]
            has_beam = self.in_counts and kind is not FrameKind.DARK
            self._statistics[row] = frame_statistics(with_borders_filled(image) if has_beam else image, row)
        return replace(self._statistics[row], kind=kind, exposure=float(table.exposures[row]))

    def cells(self, rows: I64) -> list[F32]:
        """Yields the cells of some frames."""
        return [self.frame(row).places for row in rows.tolist()]

    def mean_cells(self, rows: I64) -> F32:
        """Cells of the mean over the readable frames."""
        cells = dict(zip(rows.tolist(), self.cells(rows), strict=True))
        readable = [cells[row] for row in cells if row not in self.source.unreadable] or list(cells.values())
        return np.asarray(np.nan_to_num(np.mean(readable, axis=0)), np.float32)

    # Exposures

    @cached_property
    def usual_exposure(self) -> float:
        """The median exposure of the projections in s; NaN if it is unknown."""
        exposures = self.table.exposures[self.table.views]
        known = exposures[exposures > 0]
        return float(np.median(known)) if known.size else np.nan

    @cached_property
    def views_differ(self) -> bool:
        """True if the exposures of all projections are known and differ."""
        views = self.table.exposures[self.table.views]
        return bool(views.size and (views > 0).all() and np.ptp(views) > EXPOSURE_TOLERANCE * np.median(views))

    @cached_property
    def _darks_by_exposure(self) -> list[tuple[float, I64]]:
        return by_exposure(self.table, self.table.darks)

    @cached_property
    def exposures(self) -> F64:
        """Exposure of each frame in s; NaN if unknown.

        If the exposures of projections differ and the flats state none, the exposure of the flats is taken as the
        longest, the median or the shortest exposure of the projections: the first of these for which no place in the
        projections is brighter than the flats.
        """
        table, exposures = self.table, self.table.exposures
        flats, darks, views = table.flats[~(exposures[table.flats] > 0)], table.darks, table.views
        if not (flats.size and darks.size and self.views_differ):
            return exposures
        dark, flat = (self.mean_cells(rows) for rows in (darks, flats))
        exposed = lit_places(flat - dark)
        cells_of_views = [self.mean_cells(row) for row in spread(views, VIEWS)[:, None]]
        shares = [
            np.percentile((cells - dark)[exposed] / (flat - dark)[exposed], WORST)
            for cells in cells_of_views
            if exposed.any()
        ]
        longest = self.usual_exposure / max(float(np.median(shares)), 1e-30) if shares else 0.0
        view_exposures = exposures[views]
        for candidate in (view_exposures.max(), np.median(view_exposures), view_exposures.min()):
            if candidate <= (1 + DRIFT) * longest:
                return np.where(np.isin(np.arange(len(table)), flats), candidate, exposures)
        return exposures

    @cached_property
    def dark_and_flat(self) -> tuple[F32, F32] | None:
        """Cells [cell row, cell col] of the mean dark and of the mean flat that are used; None if the projections are
        not divided by flats.
        """
        if not (self.in_counts and all(self.used_references)):
            return None
        dark, flat = (self.mean_cells(np.concatenate(groups)) for groups in self.used_references)
        return dark, flat

    @cached_property
    def illumination(self) -> Illumination:
        """Which projections have beam."""
        return Illumination(self.source, self.table.views, self.dark_and_flat, lambda row: self.frame(row).places)


def groups_of(table: FrameTable, kind: FrameKind) -> tuple[I64, ...]:
    """Rows of the darks or flats, by groups: a group is a series of frames in one part of the scan without a projection
    in between.
    """
    rows = table.of_kind(kind)
    group_numbers = np.searchsorted(table.views, rows)
    # neither number decreases, so their sum identifies both
    group_numbers += np.searchsorted(table.part_starts, rows, "right")
    return tuple(np.split(rows, np.flatnonzero(np.diff(group_numbers)) + 1)) if rows.size else ()


def by_exposure(table: FrameTable, rows: I64) -> list[tuple[float, I64]]:
    """These frames grouped by exposure in s. There is a single group, with the exposure NaN, if an exposure is unknown
    or if all frames have the same.
    """
    seconds = table.exposures[rows]
    if not rows.size or not (seconds > 0).all() or np.ptp(seconds) <= EXPOSURE_TOLERANCE * seconds.min():
        return [(np.nan, rows)]
    order = np.argsort(seconds, kind="stable")
    edges = np.flatnonzero(np.diff(seconds[order]) > EXPOSURE_TOLERANCE * seconds[order][:-1]) + 1
    return [(float(np.median(table.exposures[part])), np.sort(part)) for part in np.split(rows[order], edges)]


def frame_statistics(image: NDArray[Any], row: int) -> FrameStatistics:
    """Statistics of an image, with its cells."""
    counts, block = image.dtype.kind in "ui", check_block(image.shape)
    saturated = float(np.mean(image >= full_scale(float(image.max())))) if counts else 0.0
    blocks, cells = (block_means(image, side) for side in (block, max(1, image.shape[1] // CELLS_ACROSS)))
    invalid = 0.0 if image.dtype == np.uint16 else 1 - float(np.mean(is_valid(image)))
    kind, rounding = FrameKind.INVALID, LEAST_NOISE * counts
    return FrameStatistics(row, kind, np.nan, saturated, np.array(subsampled(blocks)), block, rounding, invalid, cells)
