"""Scans that are read with changes: other angles or references in front, or several frames as one view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.readers.base import WHOLE, Attributes, Quantity, ScanSource, frame_indices, read_known
from beamline.storage.readers.supplied import assign
from beamline.storage.readers.wrapped import WrappedSource
from drivers.base.frame import Frame, FrameKind


class OverlaidSource(WrappedSource):
    """A ScanSource with references in front of the frames of `base`: darks, flats, then these frames.

    If darks (flats) are given, those of `base` become INVALID: they stay in place, unused.
    """

    def __init__(
        self,
        base: ScanSource,
        *,
        angles: NDArray[np.float64] | None = None,
        angles_from: str = "",
        of_views: bool = False,
        darks: NDArray[Any] | None = None,
        flats: NDArray[Any] | None = None,
        quantity: Quantity | None = None,
    ) -> None:
        """Lay over `base`.

        Args:
            angles: radians, for `base` (see `supplied.assign`); `angles_from` names them in errors.
            of_views: the angles are those of projections alone.
            darks, flats: [frame, row, col].

        DataError where shapes or counts do not fit.
        """
        super().__init__(base)
        self._replaced = {FrameKind.DARK: darks, FrameKind.FLAT: flats}
        given = [(kind, images) for kind, images in self._replaced.items() if images is not None]
        for kind, images in given:
            if images.ndim != 3 or images.shape[1:] != base.shape or len(images) == 0:
                raise DataError(
                    f"The --{kind.name.lower()}s are {images.shape}; expected [frame, row, col] with frames of "
                    f"{base.shape} as in {base.path}."
                )
        # One dtype, as of one camera: references are measured like the frames, and averages of them are floats.
        self.dtype = np.result_type(base.dtype, *(images.dtype for _, images in given))
        blocks = [images.astype(self.dtype) for _, images in given]
        self._front = np.concatenate(blocks) if blocks else np.empty((0, *base.shape), self.dtype)
        self._front_key = np.repeat([int(kind) for kind, _ in given], [len(images) for _, images in given])
        self._angles = None if angles is None else assign(base, angles, angles_from, of_views=of_views)
        self._quantity = quantity
        self._update()

    def _update(self) -> None:
        """Take over the present state of `base`; added references have no angles and exposures."""
        base = self._base
        keys = base.image_key.copy()
        for kind, images in self._replaced.items():
            if images is not None:
                keys[keys == kind] = FrameKind.INVALID
        self.image_key = np.concatenate([self._front_key, keys]).astype(np.int32)
        self.angles = self.of_frames(base.angles if self._angles is None else self._angles)
        self.exposures = self.of_frames(base.exposures)
        has_both = {FrameKind.DARK, FrameKind.FLAT} <= set(self.image_key.tolist())
        stated: Quantity = "counts" if has_both and base.quantity == "unknown" else base.quantity
        self.quantity = self._quantity or stated

    @property
    def flags(self) -> FrameFlags | None:
        flags = self._base.flags
        return None if flags is None else flags.after(len(self._front))

    @property
    def replaces(self) -> NDArray[np.int64] | None:
        rows, n = self._base.replaces, len(self._front)
        return None if rows is None else np.concatenate([np.full(n, -1), np.where(rows < 0, -1, rows + n)])

    @property
    def part_starts(self) -> NDArray[np.int64]:
        """The parts of `base`, the first including the references in front; added flats are valid for all parts."""
        if self._replaced[FrameKind.FLAT] is not None:
            return np.zeros(1, np.int64)
        starts = self._base.part_starts
        return np.where(starts > 0, starts + len(self._front), 0)

    def of_frames(self, known: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([np.full((len(self._front), *known.shape[1:]), np.nan), known])

    @property
    def altered(self) -> frozenset[int]:
        return frozenset(row + len(self._front) for row in self._base.altered)

    @property
    def damaged(self) -> frozenset[int]:
        return frozenset(row + len(self._front) for row in self._base.damaged)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        n = len(self._front)
        indices = frame_indices(frames, n + self._base.image_key.size)
        front = indices < n
        if not front.any():
            return self._base.read(indices - n, rows).astype(self.dtype, copy=False)
        out = np.empty((indices.size, len(range(self.shape[0])[rows]), self.shape[1]), self.dtype)
        out[front] = self._front[indices[front], rows]
        if not front.all():
            out[~front] = self._base.read(indices[~front] - n, rows)
        return out

    def frames(self, first: int = 0) -> Iterator[Frame]:
        """The frames from `first` on; those of `base` keep their metadata."""
        if len(self._front) or self.dtype != np.uint16:
            return super().frames(first)
        angles = self.angles
        return (replace(frame, angle=float(angles[frame.index])) for frame in self._frames_of_base(first))


JOINED_DEG = "frames_per_view_joined_deg"
"""Attribute of a scan whose frames are averaged: the largest angle between two frames of a view."""
_EXACT = 2  # bytes of a whole number, whose sums over a view uint32 holds


class AveragedSource(WrappedSource):
    """A ScanSource whose projections are means of those of `base`; darks and flats are unchanged, invalid frames are
    omitted.

    A view is up to `n` projections that follow one another, closer in angle than the last frames of a view and the
    first of the next. So a view that lacks frames takes none of its neighbour's. Of a growing file a view is there once
    a frame of the next one is, or its n-th.

    The mean is that of the frames without an alarm, or of all where each has one. Whole numbers are summed as such,
    real ones in float64; their mean is rounded once, to float32 (a part in 10^7). Frames that are damaged or cannot be
    read have no part in it.
    """

    def __init__(self, base: ScanSource, n: int) -> None:
        """Raises ConfigError where no view would have more than one frame, or the scan is one of counts that emit."""
        super().__init__(base)
        self.dtype, self.numbers, self.frames_per_view = np.dtype(np.float32), None, n
        self._groups: list[list[int]] = []  # rows of base, by row of this source
        self._looked_at = 0  # rows of base that belong to a group, or to none
        if base.plan.get("frames_per_view") == n and "angles_deg" in base.plan:
            self.plan = {**base.plan, "angles_deg": base.plan["angles_deg"][::n]}
        if base.emission is not None:
            raise ConfigError(f"--frames-per-view: {base.path} is of an emission, whose counts are not averaged.")
        self._update()
        if base.finished and not any(len(group) > 1 for group in self._groups):
            views = int((base.image_key == FrameKind.PROJECTION).sum())
            raise ConfigError(
                f"--frames-per-view {n}: no two of the {views} projections of {base.path} that follow one another are "
                "closer in angle than views are. Leave it out. Nothing was read."
            )

    def _update(self) -> None:
        base = self._base
        self._assign(self._apart())
        groups = self._groups
        first = np.array([group[0] for group in groups], np.int64)
        usable = [[row for row in group if base.image_key[row] != FrameKind.INVALID] for group in groups]
        self._usable = [rows or group for rows, group in zip(usable, groups, strict=True)]
        self._used = self._without_alarms()
        lost = np.array([not rows for rows in usable], np.bool_)
        self.image_key = np.where(lost, FrameKind.INVALID, base.image_key[first]).astype(np.int32)
        self.angles, self.exposures = self.of_frames(base.angles), base.exposures[first]

    def _apart(self) -> float:
        """Radians from a view's first frame from which on a frame is of another view."""
        views = self._base.image_key == FrameKind.PROJECTION
        planned = np.radians(np.asarray(self._base.plan.get("angles_deg", ()), np.float64))
        angles = planned if planned.size > self.frames_per_view else self._base.angles[views]
        steps = np.abs(angles[self.frames_per_view :] - angles[: -self.frames_per_view])
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return float(np.median(steps)) * (1 - 0.5 / self.frames_per_view) if steps.size else np.inf

    def _assign(self, apart: float) -> None:
        """Put the rows of base that came since into groups; rows of a view that may still get frames wait."""
        keys, angles, n = self._base.image_key, self._base.angles, self.frames_per_view
        open_group: list[int] = []
        for row in range(self._looked_at, keys.size):
            key = keys[row]
            if key == FrameKind.INVALID:
                continue
            near = bool(open_group) and not abs(angles[row] - angles[open_group[0]]) >= apart
            if open_group and not (key == FrameKind.PROJECTION and near and len(open_group) < n):
                self._groups.append(open_group)
                open_group = []
            if key == FrameKind.PROJECTION:
                open_group.append(row)
                if len(open_group) == n:
                    self._groups.append(open_group)
                    open_group = []
            else:
                self._groups.append([row])
        if open_group and self._base.finished:
            self._groups.append(open_group)
            open_group = []
        self._looked_at = open_group[0] if open_group else int(keys.size)

    def of_frames(self, known: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values [row] of this scan: means over the frames averaged into each row."""
        return np.array([known[rows].mean(axis=0) for rows in self._used]).reshape(-1, *known.shape[1:])

    def _without_alarms(self) -> list[list[int]]:
        """Rows of base that a row is the mean of, without those with an alarm where others have none."""
        flags = self._base.flags
        if flags is None or not flags.alarmed.any():
            return self._usable
        return [[row for row in rows if not flags.alarmed[row]] or rows for rows in self._usable]

    @property
    def attributes(self) -> Attributes:
        out = sum(map(len, self._usable)) - sum(map(len, self._used))
        facts = {"frames_per_view": self.frames_per_view, "frames_left_out_by_alarms": out, JOINED_DEG: self._joined()}
        return {**self._base.attributes, **{name: value for name, value in facts.items() if value}}

    def _joined(self) -> float:
        """The largest angle between two frames of a view."""
        angles = self._base.angles
        return float(np.degrees(max((np.ptp(angles[rows]) for rows in self._groups if len(rows) > 1), default=0.0)))

    @property
    def frame_bytes(self) -> int:
        return self._base.frame_bytes * self.frames_per_view

    @property
    def flags(self) -> FrameFlags | None:
        """The combined flags of the frames averaged into each row; a region is the box around theirs."""
        flags = self._base.flags
        if flags is None:
            return None
        bits = np.array([np.bitwise_or.reduce(flags.bits[rows]) for rows in self._used], flags.bits.dtype)
        scores, regions = flags.scores, flags.regions
        if scores is not None:
            scores = np.stack([_greatest(scores[rows]) for rows in self._used]) if self._used else scores[:0]
        if regions is not None:
            regions = np.stack([_box_around(regions[rows]) for rows in self._used]) if self._used else regions[:0]
        return FrameFlags(bits, flags.legend, scores, regions)

    @property
    def part_starts(self) -> NDArray[np.int64]:
        first = np.array([group[0] for group in self._groups], np.int64)
        return np.unique(np.searchsorted(first, self._base.part_starts))

    @property
    def damaged(self) -> frozenset[int]:
        rows = self._base.damaged
        return frozenset(i for i, group in enumerate(self._used) if rows.issuperset(group)) if rows else rows

    replaces, altered = ScanSource.replaces, ScanSource.altered  # such frames are gone

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        base = self._base
        wanted = [self._used[i] for i in frame_indices(frames, len(self._used)).tolist()]
        shape = len(wanted), len(range(self.shape[0])[rows]), self.shape[1]
        whole = base.dtype.kind == "u" and base.dtype.itemsize <= _EXACT
        total, counted = np.zeros(shape, np.uint32 if whole else np.float64), np.zeros(len(wanted))
        for turn in range(max(map(len, wanted), default=0)):
            views = [i for i, group in enumerate(wanted) if turn < len(group)]
            images = read_known(base, [wanted[i][turn] for i in views], rows)
            bad = base.damaged | base.unreadable.keys()
            for i, image in zip(views, images, strict=True):
                if wanted[i][turn] not in bad or bad.issuperset(wanted[i]):  # the last one where all are
                    np.add(total[i], image, out=total[i], casting="unsafe")
                    counted[i] += 1
        for group in wanted:
            if group and base.unreadable.keys() >= set(group):
                raise UnreadableError(base.unreadable[group[0]])
        return (total / np.maximum(counted, 1)[:, None, None]).astype(np.float32)


def _greatest(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """[check] the scores [frame, check] farthest from 0; NaN where no frame has one."""
    at = np.where(np.isfinite(scores), np.abs(scores), -1).argmax(axis=0)
    return np.asarray(scores[at, np.arange(scores.shape[1])])


def _box_around(regions: NDArray[np.int32]) -> NDArray[np.int32]:
    """[check, 4] the box around regions [frame, check, 4]; -1 where no frame has one."""
    there = regions[..., :1] >= 0
    low = np.where(there, regions, np.iinfo(np.int32).max).min(axis=0)
    high = regions.max(axis=0)
    box = np.stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]], axis=1)
    return np.where(there.any(axis=0), box, -1).astype(np.int32)


def stated_frames_per_view(source: ScanSource) -> int:
    """Frames per view by the plan in the file; 1 if it has no plan."""
    stated = source.plan.get("frames_per_view", 1)
    return stated if isinstance(stated, int) and stated > 1 else 1


def angles_of_frames(angles: NDArray[np.float64], source: ScanSource, n: int) -> NDArray[np.float64]:
    """Angles [frame]: if one is given for each view, it applies to the view's n frames."""
    views = int((source.image_key == FrameKind.PROJECTION).sum())
    return np.repeat(angles, n) if angles.size * n == views else angles
