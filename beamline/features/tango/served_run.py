"""The newest run of a folder, as a Tango device needs it: state, qualities, pictures and verbs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, DataError, user_message
from beamline.page.followed_run import FollowedRun, RunValues, Severity, StampedValues
from beamline.page.recording import Recording
from beamline.page.tiles import TileRegion
from beamline.scan.control import Asked, Verb, ask
from beamline.scan.runs import DIED, newest
from beamline.scan.states import State

Picture = NDArray[np.float32]
SHOWN = [each for each in fields(RunValues) if each.name not in ("data_rate", "residual", "skipped")]
"""The values of a run that are attributes of the device, by the names of the process variables (docs/page.md)."""
_RAISED = {"warnings": "ATTR_WARNING", "alarms": "ATTR_ALARM"}


def device_state(values: RunValues) -> str:
    """The name of Tango's state: RUNNING, ALARM where the monitor has alarms, STANDBY while the scan is paused, ON when
    none runs, FAULT after one that ended badly."""
    if values.state in (State.FAILED, State.ABORTED, DIED):
        return "FAULT"
    if values.state == State.PAUSED:
        return "STANDBY"
    if values.state == State.PREPARING:
        return "INIT"
    if values.state in (State.IDLE, State.DONE, State.STOPPED):
        return "ON"
    return "ALARM" if values.alarms else "RUNNING"


def quality(stamped: StampedValues, name: str) -> str:
    """The name of Tango's quality of a value: INVALID where it is not known or old."""
    if stamped.stamp(name).severity is Severity.INVALID:
        return "ATTR_INVALID"
    return _RAISED[name] if name in _RAISED and getattr(stamped.values, name) else "ATTR_VALID"


class ServedRun:
    """The newest run of a folder, with its pictures and verbs. Calls may come from any thread.

    Args:
        say: takes a line for each verb that is refused late.
        now: a clock, s since the Unix epoch.
    """

    def __init__(self, runs: Path, say: Callable[[str], None], now: Callable[[], float] = time.time) -> None:
        self.followed, self._say = FollowedRun(runs, now), say
        self._lock = threading.Lock()
        self._asked: list[Asked] = []
        self.refused = ""  # why the scan did not do the last verb
        self.close = self.followed.close

    def look(self) -> StampedValues:
        """The values now."""
        with self._lock:
            self._look_at_verbs()
        return self.followed.look()

    def last_view(self) -> Picture:
        """[row, col] of the newest frame in the file: the share of the light that the sample lets through where there
        are darks and flats, else counts. Binned to 1024 pixels a side.

        Raises:
            DataError, NotReadyError: there is no frame.
        """
        return self.followed.reader().do(_newest_frame)

    def volume_slice(self) -> Picture:
        """[y, x] of the middle slice of the run's newest volume, in its unit. Binned to 1024 pixels a side.

        Raises:
            DataError: there is no volume.
        """
        everything = TileRegion(0, 2**31, 0, 2**31)
        return self.followed.reader().on_volumes(
            lambda shown: np.asarray(shown[0].cut(0, shown[0].shape[0] // 2, everything).values, np.float32)
        )

    def ask(self, verb: Verb) -> None:
        """Send a verb to the run. Returns at once; a refusal that comes later is in `refused`.

        Raises:
            BeamlineError: no scan runs there, or the request cannot be made.
        """
        with self._lock:
            self._asked.append(ask(newest(self.followed.runs), verb))
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


def _newest_frame(recording: Recording) -> Picture:
    frames = recording.progress().frames
    if not frames:
        raise DataError("There is no frame in the file yet.")
    whole = TileRegion(0, *recording.shape[:1], 0, *recording.shape[1:])
    return recording.picture(frames - 1, whole, corrected=True)[0]
