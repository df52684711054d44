"""The tilt of the axis: found where that is asked for, warned of where nobody said what it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.sinks import Warn
from beamline.projections.correction import ScanCorrection, at_once_memory
from beamline.projections.corrections.counts import CountModel
from beamline.projections.corrections.phase import Phase
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.selection import Selection, cone_of
from beamline.storage.readers.base import ScanSource
from drivers.base.frame import FrameKind
from recon.prep.tilt import FEWEST_BANDS, STEEPEST, TiltEstimate, find_tilt

_BANDS, _BAND_ROWS, _VIEWS = 16, 4, 240
_LOOK_BANDS, _LOOK_ROWS, _LOOK_VIEWS = 8, 2, 90  # for a warning, by views as they are
_FEWEST_ROWS = 32  # that are looked at for a warning: half a pixel over fewer is no tilt of a stage
_MATTERS = 0.5  # px over the rows
_NOTHING = 0.05  # px over the rows, not worth new pixels
_SURE = 3.0  # standard deviations from which on a tilt is one
_ROUNDS = 5
_COPIES = 20  # float32 copies of all bands while their axes are found
BandsDone = Callable[[int, int], None]  # (n, N): so many are done, of so many


def with_tilt(
    source: ScanSource, selection: Selection, frames: NDArray[np.int64], warn: Warn, progress: BandsDone
) -> tuple[Selection, str]:
    """The selection with its tilt found, if it wants that, by all rows of the detector; and a sentence about it,
    empty where nothing was sought.

    Args:
        frames: views that may be used.
        progress: takes how many bands of rows were corrected, and how many there are at most.

    Raises:
        ConfigError: a cone.
        DataError: the views do not tell it.
    """
    step = selection.step(TiltAndLens)
    step.of(source, selection)  # refuses a cone
    if not step.sought:
        return selection, ""
    rows, frames = source.shape[0] // selection.binning, spread_views(source.angles[frames], _VIEWS, frames)
    try:
        tilt, uncertainty = _refined(source, replace(selection, rows=None), frames, progress)
    except ValueError as error:
        raise DataError(
            f"{source.path}: the tilt of the axis was not found: {error}. Give it with --tilt DEGREES, or leave it out."
        ) from error
    if abs(tilt) > STEEPEST:
        raise DataError(
            f"{source.path}: the axis seems to lean by {math.degrees(tilt):.1f} degrees, more than the "
            f"{math.degrees(STEEPEST):g} that are looked for. Look at the views; give the tilt with --tilt DEGREES."
        )
    said = f"The axis leans by {_text(tilt, uncertainty)}, {abs(tilt) * rows:.2g} px over {rows} rows"
    if uncertainty * rows > _MATTERS:
        warn(f"{said}: this is not sure to half a pixel. Check the first and the last slices for doubled edges.")
    if abs(tilt) < 2 * uncertainty or abs(tilt) * rows < _NOTHING:
        return selection.with_steps(replace(step, tilt=0.0)), f"{said}: not corrected."
    return selection.with_steps(replace(step, tilt=math.degrees(tilt))), f"{said}; views are turned."


def search_memory(source: ScanSource, selection: Selection) -> int:
    """Bytes that `with_tilt` takes at most, if it is to find the tilt."""
    step, frames = selection.step(TiltAndLens), int((source.image_key == FrameKind.PROJECTION).sum())
    steepest = replace(_plain(selection), rows=None).with_steps(replace(step, tilt=math.degrees(STEEPEST)))
    n, cols = min(frames, _VIEWS), source.shape[1] // selection.binning
    rows = source.shape[0] // selection.binning
    middle = max(0, rows // 2 - _BAND_ROWS)
    band = at_once_memory(source, steepest, n, slice(middle, min(rows, middle + _BAND_ROWS)))
    return 4 * n * _BANDS * cols + max(band, _COPIES * 4 * n * _BANDS * cols)


def warn_of_tilt(
    source: ScanSource,
    selection: Selection,
    correction: ScanCorrection,
    frames: NDArray[np.int64],
    warn: Warn,
    progress: BandsDone,
) -> None:
    """Warn where the rows chosen show a tilt that matters, and nobody said what it is; `progress` as in `with_tilt`."""
    rows = (correction.rows.stop - correction.rows.start) // correction.binning
    if selection.step(TiltAndLens).tilt is not None or cone_of(source, selection) is not None or rows < _FEWEST_ROWS:
        return
    frames = spread_views(source.angles[frames], _LOOK_VIEWS, frames)
    try:
        found = _look(source, correction, frames, (_LOOK_BANDS, _LOOK_ROWS), progress)
    except (ValueError, DataError):
        return  # nothing is known, and nothing was asked
    if abs(found.tilt) * rows > _MATTERS and abs(found.tilt) > _SURE * found.uncertainty:
        warn(
            f"The rotation axis seems to lean by {_text(found.tilt, found.uncertainty)} in the detector's plane, "
            f"{abs(found.tilt) * rows:.1f} px over {rows} rows: edges double in the first and last slices. "
            "Give --tilt auto, or --tilt 0 if it is straight."
        )


def spread_views(angles: NDArray[np.float64], n: int, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most `n` of the frames, evenly spread; of a full turn half as many, and with each the one opposite to it."""
    every = np.arange(angles.size)
    if angles.size <= n:
        return frames
    if np.ptp(angles) < 1.5 * np.pi:
        return frames[spread(every, n)]
    some = spread(every, n // 2)
    away = np.abs(np.mod(angles[some][:, None] - angles + np.pi, 2 * np.pi) - np.pi)
    return frames[np.union1d(some, away.argmax(axis=1))]


def spread(items: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most `n` of the items, evenly spread, with the first and the last."""
    if items.size <= n:
        return items
    return items[np.unique(np.linspace(0, items.size - 1, n).round().astype(np.int64))]


def _refined(
    source: ScanSource, selection: Selection, frames: NDArray[np.int64], progress: BandsDone
) -> tuple[float, float]:
    """The tilt by views that were levelled by what is known of it, and its uncertainty; radians.

    Raises:
        ValueError: see `find_tilt`.
    """
    plain, step = _plain(selection), selection.step(TiltAndLens)
    rows = (source.shape[0] if selection.rows is None else np.ptp(selection.rows)) / selection.binning
    tilt = 0.0
    for n in range(_ROUNDS):
        levelled = ScanCorrection(source, plain.with_steps(replace(step, tilt=math.degrees(tilt))), lambda _: None)
        found = _look(source, levelled, frames, (_BANDS, _BAND_ROWS), _after(n * _BANDS, _ROUNDS * _BANDS, progress))
        tilt += found.tilt
        if abs(found.tilt) < found.uncertainty / 4 or abs(found.tilt) * rows < _NOTHING / 2:
            break
    return tilt, found.uncertainty


def _plain(selection: Selection) -> Selection:
    """Without what blurs the views."""
    return selection.with_steps(Phase(), CountModel("log"))


def _after(before: int, total: int, progress: BandsDone) -> BandsDone:
    """For a part of the work, before which so much was done."""
    return lambda n, _: progress(before + n, total)


def _look(
    source: ScanSource,
    correction: ScanCorrection,
    frames: NDArray[np.int64],
    size: tuple[int, int],
    progress: BandsDone,
) -> TiltEstimate:
    """The tilt that is left in corrected views, by bands that can be corrected; `size`: bands, and rows of one.

    Raises:
        ValueError: see `find_tilt`.
    """
    rows = (correction.rows.stop - correction.rows.start) // correction.binning
    bands, thick = size
    height = max(1, min(thick, rows // bands))
    means: list[NDArray[np.float32]] = []
    heights, ids = [], np.empty(0, np.int64)
    for n, first in enumerate(np.unique(np.linspace(0, rows - height, min(bands, rows)).round().astype(int)).tolist()):
        progress(n, bands)
        try:
            band = correction.at_once(frames, slice(first, first + height))
        except DataError:
            continue  # no light there
        if not means:
            ids = band.view_ids
        if np.array_equal(band.view_ids, ids):
            means.append(band.data.mean(axis=1))
            heights.append(first + (height - 1) / 2)
    progress(bands, bands)
    if len(means) < FEWEST_BANDS:
        raise ValueError(f"{len(means)} bands of rows, {FEWEST_BANDS} are needed")
    return find_tilt(np.stack(means, axis=1), np.array(heights) - np.mean(heights), source.angles[ids])


def _text(tilt: float, uncertainty: float) -> str:
    """Degrees with their uncertainty, as many digits as that has."""
    sigma = math.degrees(uncertainty)
    digits = min(max(1 - math.floor(math.log10(max(sigma, 1e-4))), 2), 4)
    return f"{math.degrees(tilt):.{digits}f} ± {sigma:.{digits}f} degrees"
