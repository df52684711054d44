"""References: the darks and flats of a scan, and which flat a view is divided by."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from recon.base.arrays import F32, F64
from recon.base.masks import Image
from recon.base.settings_check import check_settings
from recon.prep.dynamic_flats import DynamicFlats

Kept = TypeVar("Kept", F32, F64)


@dataclass(frozen=True, eq=False)
class References:
    """Darks and flats: the images without beam, and with beam but without a sample.

    A stack of frames [frame, row, col], any real type, is replaced by its mean.

    Attributes:
        dark: float32 [row, col], mean or median of the darks; or all darks, as a stack.
        flats: (position, float32 [row, col]) of each group of flats, or (position, stack); the position counts frames
            of the scan.
        dynamic: how flats differ from one another; None: a view's flat is interpolated between groups.
        part_starts: ascending, the first frame of each part of the scan. A view's flat comes from the flats of its own
        part, or from the nearest group if its part has no flats.
    """

    dark: Image
    flats: tuple[tuple[float, Image], ...]
    dynamic: DynamicFlats | None = None
    part_starts: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        check_settings(self)
        object.__setattr__(self, "dark", _mean(self.dark, "darks"))
        flats = tuple((position, _mean(flat, f"flats at {position:g}")) for position, flat in self.flats)
        object.__setattr__(self, "flats", flats)

    def rows(self, rows: slice) -> References:
        """The references of some detector rows."""
        flats = tuple((position, flat[rows]) for position, flat in self.flats)
        dynamic = None if self.dynamic is None else self.dynamic.rows(rows)
        return replace(self, dark=self.dark[rows], flats=flats, dynamic=dynamic)


def _mean(frames: Image, what: str) -> Image:
    """The mean of a stack; an image is returned as it is."""
    if np.ndim(frames) != 3:
        return frames
    if not len(frames):
        raise ValueError(f"the stack of {what} is empty: expected [frame, row, col] with at least one frame")
    return np.asarray(np.mean(frames, axis=0, dtype=np.float64), np.float32)


def check(references: References) -> None:
    """Raise ValueError if there are no flats, shapes disagree, or two groups of flats have the same position."""
    if not references.flats:
        raise ValueError("there is no flat: without one, counts cannot be converted to line integrals")
    shape = np.shape(references.dark)
    for position, flat in references.flats:
        if np.shape(flat) != shape or len(shape) != 2:
            raise ValueError(f"the dark has shape {shape}, the flat at {position:g} {np.shape(flat)}")
    at = sorted(p for p, _ in references.flats)
    if len(set(at)) < len(at) or not np.isfinite(at).all():
        raise ValueError(f"each group of flats needs a position of its own, got {at}; average the flats taken together")


def dark_at(exposure: float, darks: Sequence[tuple[float, Kept]]) -> Kept:
    """The dark of an exposure, s: offset and dark current are linear in it, so that two darks tell that of any other.

    Args:
        darks: (exposure, image [row, col]), one or more, of different exposures.
    """
    near = sorted(darks, key=lambda dark: abs(dark[0] - exposure))
    (first, image), *others = near
    if not others or first == exposure:
        return image
    second, other = others[0]
    return image + (exposure - first) / (second - first) * (other - image)


def flat_at(position: float, groups: list[tuple[float, Image]], part_starts: tuple[int, ...]) -> Image:
    """Flat without its dark at a frame's position: interpolated between groups of its part, beyond them the nearest."""
    part = bisect_right(part_starts, position)
    own = [group for group in groups if bisect_right(part_starts, group[0]) == part]
    groups = own or [min(groups, key=lambda group: abs(group[0] - position))]
    at = [p for p, _ in groups]
    upper = int(np.searchsorted(at, position))
    if upper == 0 or upper == len(groups):
        return groups[min(upper, len(groups) - 1)][1]
    weight = np.float32((position - at[upper - 1]) / (at[upper] - at[upper - 1]))
    return groups[upper - 1][1] * (1 - weight) + groups[upper][1] * weight
