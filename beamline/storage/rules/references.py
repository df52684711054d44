"""Evidence of a file: its darks and flats by groups, how they are exposed, which are good, and what is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from beamline.core.flag import Finding
from beamline.monitor.digest import block_means, check_block, is_valid, thinned
from beamline.monitor.evidence import BRIGHT, DRIFT, LEAST_NOISE, Evidence, FrameStatistics, full_scale, lit_places
from beamline.monitor.references import ReferenceLimits, judge
from beamline.storage.readers.base import ScanSource, read_known
from drivers.base.frame import FrameKind
from recon.base.arrays import F32, F64, I64
from recon.base.noise import deviation_between_neighbours
from recon.base.views import spread
from recon.prep.references import dark_at
from recon.prep.unmeasured import with_borders_filled

VIEWS, BESIDE = 32, 2  # views that flats must not look like: so many of all, and so many on either side of each group
CELLS = 32  # across the frame, about, by which flats are compared with views
WORST = 99.0  # percentile of the places of a view that counts, so that zingers do not
EXPOSURE_TOLERANCE = 1e-3  # cameras round an exposure


@dataclass(frozen=True, eq=False)
class ReferenceGroups:
    """Darks and flats that are used, by groups, and the findings on all.

    Attributes:
        darks, flats: rows of each group, in the order of the file.
    """

    darks: tuple[I64, ...]
    flats: tuple[I64, ...]
    findings: tuple[Finding, ...] = ()


def groups_of(source: ScanSource, kind: FrameKind) -> tuple[I64, ...]:
    """Rows of the references of a kind, by groups: references of one part with no projection between them."""
    rows = source.table.of_kind(kind)
    before = np.searchsorted(source.table.views, rows)
    before += np.searchsorted(source.table.part_starts, rows, "right")  # neither decreases, so that the sum tells both
    return tuple(np.split(rows, np.flatnonzero(np.diff(before)) + 1)) if rows.size else ()


def groups_taken(source: ScanSource) -> ReferenceGroups:
    """All reference groups of a scan, faulty ones included."""
    return ReferenceGroups(groups_of(source, FrameKind.DARK), groups_of(source, FrameKind.FLAT))


# The groups of a scan, which several rules and the correction of its views ask for, and what they depend on.
_last: WeakKeyDictionary[ScanSource, tuple[tuple[object, ...], ReferenceGroups]] = WeakKeyDictionary()


def reference_groups(source: ScanSource, limits: ReferenceLimits | None = None) -> ReferenceGroups:
    """The good references of a scan of counts, or all of a kind that has none, and the findings on all.

    They are judged once, until the scan grows or another of its frames turns out to be unreadable.
    """
    last = _last.get(source)
    if last is None or last[0] != _depends_on(source, limits):
        taken = groups_taken(source)
        findings = _findings(source, taken, limits)
        bad = [row for finding in findings if finding.severity != "error" for row in finding.frames]
        darks, flats = (
            tuple(left for group in groups if (left := np.setdiff1d(group, bad)).size)
            for groups in (taken.darks, taken.flats)
        )
        groups = ReferenceGroups(darks, flats, findings)
        _last[source] = last = _depends_on(source, limits), groups  # with the unreadable frames that it came across
    return last[1]


def _depends_on(source: ScanSource, limits: ReferenceLimits | None) -> tuple[object, ...]:
    rows = (source.table.kinds, source.table.exposures, source.table.angles, source.table.part_starts)
    return limits, *(values.tobytes() for values in rows), tuple(source.unreadable)


def _findings(source: ScanSource, taken: ReferenceGroups, limits: ReferenceLimits | None) -> tuple[Finding, ...]:
    """Findings on references, flats beside those and the views of their part; errors where none of a kind is good."""
    darks, found = tuple(_readable(source, group) for group in taken.darks), dict[Finding, None]()
    for start, end in pairwise([*source.table.part_starts.tolist(), len(source.table)]):
        flats = [group for group in taken.flats if start <= group[0] < end]
        seen = tuple(_readable(source, group) for group in flats)
        views = source.table.views_of(start, end)
        if flats or not taken.flats:
            found |= dict.fromkeys(judge(Evidence((*darks, *seen), _views_beside(source, views, flats)), limits))
    rows = {row for finding in found for row in finding.frames}
    good = {source.table.kind(row) for group in (*taken.darks, *taken.flats) for row in group if row not in rows}
    return tuple(
        replace(each, severity="warning") if each.frames and source.table.kind(each.frames[0]) in good else each
        for each in found
    )


def _views_beside(source: ScanSource, views: I64, flats: list[I64]) -> tuple[FrameStatistics, ...]:
    """Views of the whole part, and next to its flats."""
    chosen = set(spread(views, VIEWS).tolist())
    for group in flats:
        at = int(np.searchsorted(views, group[0]))
        chosen.update(views[max(at - BESIDE, 0) : at + BESIDE].tolist())
    return _readable(source, np.array(sorted(chosen), np.int64))


def _readable(source: ScanSource, rows: I64) -> tuple[FrameStatistics, ...]:
    """The frames, of these rows, that can be read; all, where none can."""
    read = tuple(seen_frame(source, int(row)) for row in rows)
    return tuple(frame for frame in read if frame.row not in source.unreadable) or read


def references_usable(source: ScanSource, accepted: bool = False) -> Iterator[Finding]:
    """Flats are lit, complete and even, and darks are dark; a faulty group is left out if there is a good one.

    An error where all groups of a kind are bad, a warning for others that have a fault.

    Args:
        accepted: all are used as they are, so that a fault is a warning.
    """
    for finding in reference_groups(source).findings if source.quantity == "counts" else ():
        message = finding.message
        if finding.frames:
            name = f"{source.table.kind(finding.frames[0]).name.lower()}s"
            if accepted:
                message = f"--references accept: {message}"
            elif finding.severity == "error":
                message += (
                    f" It must not be reconstructed: take new {name}, or give others with --{name}; `beamline recon "
                    "--references accept` uses these as they are."
                )
            else:
                message += f" The other {name} are used instead."
        severity = "warning" if accepted else finding.severity
        yield replace(finding, severity=severity, rule="bad-references", message=message)


# What was seen of frames, whose pixels do not change while the scan is open, by their rows.
_seen: WeakKeyDictionary[ScanSource, dict[int, FrameStatistics]] = WeakKeyDictionary()


def seen_frame(source: ScanSource, row: int) -> FrameStatistics:
    """Statistics of a frame of any kind, with its cells, which is read once.

    They are those with the dark of the shortest exposure and, of projections that differ, at the usual exposure.
    """
    frame, groups = _as_it_is(source, row), by_exposure(source, source.table.darks)
    differ = views_differ(source) and groups[0][1].size > 0
    if not frame.exposure > 0 or not (len(groups) > 1 or differ):
        return frame
    usual = usual_exposure(source) if differ and frame.kind is FrameKind.PROJECTION else frame.exposure

    def levelled(part: str) -> F32:
        darks = [(s, np.mean([getattr(_as_it_is(source, int(at)), part) for at in rows], axis=0)) for s, rows in groups]
        own = dark_at(frame.exposure, darks) if len(darks) > 1 else darks[0][1]
        return np.asarray(darks[0][1] + (getattr(frame, part) - own) * np.float32(usual / frame.exposure), np.float32)

    return replace(frame, blocks=levelled("blocks"), cells=levelled("cells"), exposure=usual)


def _as_it_is(source: ScanSource, row: int) -> FrameStatistics:
    seen = _seen.setdefault(source, {})
    if row not in seen:
        image = read_known(source, [row])[0]
        counted = source.quantity == "counts" and source.table.kind(row) is not FrameKind.DARK
        seen[row] = look_at(with_borders_filled(image) if counted else image, row)
    kind = source.table.kind(row)
    return replace(seen[row], kind=kind, exposure=float(source.table.exposures[row]))


def look_at(image: NDArray[Any], row: int) -> FrameStatistics:
    """Statistics of an image, with its cells."""
    counts, block = image.dtype.kind in "ui", check_block(image.shape)
    saturated = float(np.mean(image >= full_scale(float(image.max())))) if counts else 0.0
    blocks, cells = (block_means(image, side) for side in (block, max(1, image.shape[1] // CELLS)))
    invalid = 0.0 if image.dtype == np.uint16 else 1 - float(np.mean(is_valid(image)))
    return FrameStatistics(
        row,
        FrameKind.INVALID,
        np.nan,
        saturated,
        np.array(thinned(blocks)),
        block,
        LEAST_NOISE * counts,
        invalid,
        cells,
    )


def mean_cells(source: ScanSource, rows: I64) -> F32:
    """Cells of the mean of the readable frames."""
    cells = dict(zip(rows.tolist(), cells_of(source, rows), strict=True))
    known = [cells[row] for row in cells if row not in source.unreadable] or list(cells.values())
    return np.asarray(np.nan_to_num(np.mean(known, axis=0)), np.float32)


def cells_of(source: ScanSource, rows: I64) -> list[F32]:
    """Cells of some frames, one by one."""
    return [seen_frame(source, row).places for row in rows.tolist()]


def usual_exposure(source: ScanSource) -> float:
    """The median exposure of the projections in s; NaN if it is unknown."""
    of_views = source.table.exposures[source.table.views]
    known = of_views[of_views > 0]
    return float(np.median(known)) if known.size else np.nan


def views_differ(source: ScanSource) -> bool:
    """Whether the exposures of the projections differ, and that of each is known."""
    views = source.table.exposures[source.table.views]
    return bool(views.size and (views > 0).all() and np.ptp(views) > EXPOSURE_TOLERANCE * np.median(views))


def by_exposure(source: ScanSource, rows: I64) -> list[tuple[float, I64]]:
    """The rows of each exposure among these frames; one group, of NaN, if one is unknown or all have one."""
    seconds = source.table.exposures[rows]
    if not rows.size or not (seconds > 0).all() or np.ptp(seconds) <= EXPOSURE_TOLERANCE * seconds.min():
        return [(np.nan, rows)]
    order = np.argsort(seconds, kind="stable")
    edges = np.flatnonzero(np.diff(seconds[order]) > EXPOSURE_TOLERANCE * seconds[order][:-1]) + 1
    return [(float(np.median(source.table.exposures[part])), np.sort(part)) for part in np.split(rows[order], edges)]


def exposures_of(source: ScanSource) -> F64:
    """Exposure of each frame in s, NaN where unknown.

    Of flats that state none beside views that differ: the longest, the median or the shortest of the views', the first
    for which no place of the views is brighter than the flats.
    """
    table, exposures = source.table, source.table.exposures
    flats, darks, views = table.flats[~(exposures[table.flats] > 0)], table.darks, table.views
    if not (flats.size and darks.size and views_differ(source)):
        return exposures
    dark, light = (mean_cells(source, rows) for rows in (darks, flats))
    lit = lit_places(light - dark)
    seen = [mean_cells(source, row) for row in spread(views, VIEWS)[:, None]]
    shares = [np.percentile((cells - dark)[lit] / (light - dark)[lit], WORST) for cells in seen if lit.any()]
    most = usual_exposure(source) / max(float(np.median(shares)), 1e-30) if shares else 0.0
    of_views = exposures[views]
    for each in (of_views.max(), np.median(of_views), of_views.min()):
        if each <= (1 + DRIFT) * most:
            return np.where(np.isin(np.arange(len(table)), flats), each, exposures)
    return exposures


LEAST = 0.01  # share of the light of the brightest views, in a view's own bright part: all matter leaves that much open
_SUSPECT = 0.1  # share of the flats' light from which a view is not looked at more closely
_ACROSS = 32  # pixels a side, about, by which a view is suspected
_TAIL = 1.2816  # standard deviations: BRIGHT percent of noise are below


@dataclass(frozen=True, eq=False)
class ViewLight:
    """Brightness of whole views relative to the flats; not of single bands of rows, where a sample may be opaque.

    Attributes:
        dark, flat: float32 [cell row, cell col], means; a scan of line integrals has none.
        usual: brightness of the brightest of some views, see `brightness`; 1 where there is none yet.
        known: frames that were looked at, and whether they have light.
    """

    source: ScanSource
    dark: F32 | None
    flat: F32 | None
    usual: float
    known: dict[int, bool] = field(default_factory=dict)

    @classmethod
    def of(cls, source: ScanSource, used: ReferenceGroups | None) -> ViewLight:
        """The light from these darks and flats, and some views; None if the scan has line integrals."""
        views = source.table.views
        if used is None:
            return cls(source, None, None, 1.0)
        dark, flat = (mean_cells(source, np.concatenate(groups)) for groups in (used.darks, used.flats))
        seen = [brightness(cells, dark, flat) for cells in cells_of(source, spread(views, VIEWS))]
        return cls(source, dark, flat, float(np.percentile(seen, BRIGHT)) if seen else 1.0)

    def suspect(self, data: NDArray[np.generic], dark: F32 | None, flat: F32 | None) -> NDArray[np.bool_]:
        """bool [view]: views that are dark or uniform in the pixels read, which may be a band of rows.

        Args:
            data: [view, row, col], as read.
            dark, flat: [row, col], of the same pixels; None: line integrals.
        """
        uniform = np.array([view.min() == view.max() for view in data], np.bool_)
        if dark is None or flat is None or not len(data):
            return uniform
        some = tuple(slice(None, None, max(1, n // _ACROSS)) for n in dark.shape)
        dark, light = dark[some], (flat - dark)[some]
        lit, least = lit_places(light), _SUSPECT * max(self.usual, 0.0)
        shares = [np.median((view[some] - dark)[lit] / light[lit]) if lit.any() else 0.0 for view in data]
        return uniform | ~(np.array(shares) >= least)

    def unlit(self, frame: int) -> bool:
        """Whether a whole view is dark, or uniform while the flats are not."""
        if frame not in self.known:
            self.known[frame] = not self._unlit(frame)
        return not self.known[frame]

    def _unlit(self, frame: int) -> bool:
        image = read_known(self.source, [frame])[0]
        if frame in self.source.unreadable:
            return False  # it is named and left out by who reads it
        if not np.isfinite(image).any():
            return True
        same = bool(image.min() == image.max())
        if self.dark is None or self.flat is None:
            return same
        bright = brightness(cells_of(self.source, np.array([frame]))[0], self.dark, self.flat)
        return bright < LEAST * self.usual or (same and bool(np.ptp(self.flat) > 0))


def brightness(view: F32, dark: F32, flat: F32) -> float:
    """Brightness of a view's bright part relative to the flats, corrected for the bias by noise; from images of
    cells."""
    light = flat - dark
    lit = lit_places(light)
    if not lit.any():
        return 1.0
    share = np.where(lit, (view - dark) / np.where(lit, light, 1), np.nan)
    noise = deviation_between_neighbours(share)
    known = share[np.isfinite(share)]
    if not known.size:
        return 0.0
    return max(float(np.median(known)), float(np.percentile(known, BRIGHT)) - _TAIL * noise)
