"""Reads the frames of a file in the form in which the monitor gets them from a camera. The file may still be growing.
Also collects the facts about the scan that the checks need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.monitor.check import ScanContext
from beamline.monitor.digest import check_block, digest
from beamline.monitor.evidence import full_scale
from beamline.monitor.watch import usual_step
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.interrupted import next_step
from beamline.storage.readers.averaged import stated_frames_per_view
from beamline.storage.readers.base import ScanSource, read_known
from beamline.storage.rules.angles import FARTHEST
from beamline.storage.writer_lock import PATIENCE, WriterWatch
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from recon.base.views import spread

BEAM = 50_000.0  # counts that stand for a transmission of 1 if a file contains line integrals
SAMPLES = 4  # frames of each kind in which the saturation level of the detector is searched for
# if at least this fraction of the pixels has the largest count, this count is the end of the detector's range
PILED_UP = 1e-3
POLL = 0.1  # s between two looks at a growing file


def frames_of(
    source: ScanSource, *, follow: Clock | None = None, should_stop: Callable[[], bool] = lambda: False
) -> Iterator[tuple[Frame, int]]:
    """Yields every frame in the order of the file, and the number of frames in the file so far. Arguments and errors
    are those of `replay`.

    If a projection was taken again later, the first attempt has the kind that it had when it arrived.
    """
    done = 0
    for n in growing(source, follow) if follow is not None else (source.refresh(),):
        retaken = frozenset(source.table.replaced.tolist())
        for frame in _frames(source, done):
            if should_stop():
                return
            if frame.index in retaken:  # as the monitor saw the frame, before the frame was taken again
                frame = replace(frame, kind=FrameKind.PROJECTION)
            yield frame, n
        done = n


def awaited(
    opened: Callable[[], ScanSource], path: Path, clock: Clock, patience: float = PATIENCE, poll: float = POLL
) -> ScanSource:
    """The scan that begins at `path`, as soon as its file can be read.

    Raises:
        DataError: no scan begins within `patience` s.
    """
    last = clock.now() + patience
    while True:
        try:
            return opened()
        except NotReadyError as error:
            if clock.now() > last:
                raise DataError(f"No scan began in {path} within {patience:.0f} s.") from error
            clock.sleep(poll)


def growing(source: ScanSource, clock: Clock, patience: float = PATIENCE, poll: float = POLL) -> Iterator[int]:
    """Yields the number of frames in a file at each look, until the file is finished.

    Raises:
        DataError: the file stopped growing before it was finished.
    """
    writer, n, ended = WriterWatch(source.path, clock.now(), patience), 0, False
    while not ended:
        ended = source.finished  # read before the number of frames, so that no frame can arrive in between
        before, n = n, source.refresh()
        yield n
        if not ended and (reason := writer.lost(clock.now(), n > before, lambda: source.finished)):
            raise DataError(f"{source.path} {reason} and is not finished; it has {n} frames. {next_step(source.path)}")
        if not ended:
            clock.sleep(poll)


def context_of(source: ScanSource) -> ScanContext:
    """The facts about a file that the checks need before its first frame.

    The period is known only for fly scans that this program took.
    """
    rows, cols = source.shape
    fly = source.plan.get("mode") == "fly"
    period = (float(source.attributes.get("period_s", 0)) or None) if fly else None
    context = ScanContext(
        _saturation(source), rows * cols, period, _step(source), stated_frames_per_view(source),
        cone=source.cone is not None, axis_col=source.axis_col,
    )  # fmt: skip
    if source.quantity != "line_integrals":
        return context
    preview = digest(np.zeros(source.shape, np.uint16), preview_bin=check_block(source.shape)).preview
    return replace(context, dark=preview, flat=preview + np.float32(BEAM), flat_exposure=1.0, integrals=True)


def _step(source: ScanSource) -> float:
    """Angle in radians between two projections, from the plan if this program took the scan, otherwise from the angles
    in the file.
    """
    planned = source.plan.get("angles_deg")
    if isinstance(planned, list) and all(isinstance(angle, int | float) for angle in planned):
        return usual_step(np.radians(planned[:: stated_frames_per_view(source)]))
    return usual_step(source.table.angles[source.table.views])


def _saturation(source: ScanSource) -> float:
    """The saturation level that the file states. Otherwise the largest value of the pixels' type, or of fewer bits if
    many pixels have the largest count. Inf if the pixels are real numbers.
    """
    if source.quantity == "line_integrals" or source.dtype.kind not in "ui":
        return np.inf
    stated = float(source.attributes.get("saturation", 0))
    if 0 < stated <= np.iinfo(source.dtype).max:
        return stated
    for kind in (FrameKind.FLAT, FrameKind.PROJECTION):
        rows = source.table.of_kind(kind)
        for row in spread(rows, SAMPLES):
            image = read_known(source, [int(row)])[0]
            largest = float(image.max())
            if largest == full_scale(largest) and (image == image.max()).mean() > PILED_UP:
                return largest
    return float(np.iinfo(source.dtype).max)


def _frames(source: ScanSource, first: int) -> Iterator[Frame]:
    """Yields the frames from `first` on. Counts are unchanged; line integrals become counts of a beam. An angle that no
    stage reaches becomes NaN. An unknown exposure becomes 1 s, so that projections and flats agree.
    """
    for frame in source.frames(first):
        pixels: NDArray[Any] = frame.counts
        if source.quantity == "line_integrals":
            with np.errstate(over="ignore"):
                pixels = np.nan_to_num(BEAM * np.exp(-pixels.astype(np.float64)), posinf=65535).clip(0, 65535)
            pixels = pixels.round().astype(np.uint16)
        elif (kernel := _type_of_kernels(pixels.dtype)) != pixels.dtype:
            pixels = pixels.astype(kernel)
        angle = frame.angle if abs(frame.angle) <= math.radians(FARTHEST) else math.nan
        yield replace(frame, counts=pixels, angle=angle, exposure=frame.exposure if frame.exposure > 0 else 1.0)


def _type_of_kernels(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The type to which pixels are converted for compiled kernels. These support neither foreign byte orders nor floats
    of 16 bits or of more than 64 bits.
    """
    if dtype.kind == "f" and dtype.itemsize not in (4, 8):
        return np.dtype(np.float32 if dtype.itemsize == 2 else np.float64)
    return dtype.newbyteorder("=")
