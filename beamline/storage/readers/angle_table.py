"""Angles from outside the scan file: read from text or an array, and assigned to frames only if the counts fit."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.files import text_in
from beamline.plan.angles import from_text
from beamline.storage import hdf5
from drivers.base.frame import FrameKind

Angles = Path | str | ArrayLike  # a text file in degrees, or an array in radians


def load_angles(angles: Angles) -> NDArray[np.float64]:
    """Radians from a text file in degrees (one a line, # begins a comment), or from an array in radians."""
    if isinstance(angles, Path | str):
        path = Path(angles)
        try:
            return parse_angles(text_in(path), str(path))
        except OSError as error:
            raise DataError(f"The angles in {path} cannot be read ({hdf5.reason(error)}).") from error
    return np.atleast_1d(np.asarray(angles, np.float64))


def parse_angles(content: str, name: str) -> NDArray[np.float64]:
    """Radians from text in degrees (see `plan.angles.from_text`); `name` is where it came from."""
    try:
        return from_text(content, unknown=True)
    except ValueError as error:
        raise DataError(f"{name}: {error}.") from error


def select_rows(angles: NDArray[np.float64], rows: str) -> NDArray[np.float64]:
    """Rows "a:b" of the angles, counted from 0, b not included; either may be left out."""
    match = re.fullmatch(r"(\d*):(\d*)", rows.strip())
    if match is None:
        raise DataError(
            f"--angle-rows {shlex.quote(rows)} is not of the form A:B, from 0 and B not included, such as 10:101."
        )
    first = int(match[1] or 0)
    last = int(match[2] or angles.size)
    if not 0 <= first < last <= angles.size:
        raise DataError(f"--angle-rows {rows} does not lie within the {angles.size} angles that there are.")
    return angles[first:last]


def assign(image_key: NDArray[np.int32], angles: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Radians for each frame: one angle for each frame, or one for each projection (NaN elsewhere).

    DataError where the counts fit neither, with the rows that look like the projections.
    """
    projections = image_key == FrameKind.PROJECTION
    n = int(projections.sum())
    if angles.size == image_key.size:
        return angles
    if angles.size == n:
        spread = np.full(image_key.size, np.nan)
        spread[projections] = angles
        return spread
    message = (
        f"{name} has {angles.size} angles, but there are {n} projections among {image_key.size} frames. "
        "Say with --angle-rows A:B which of them belong to the projections (from 0, B not included)"
    )
    window = evenly_spaced_window(angles, n)
    if window is not None:
        low, high = np.degrees(angles[list(window)])
        message += (
            f"; --angle-rows {window[0]}:{window[1] + 1} takes the {n} neighbours in the most equal steps, "
            f"from {low:.4f} to {high:.4f} degrees"
        )
    raise DataError(message + ".")


def evenly_spaced_window(angles: NDArray[np.float64], n: int) -> tuple[int, int] | None:
    """First and last row of the n neighbouring rows with the most equal steps, or None without a choice.

    A scan's angle log often holds the darks and flats as well, at a standing stage.
    """
    if n < 3 or angles.size <= n or not np.isfinite(angles).all():
        return None
    steps = np.diff(angles)
    windows = np.lib.stride_tricks.sliding_window_view(steps, n - 1)
    medians = np.median(windows, axis=1)
    moving = np.flatnonzero(medians != 0)
    if moving.size == 0:
        return None
    uneven = np.abs(windows - medians[:, None]).max(axis=1)[moving] / np.abs(medians[moving])
    first = int(moving[np.argmin(uneven)])
    return first, first + n - 1
