"""Scans whose images are not views: sinograms, one or a stack of them, in any order of their dimensions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets
from beamline.storage.readers.base import ScanSource, frame_indices
from beamline.storage.readers.frames import Frames, Read
from beamline.storage.readers.stacks import SINOGRAM, Order, TurnedFrames, in_order, stated_order
from beamline.storage.writers.rows import ScanEnding
from drivers.base.frame import FrameKind


def with_order(base: ScanSource, order: str | None, n_angles: int | None) -> ScanSource:
    """A scan whose images, one after the other, have the dimensions that `order` names, such as "row,view,col".

    Args:
        order: None: the images are views, but for a single one that has as many rows, or columns, as there are angles:
            it is a sinogram.

    Raises:
        DataError: some of the images are darks or flats, or they have other dimensions; or a sinogram is square.
    """
    fits = [axis for axis, n in enumerate(base.shape) if n == n_angles]
    if order is not None:
        return _reordered(base, stated_order(order), order)
    if base.image_key.size != 1 or n_angles == 1 or not fits:
        return base
    if len(fits) > 1:
        raise DataError(
            f"{base.path} holds one image of {n_angles} x {n_angles} pixels, a sinogram by its {n_angles} angles: which "
            "side the views are is not known. Say --order view,col or --order col,view."
        )
    return _reordered(base, (1, None, 0) if fits[0] else SINOGRAM, "")


class _Images:
    """All images of a scan as an array [image, row, col]."""

    def __init__(self, base: ScanSource) -> None:
        self.shape, self.dtype, self.ndim = (base.image_key.size, *base.shape), base.dtype, 3
        self.name, self.file, self.chunks, self._read = str(base.path), None, None, base.read

    def __getitem__(self, part: tuple[slice, slice, slice]) -> NDArray[Any]:
        return self._read(part[0], part[1])[..., part[2]]


def _reordered(base: ScanSource, order: Order, named: str) -> ScanSource:
    images = in_order(_Images(base), order)
    size = f"{base.image_key.size} images of {' x '.join(map(str, base.shape))} pixels"
    if not isinstance(images, TurnedFrames) or (base.image_key != FrameKind.PROJECTION).any():
        raise DataError(
            f"--order {named} does not fit {base.path}, {size}. It names each dimension, and all images must be of the "
            "sample: give darks and flats with --darks and --flats."
        )

    def pixels(read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        indices = frame_indices(frames, len(images))
        out = np.empty((indices.size, len(range(images.shape[1])[rows]), images.shape[2]), base.dtype)
        datasets.read_frames(images, indices, rows, out)
        return out

    unknown = np.full(len(images), np.nan)
    return Frames(
        base,
        pixels=pixels,
        shape=images.shape[1:],
        image_key=np.full(len(images), FrameKind.PROJECTION, np.int32),
        angles=unknown,
        exposures=unknown,
        numbers=None,
        in_order=True,
        ending=ScanEnding(),
        frame_bytes=base.frame_bytes * base.image_key.size,
        attributes=lambda known: {**known, "dimensions": named or "one sinogram, by the number of angles"},
    )
