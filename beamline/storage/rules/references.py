"""Darks and flats of a file: their groups, the good groups, and findings on the others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import spans
from beamline.monitor.digest import block_means, check_block, is_valid
from beamline.monitor.flats_with_sample import (
    brighter_in_places,
    depth_over_air,
    flats_like_views,
    lit_places,
    mass_missing,
    nothing_seen,
)
from beamline.monitor.odd_references import without_odd
from beamline.monitor.references import (
    BY_CHANCE,
    WORST,
    Group,
    GroupVerdict,
    ReferenceFrame,
    ReferenceLimits,
    full_scale,
    judge,
)
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules import Finding
from beamline.storage.rules.exposures import levelled, usual_exposure, views_differ
from drivers.base.frame import FrameKind
from recon.base.views import spread

SAMPLES = 4  # views beside whose light flats are judged
VIEWS, BESIDE = 32, 2  # views that flats must not look like: so many of all, and so many on either side of each group
BRIGHTER = 0.02  # share of the light by which views may exceed flats: the drift of a beam
_SORTED = 2**20  # pixels, about, whose values are counted
CELLS = 32  # across the frame, about, by which flats are compared with views

Frames = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ReferenceGroups:
    """Darks and flats of a scan, by groups.

    Attributes:
        darks, flats: rows of each group, in the order of the file. Frames of a group that are none (see
            `beamline.monitor.odd_references`) are groups of their own.
        judged: the verdict on each group, the darks first.
        alike: views differ from good flats and from one another by less than this line integral, by noise alone; None:
            they show something.
        brighter: views are brighter than good flats in places, by this line integral; None: nowhere.
    """

    darks: tuple[Frames, ...]
    flats: tuple[Frames, ...]
    judged: tuple[GroupVerdict, ...]
    alike: float | None = None
    brighter: float | None = None

    def good(self) -> ReferenceGroups:
        """The groups without a fault; for a kind without such a group, all groups."""
        ok = [not group.faults for group in self.judged]
        dark_ok, flat_ok = ok[: len(self.darks)], ok[len(self.darks) :]
        return ReferenceGroups(_kept(self.darks, dark_ok), _kept(self.flats, flat_ok), self.judged)

    def lacking(self) -> tuple[GroupVerdict, ...]:
        """The groups of a kind of which all are faulty."""
        return tuple(
            group for group in self.judged if all(other.faults for other in self.judged if other.kind is group.kind)
        )


def _kept(groups: tuple[Frames, ...], ok: list[bool]) -> tuple[Frames, ...]:
    return tuple(group for group, good in zip(groups, ok, strict=True) if good) if any(ok) else groups


def groups_of(source: ScanSource, kind: FrameKind) -> tuple[Frames, ...]:
    """Rows of the references of a kind, by groups: references of one part with no projection between them."""
    rows = np.flatnonzero(source.image_key == kind)
    before = np.cumsum(source.image_key == FrameKind.PROJECTION)[rows]
    before += np.searchsorted(source.part_starts, rows, "right")  # neither decreases, so that the sum tells both
    return tuple(np.split(rows, np.flatnonzero(np.diff(before)) + 1)) if rows.size else ()


def groups_taken(source: ScanSource) -> ReferenceGroups:
    """All reference groups of a scan, faulty ones included."""
    return ReferenceGroups(groups_of(source, FrameKind.DARK), groups_of(source, FrameKind.FLAT), ())


# The groups of a scan, which several rules and the correction of its views ask for, and what they depend on.
_last: WeakKeyDictionary[ScanSource, tuple[tuple[object, ...], ReferenceGroups]] = WeakKeyDictionary()


def reference_groups(source: ScanSource, limits: ReferenceLimits | None = None) -> ReferenceGroups:
    """The reference groups of a scan of counts, checked frame by frame and as groups; flats are compared within their
    part.

    They are judged once, until the scan grows or another of its frames turns out to be unreadable.
    """
    last = _last.get(source)
    if last is None or last[0] != _depends_on(source, limits):
        groups = _judged(source, limits)
        _last[source] = last = _depends_on(source, limits), groups  # with the unreadable frames that it came across
    return last[1]


def _depends_on(source: ScanSource, limits: ReferenceLimits | None) -> tuple[object, ...]:
    rows = (source.image_key, source.exposures, source.angles, source.part_starts)
    return limits, *(values.tobytes() for values in rows), tuple(source.unreadable)


def _judged(source: ScanSource, limits: ReferenceLimits | None) -> ReferenceGroups:
    taken = groups_taken(source)
    groups = [_readable(source, group) for group in (*taken.darks, *taken.flats)]
    left, odd = without_odd(groups, limits, views := _views_beside(source, taken.flats))
    dark, lit = ([group for group in left if group[0].kind is kind] for kind in (FrameKind.DARK, FrameKind.FLAT))
    exposed = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & (source.exposures > 0))
    groups_judged = [*judge([*dark, *lit], limits)[: len(dark)]]
    for start, end in pairwise([*source.part_starts.tolist(), source.image_key.size]):
        own, seen = (
            [group for group in lit if start <= group[0].row < end],
            exposed[(exposed >= start) & (exposed < end)],
        )
        witnesses = _readable(source, spread(seen, SAMPLES)) if seen.size and own else []
        groups_judged += judge([*dark, *own], limits, witnesses)[len(dark) :]
    alike, brighter = None, None
    if lit and not any(group.faults for group in groups_judged[len(dark) :]):
        depth = depth_over_air(lit, dark, views)
        alike, fault = nothing_seen(depth), flats_like_views(lit, dark, views, depth) or mass_missing(depth)
        if fault is not None:
            groups_judged = [
                replace(group, faults=(fault,)) if group.kind is FrameKind.FLAT else group for group in groups_judged
            ]
        else:
            brighter = brighter_in_places(lit, dark, views)
    groups_judged = [_with_unread(source, group, (*taken.darks, *taken.flats)) for group in groups_judged]
    judged = sorted([*groups_judged, *odd], key=lambda group: (group.kind is FrameKind.FLAT, group.rows[0]))
    rows = [np.array(group.rows, np.int64) for group in judged]
    n = sum(group.kind is FrameKind.DARK for group in judged)
    return ReferenceGroups(tuple(rows[:n]), tuple(rows[n:]), tuple(judged), alike, brighter)


def _views_beside(source: ScanSource, flats: tuple[Frames, ...]) -> Group:
    """Views of the whole scan, those taken next to flats, and those at the angles of flats, with their cells."""
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    if not views.size:
        return []
    chosen = set(spread(views, VIEWS).tolist())
    for group in flats:
        at = int(np.searchsorted(views, group[0]))
        chosen.update(views[max(at - BESIDE, 0) : at + BESIDE].tolist())
        angle = source.angles[group[0]]
        if np.isfinite(angle) and np.isfinite(source.angles[views]).any():
            chosen.add(int(views[np.nanargmin(np.abs(source.angles[views] - angle))]))
    return _readable(source, np.array(sorted(chosen), np.int64))


def references_usable(source: ScanSource, accepted: bool = False) -> Iterator[Finding]:
    """Flats are lit, complete and even, and darks are dark; a faulty group is left out if there is a good one.

    An error where all groups of a kind are bad, a warning for others that have a fault.

    Args:
        accepted: all are used as they are, so that a fault is a warning.
    """
    if source.quantity != "counts":
        return
    groups = reference_groups(source)
    if groups.alike is not None:
        yield Finding(
            "warning",
            "bad-references",
            f"No view looked at differs from the flats by more than noise (line integrals below {groups.alike:.2g}). "
            "Either there is no sample in the views, or it was in the beam for the flats, too, and looks the same from "
            "all sides.",
        )
    if groups.brighter is not None:
        yield Finding(
            "warning",
            "bad-references",
            f"In places the views are brighter than the flats by {groups.brighter:.2g} of line integral, though a "
            "sample only takes light. Was the sample, or something else, in the beam for the flats, or did the beam "
            "change its shape?",
        )
    lacking = groups.lacking()
    alike: dict[tuple[FrameKind, tuple[str, ...], bool], list[int]] = {}
    for group in groups.judged:
        if group.faults:
            faults = tuple(fault.message for fault in group.faults)
            alike.setdefault((group.kind, faults, group in lacking), []).extend(group.rows)
    for (kind, faults, none_good), rows in alike.items():
        name = f"{kind.name.lower()}s"
        message = f"The {name} {spans(rows)}: {' '.join(faults)}"
        if accepted:
            yield Finding("warning", "bad-references", f"--references accept: {message}")
        elif none_good:
            message += (
                f" It must not be reconstructed: take new {name}, or give others with --{name}; `beamline recon "
                "--references accept` uses these as they are."
            )
            yield Finding("error", "bad-references", message)
        else:
            yield Finding("warning", "bad-references", f"{message} The other {name} are used instead.")


def _with_unread(source: ScanSource, judged: GroupVerdict, taken: Sequence[Frames]) -> GroupVerdict:
    """The group with frames of its own that the file does not give: who reads them leaves them out, and names them."""
    own = next(group for group in taken if judged.rows[0] in group)
    return replace(judged, rows=tuple(sorted({*judged.rows, *own.tolist()} & {*judged.rows, *source.unreadable})))


def _readable(source: ScanSource, rows: Frames) -> list[ReferenceFrame]:
    """Those of some frames that the file gives; all, where it gives none."""
    read = [reference_frame(source, int(row)) for row in rows]
    return [reference for reference in read if reference.row not in source.unreadable] or read


# What was seen of frames, whose pixels do not change while the scan is open, by their rows.
_seen: WeakKeyDictionary[ScanSource, dict[int, ReferenceFrame]] = WeakKeyDictionary()


def reference_frame(source: ScanSource, row: int) -> ReferenceFrame:
    """Statistics of a frame of any kind, with its cells, treated like a dark; the frame is read once."""
    return levelled(source, _as_it_is(source, row), lambda other: _as_it_is(source, other))


def _as_it_is(source: ScanSource, row: int) -> ReferenceFrame:
    seen = _seen.setdefault(source, {})
    if row not in seen:
        seen[row] = look_at(read_known(source, [row])[0], row)
    kind = FrameKind(int(source.image_key[row]))
    return replace(seen[row], kind=kind, exposure=float(source.exposures[row]))


def exposures_of(source: ScanSource) -> NDArray[np.float64]:
    """Exposure of each frame in s, NaN where unknown.

    Of flats that state none beside views that differ: the longest, the median or the shortest of the views', the first
    for which no place of the views is brighter than the flats.
    """
    flats = np.flatnonzero((source.image_key == FrameKind.FLAT) & ~(source.exposures > 0))
    darks = np.flatnonzero(source.image_key == FrameKind.DARK)
    views = np.flatnonzero(source.image_key == FrameKind.PROJECTION)
    if not (flats.size and darks.size and views_differ(source)):
        return source.exposures
    dark, light = (mean_cells(source, rows) for rows in (darks, flats))
    lit = lit_places(light - dark)
    seen = [mean_cells(source, row) for row in spread(views, VIEWS)[:, None]]
    shares = [np.percentile((cells - dark)[lit] / (light - dark)[lit], WORST) for cells in seen if lit.any()]
    most = usual_exposure(source) / max(float(np.median(shares)), 1e-30) if shares else 0.0
    of_views = source.exposures[views]
    for each in (of_views.max(), np.median(of_views), of_views.min()):
        if each <= (1 + BRIGHTER) * most:
            return np.where(np.isin(np.arange(source.image_key.size), flats), each, source.exposures)
    return source.exposures


def mean_cells(source: ScanSource, rows: Frames) -> NDArray[np.float32]:
    """Cells of the mean of the readable frames."""
    cells = dict(zip(rows.tolist(), cells_of(source, rows), strict=True))
    known = [cells[row] for row in cells if row not in source.unreadable] or list(cells.values())
    return np.asarray(np.nan_to_num(np.mean(known, axis=0)), np.float32)


def cells_of(source: ScanSource, rows: Frames) -> list[NDArray[np.float32]]:
    """Cells of some frames, one by one."""
    return [frame.cells for row in rows.tolist() if (frame := reference_frame(source, row)).cells is not None]


def look_at(image: NDArray[Any], row: int) -> ReferenceFrame:
    """Statistics of an image, with its cells."""
    counts = image.dtype.kind in "ui"
    saturation = full_scale(float(image.max())) if counts else None
    saturated = 0.0 if saturation is None else float(np.mean(image >= saturation))
    block, side = check_block(image.shape), max(1, image.shape[1] // CELLS)
    frame = ReferenceFrame.seen(row, FrameKind.INVALID, np.nan, saturated, block_means(image, block), block)
    frame = replace(frame, cells=block_means(image, side))
    if image.dtype != np.uint16:
        frame = replace(frame, invalid=1 - float(np.mean(is_valid(image))), rounding=frame.rounding * counts)
    some = image.ravel()[:: 1 + image.size // _SORTED]
    values, held = np.unique(some[np.isfinite(some)], return_counts=True)
    if not held.size:
        return frame
    end = int(np.flatnonzero(held > min(BY_CHANCE, held.max() - 1))[-1])
    last = counts and end == held.size - 1  # counts that thin out towards a few hot pixels do not end
    shared = max(0, int(held[end]) - max(BY_CHANCE, 0 if last else int(held[end - 1]))) / some.size
    return replace(frame, largest=float(values[end]), at_largest=shared)
