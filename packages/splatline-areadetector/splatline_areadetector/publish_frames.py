"""RunFrames: the frames of the newest run of a folder, each once and in order, as they are written to its scan file.

They are read from the scan file, so the scan never waits for a client.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import parts_of
from beamline.scan.runs import newest
from beamline.storage.hdf5 import readable
from beamline.storage.scan_file import ScanFile, opened
from beamline.storage.writers.layout import ANGLE, COUNT_TIME, KIND, TIME
from drivers.base.frame import FrameKind

LOOK_EVERY = 0.5  # s between two checks for a new run
_SPREAD = 0.7  # frames that came together are sent this fraction of the mean time between frames apart
_WINDOW = 2.0  # s over which the mean is computed
_LONGEST, _AT_FIRST = 0.25, 0.02  # s: longest time between two frames sent, and this time while the mean is not known

LOCATIONS = {
    FrameKind.PROJECTION: "/exchange/data",
    FrameKind.FLAT: "/exchange/data_white",
    FrameKind.DARK: "/exchange/data_dark",
}
"""Kinds of frames as tomoscan (APS) writes them into the attribute HDF5FrameLocation."""


@dataclass(frozen=True, eq=False)
class PublishedFrame:
    """A frame of a scan, as it is published.

    Attributes:
        counts: [row, col].
        unique_id: row in the scan file, from 1; each run begins again at 1.
        angle: stage angle at the trigger in degrees, from the scan file; NaN: unknown.
        time: s since the Unix epoch, at the trigger.
        exposure: s.
    """

    counts: NDArray[Any]
    unique_id: int
    kind: FrameKind
    angle: float
    time: float
    exposure: float

    @property
    def attributes(self) -> dict[str, Any]:
        """The NDAttributes of the frame by their names."""
        return {
            "ColorMode": 0,
            "Angle": self.angle,
            "Kind": self.kind.name.lower(),
            "HDF5FrameLocation": LOCATIONS.get(self.kind, ""),
            "AcquireTime": self.exposure,
        }


class SendRate:
    """Spreads in time frames that came into the file together, because the queue of a client usually has space for only
    four frames."""

    def __init__(self) -> None:
        self._came, self._sent = deque[tuple[float, int]](), -math.inf  # times and frames

    def came(self, n: int, now: float) -> None:
        """n frames came into the file by this time (s)."""
        self._came.append((now, n))
        while self._came[0][0] < now - _WINDOW:
            self._came.popleft()

    def wait(self, now: float) -> float:
        """s for which the next frame must still wait."""
        n = sum(n for _, n in self._came) - self._came[0][1] if self._came else 0
        apart = _SPREAD * (now - self._came[0][0]) / n if n else _AT_FIRST
        return max(0.0, self._sent + min(apart, _LONGEST) - now)

    def sent(self, now: float) -> None:
        """A frame was sent at this time (s)."""
        self._sent = now


class RunFrames:
    """The frames of the newest run of a folder from now on. If a newer run begins, its frames follow.

    If a run exists at the start, its newest frame comes first. Call it from one thread only.

    Args:
        say: prints a sentence about a file that cannot be read.
        now: a clock, s.

    Attributes:
        run: folder of the run (or of the part of the run) whose frames are returned; None: there is no run yet. shape:
            rows and columns of its frames; (0, 0) before the first run. dtype: type of the pixels.
    """

    def __init__(self, runs: Path, say: Callable[[str], None], now: Callable[[], float] = time.monotonic) -> None:
        self._runs, self._say, self._now = runs, say, now
        self.run: Path | None = None
        self.shape, self.dtype = (0, 0), np.dtype(np.uint16)
        self._file: ScanFile | None = None
        self._pace, self._looked = SendRate(), -math.inf
        self._next = self._committed = 0
        self._look()
        if self._file is not None:
            self._next = max(0, self._file.committed() - 1)

    @property
    def waiting(self) -> int:
        """Number of frames in the file that `next` has not returned yet."""
        return self._committed - self._next

    def next(self) -> PublishedFrame | None:
        """The next frame that is due; None if no frame is due yet."""
        now = self._now()
        if now - self._looked >= LOOK_EVERY and not self.waiting:
            self._look()
        if self._file is None or self.run is None:
            return None
        try:
            with readable(self.run):
                if (committed := self._file.committed()) > self._committed:
                    self._pace.came(committed - self._committed, now)
                    self._committed = committed
                if not self.waiting or self._pace.wait(now):
                    return None
                frame = _read(self._file, self._next)
        except DataError as error:
            self._say(f"Publishing of this run has ended: {error}")
            self.close()
            return None
        self._next += 1
        self._pace.sent(now)
        return frame

    def close(self) -> None:
        """Close the file. A second time does nothing."""
        file, self._file = self._file, None
        if file is not None:
            file.close()
        self._committed = self._next

    def _look(self) -> None:
        """Open the file of the newest run, if it is another one."""
        self._looked = self._now()
        with suppress(ConfigError, DataError):  # no run, or a file that is just being created
            run = parts_of(newest(self._runs))[-1]
            if run == self.run:
                return
            file = opened(run / "scan.h5", follow=True)
            if file is None:
                return
            self.close()
            self._file, self.run, self.shape, self.dtype = file, run, file.shape, file.dtype
            self._next = self._committed = 0


def _read(file: ScanFile, row: int) -> PublishedFrame:
    kind, angle, exposed_at, exposure = (file.values(path, row) for path in (KIND, ANGLE, TIME, COUNT_TIME))
    return PublishedFrame(
        file.data[row], row + 1, FrameKind(int(kind)), float(angle), float(exposed_at), float(exposure)
    )
