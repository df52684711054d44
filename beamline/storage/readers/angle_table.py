"""Angles from outside the scan file: read from text or an array, and assigned to frames only if the counts fit."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.files import text_in
from beamline.plan.plan import from_text
from beamline.storage import hdf5
from beamline.storage.readers.base import ScanSource
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
        raise DataError(f"--angle-rows {rows} is out of range: the file has {angles.size} angles.")
    return angles[first:last]


def assign(
    source: ScanSource, angles: NDArray[np.float64], name: str, *, of_views: bool = False
) -> NDArray[np.float64]:
    """Radians for each frame of a source, NaN where unknown.

    There is one angle for each projection; or one for each number of a series of files, where some are lost; or one for
    each frame, where the order of all frames is known. A log that holds nan for each dark and flat tells it, too. A log
    whose steps are equal from end to end has no rows of darks and flats, for which a stage stands.

    Args:
        name: where the angles come from, for messages.
        of_views: the angles are those of projections alone.

    Raises:
        DataError: the angles fit none of these. It names the rows that are surely those of the projections, if any are.
    """
    key = source.image_key
    projections = key == FrameKind.PROJECTION
    n = int(projections.sum())
    spread = np.full(key.size, np.nan)
    if angles.size == n:
        spread[projections] = angles
        return spread
    numbers = source.numbers
    if numbers is not None and _count_all(numbers, angles.size) and not of_views:
        return np.asarray(angles[numbers - numbers.min()])
    series = None if numbers is None else numbers[projections]
    one_a_number = series is not None and _count_all(series, angles.size)
    all_frames = angles.size == key.size and not of_views
    if all_frames and source.in_order:
        return angles
    if series is not None and one_a_number and (not all_frames or _in_equal_steps(angles)):
        spread[projections] = angles[series - series.min()]
        return spread
    if all_frames and int(np.isfinite(angles).sum()) == n:
        spread[projections] = angles[np.isfinite(angles)]
        return spread
    raise DataError(_misfit(source, angles, name, series))


def _count_all(numbers: NDArray[np.int64], n: int) -> bool:
    """Whether the numbers of files, no two of them the same, go from the first to the last of n."""
    return bool(numbers.min() >= 0 and np.ptp(numbers) + 1 == n and np.unique(numbers).size == numbers.size)


def _in_equal_steps(angles: NDArray[np.float64]) -> bool:
    """Whether no step is half as long again, or half as short, as the typical one."""
    steps = np.diff(angles)
    typical = float(np.median(steps))
    return bool((np.abs(steps - typical) < abs(typical) / 2).all())


def _misfit(source: ScanSource, angles: NDArray[np.float64], name: str, series: NDArray[np.int64] | None) -> str:
    key = source.image_key
    n = int((key == FrameKind.PROJECTION).sum())
    if angles.size < n:
        message = f"{name} has {angles.size} angles for {n} projections, so that {n - angles.size} have none"
    elif angles.size == key.size:
        message = (
            f"{name} has {angles.size} angles, one for each frame, and {source.path} does not say when its darks and "
            f"flats were taken"
        )
    else:
        message = f"{name} has {angles.size} angles, but there are {n} projections among {key.size} frames"
    if series is not None and (gaps := source.attributes.get("missing_numbers")):
        message += (
            f". The numbers of the files go from {series.min()} to {series.max()} and leave out {gaps}: of "
            f"{np.ptp(series) + 1} angles, one for each number, each image would get its own"
        )
    elif series is not None and n < angles.size != key.size:
        lost = angles.size - n
        message += (
            f". The numbers of the files go from {series.min()} to {series.max()} without a gap: of a series of "
            f"{angles.size}, the first {lost} or the last {lost} may be lost"
        )
    if angles.size < n:
        return f"{message}. Is it cut off, or of another scan? Give one angle for each projection, in their order."
    message += f". Say with --angle-rows A:B which {n} belong to the projections (from 0, B not included)"
    window = evenly_spaced_window(angles, n)
    if window is not None:
        low, high = np.degrees(angles[list(window)])
        message += (
            f"; --angle-rows {window[0]}:{window[1] + 1} takes the {n} neighbours in the most equal steps, "
            f"from {low:.4f} to {high:.4f} degrees"
        )
    return message + "."


def evenly_spaced_window(angles: NDArray[np.float64], n: int) -> tuple[int, int] | None:
    """First and last row of the n neighbouring rows with the most equal steps; None where that is no clear choice.

    A scan's angle log often holds the darks and flats as well, at a standing stage. If the steps go on beyond these
    rows, other rows would do as well: then views were lost, and nothing tells which.
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
    beside = np.concatenate((steps[first - 1 : first] if first else [], steps[first + n - 1 : first + n]))
    if (np.abs(beside - medians[first]) < np.abs(medians[first]) / 2).any():
        return None
    return first, first + n - 1
