"""OverlaidSource: a scan with angles, references or a quantity that its file lacks or has wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.angle_table import assign
from beamline.storage.readers.base import WHOLE, Quantity, ScanSource, frame_indices
from beamline.storage.readers.wrapped import WrappedSource
from drivers.base.frame import Frame, FrameKind


class OverlaidSource(WrappedSource):
    """A ScanSource with references in front of it: darks, flats, then the frames of `base`.

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
            angles: radians, for `base` (see `angle_table.assign`); `angles_from` names them in errors.
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
        unknown = np.full(len(self._front), np.nan)
        keys = base.image_key.copy()
        for kind, images in self._replaced.items():
            if images is not None:
                keys[keys == kind] = FrameKind.INVALID
        self.image_key = np.concatenate([self._front_key, keys]).astype(np.int32)
        self.angles = np.concatenate([unknown, base.angles if self._angles is None else self._angles])
        self.exposures = np.concatenate([unknown, base.exposures])
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
        """The parts of `base`, the first with the references in front; added flats hold for all parts."""
        if self._replaced[FrameKind.FLAT] is not None:
            return np.zeros(1, np.int64)
        starts = self._base.part_starts
        return np.where(starts > 0, starts + len(self._front), 0)

    def _behind(self, known: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        """Values [frame] of `base`, NaN for the references in front."""
        return None if known is None else np.concatenate([np.full(len(self._front), np.nan), known])

    @property
    def currents(self) -> NDArray[np.float64] | None:
        return self._behind(self._base.currents)

    @property
    def energies(self) -> NDArray[np.float64] | None:
        return self._behind(self._base.energies)

    @property
    def times(self) -> NDArray[np.float64] | None:
        return self._behind(self._base.times)

    @property
    def shifts(self) -> NDArray[np.float64] | None:
        known = self._base.shifts
        return None if known is None else np.concatenate([np.full((len(self._front), 2), np.nan), known])

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
        """The frames from `first` on; those of `base` keep what their file knows about them."""
        if len(self._front) or self.dtype != np.uint16:
            return super().frames(first)
        angles = self.angles
        return (replace(frame, angle=float(angles[frame.index])) for frame in self._frames_of_base(first))
