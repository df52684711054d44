"""The newest run of a folder, as a Tango device needs it: values, pictures and verbs."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.features.tango.values import ScanAttributes, TimedAttributes
from beamline.page.recording import Recording
from beamline.page.run_files import Reader, watched
from beamline.page.tiles import TileRegion
from beamline.scan.control import Asked, Verb, ask
from beamline.scan.runs import newest
from beamline.storage.hdf5 import NotReadyError

Picture = NDArray[np.float32]
_NO_RUN = "There is no run so far."


class FollowedRun:
    """The newest run of a folder, also one that begins later. Calls may come from any thread.

    Args:
        say: takes a line for each verb.
        now: a clock, s since the Unix epoch.
    """

    def __init__(self, runs: Path, say: Callable[[str], None], now: Callable[[], float] = time.time) -> None:
        self._runs, self._say, self._now = runs, say, now
        self._lock = threading.Lock()
        self._reader: Reader | None = None
        self._lines = 0
        self._asked: list[Asked] = []
        self.timed = TimedAttributes(ScanAttributes(), now())
        self.refused = ""  # why the scan did not do the last verb

    def close(self) -> None:
        with self._lock:
            if self._reader is not None:
                self._reader.close()
                self._reader = None

    def look(self) -> TimedAttributes:
        """The values now."""
        with self._lock:
            self._look_at_verbs()
            self.timed = self._read()
            return self.timed

    def last_view(self) -> Picture:
        """[row, col] of the newest frame in the file: the share of the light that the sample lets through where there
        are darks and flats, else counts. Binned to 1024 pixels a side.

        Raises:
            DataError, NotReadyError: there is no frame.
        """
        with self._lock:
            return self._opened().do(_newest_frame)

    def volume_slice(self) -> Picture:
        """[y, x] of the middle slice of the run's newest volume, in its unit. Binned to 1024 pixels a side.

        Raises:
            DataError: there is no volume.
        """
        everything = TileRegion(0, 2**31, 0, 2**31)
        with self._lock:
            return self._opened().on_volumes(
                lambda shown: np.asarray(shown[0].cut(0, shown[0].shape[0] // 2, everything).values, np.float32)
            )

    def ask(self, verb: Verb) -> None:
        """Send a verb to the run. Returns at once; a refusal that comes later is in `refused`.

        Raises:
            BeamlineError: no scan runs there, or the request cannot be made.
        """
        with self._lock:
            self._asked.append(ask(newest(self._runs), verb))
            self.refused = ""

    def _look_at_verbs(self) -> None:
        for asked in list(self._asked):
            try:
                if asked.state() is None:
                    continue
            except (BeamlineError, OSError) as error:
                self.refused = f"{asked.verb}: {user_message(error)}"
                self._say(self.refused)
            self._asked.remove(asked)

    def _opened(self) -> Reader:
        if self._reader is None:
            raise DataError(_NO_RUN)
        return self._reader

    def _read(self) -> TimedAttributes:
        try:
            what = watched(newest(self._runs))
        except (ConfigError, DataError):
            return self.timed  # no run so far
        timed = self.timed
        if self._reader is None or self._reader.what != what:
            if self._reader is not None:
                self._reader.close()
            self._reader, self._lines = Reader(what), 0
            timed = TimedAttributes(ScanAttributes(), self._now())
        seen, angle = None, math.nan
        try:
            seen = self._reader.state()
            if seen["frames"]:
                angle = self._reader.do(_newest_angle)
        except (DataError, NotReadyError, OSError):
            pass
        lines = self._reader.events.lines
        timed, self._lines = timed.after(lines[self._lines :]), len(lines)
        if seen is None:
            return TimedAttributes(timed.values, timed.began, timed.times, unread=True)
        return timed.with_file(seen, angle, self._now())


def _newest_angle(recording: Recording) -> float:
    """Degrees."""
    angles = recording.columns(max(recording.progress().frames - 1, 0))["angle"]
    return math.nan if not angles or angles[-1] is None else float(angles[-1])


def _newest_frame(recording: Recording) -> Picture:
    frames = recording.progress().frames
    if not frames:
        raise DataError("There is no frame in the file yet.")
    whole = TileRegion(0, *recording.shape[:1], 0, *recording.shape[1:])
    return recording.picture(frames - 1, whole, corrected=True)[0]
