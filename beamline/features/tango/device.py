"""The Tango device of a run (pytango), its server, and what clients may ask the scan for."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import BeamlineError, ConfigError, DataError, user_message
from beamline.core.text import one_line
from beamline.features.tango.values import ScanAttributes, TimedAttributes
from beamline.page.recording import Recording
from beamline.page.run_files import Reader, watched
from beamline.page.tiles import MOST, TileRegion
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


PERIOD = 0.5  # s between two looks at the run
_CLASS = "SplatlineScan"
_CHECKS = 64  # of the monitor, at most
_TYPES: dict[str, dict[str, Any]] = {
    "str": {"dtype": str},
    "int": {"dtype": int},
    "float": {"dtype": float},
    "tuple[str, ...]": {"dtype": (str,), "max_dim_x": _CHECKS},
    "tuple[int, ...]": {"dtype": (int,), "max_dim_x": _CHECKS},
}


@dataclass(frozen=True)
class ServerPlace:
    """Where a device is served.

    Attributes:
        address, port: to listen at.
        device: its name, without a database.
        instance: of the server `splatline` in the database, which names the device; None: without a database.
    """

    address: str
    port: int
    device: str
    instance: str | None = None

    @property
    def arguments(self) -> list[str]:
        """As a device server takes them."""
        address = "" if self.address == "0.0.0.0" else self.address
        named = [] if self.instance else ["-nodb", "-dlist", self.device]
        return ["splatline", self.instance or "scan", *named, "-ORBendPoint", f"giop:tcp:{address}:{self.port}"]

    def __str__(self) -> str:
        if self.instance:
            return f"Devices of splatline/{self.instance} in the database, at {self.address}:{self.port}"
        return f"tango://{self.address}:{self.port}/{self.device}#dbase=no"


def device_class(run: FollowedRun, control: bool) -> type[Any]:
    """The class of the device.

    Args:
        control: verbs are commands of it.

    Raises:
        ConfigError: pytango is not installed.
    """
    try:
        from tango import AttrQuality, DevState
        from tango.server import Device, attribute, command
    except ImportError as error:
        raise ConfigError(
            'Tango needs the library pytango: pip install "splatline[tango]". Nothing was started.'
        ) from error

    def reader(name: str) -> Callable[[Any], tuple[Any, float, Any]]:
        def read(device: Any) -> tuple[Any, float, Any]:
            timed = run.timed
            value = getattr(timed.values, name)
            value = list(value) if isinstance(value, tuple) else value
            return value, timed.time(name), getattr(AttrQuality, timed.quality(name))

        return read

    def init_device(device: Any) -> None:
        Device.init_device(device)
        for name in ("State", "Status", *(each.metadata["name"] for each in fields(ScanAttributes))):
            device.set_change_event(name, True, False)

    body: dict[str, Any] = {
        "__doc__": "The newest run of a folder.",
        "init_device": init_device,
        "dev_state": lambda device: getattr(DevState, run.timed.values.device_state),
        "dev_status": lambda device: status_of(run),
    }
    for each in fields(ScanAttributes):
        facts = {"doc": each.metadata["about"], "unit": each.metadata["unit"], **_TYPES[str(each.type)]}
        body[each.metadata["name"]] = attribute(fget=reader(each.name), **facts)
    for name, taken, about in (
        ("LastView", run.last_view, "the newest frame: share of the light, or counts without references"),
        ("Slice", run.volume_slice, "the middle slice of the newest volume"),
    ):
        body[name] = attribute(
            fget=_picture_reader(run, taken),
            dtype=((np.float32,),),
            max_dim_x=MOST,
            max_dim_y=MOST,
            doc=f"{about}, binned",
        )
    for verb in Verb if control else ():
        body[verb.value.capitalize()] = command(_sender(run, verb))
    return type(_CLASS, (Device,), body)


def _picture_reader(run: FollowedRun, taken: Callable[[], Picture]) -> Callable[[Any], tuple[Any, float, Any]]:
    """Reads a picture as an attribute; where there is no picture yet, its quality is invalid."""
    from tango import AttrQuality

    def read(device: Any) -> tuple[Any, float, Any]:
        try:
            return taken(), run.timed.time("stored"), AttrQuality.ATTR_VALID
        except (DataError, NotReadyError, OSError):
            return np.zeros((1, 1), np.float32), run.timed.began, AttrQuality.ATTR_INVALID

    return read


def _sender(run: FollowedRun, verb: Verb) -> Callable[[Any], None]:
    """The command of the device that sends a verb to the run."""
    from tango import Except

    def send(device: Any) -> None:
        try:
            run.ask(verb)
        except (BeamlineError, OSError) as error:
            Except.throw_exception("SplatlineRefused", user_message(error), f"{_CLASS}.{verb.value.capitalize()}")

    send.__name__ = verb.value.capitalize()
    send.__doc__ = f"What `beamline {verb}` does. Returns at once; the state tells when it is done."
    return send


def status_of(run: FollowedRun) -> str:
    """The state and the last message of the scan, and why it did not do the last verb."""
    values = run.timed.values
    return one_line("; ".join(filter(None, (values.state, values.message, run.refused))), 1000)


def serve(runs: Path, place: ServerPlace, control: bool, say: Callable[[str], None], ready: Callable[[], None]) -> None:
    """Serve the newest run of a folder, also one that begins later, until SIGINT or SIGTERM.

    Args:
        control: verbs are taken, from everybody who reaches the address.
        say: takes a line for each verb that is refused late.
        ready: is called when clients can connect.

    Raises:
        ConfigError: pytango is not installed.
        DataError: the address cannot be listened at, or the database does not answer.
    """
    with closing(FollowedRun(runs, say)) as run:
        served = device_class(run, control)
        import tango
        from tango.server import run as run_server

        def look() -> bool:
            before, now = run.timed, run.look()
            for device in tango.Util.instance().get_device_list_by_class(_CLASS):
                with tango.AutoTangoMonitor(device):
                    push_changes(device, before, now)
            time.sleep(PERIOD)
            return False

        started = False

        def start() -> None:
            nonlocal started
            started = True
            ready()

        run.look()
        try:
            run_server([served], args=place.arguments, event_loop=look, post_init_callback=start, raises=True,
                       verbose=False)  # fmt: skip
        except (tango.DevFailed, RuntimeError) as error:  # RuntimeError: of omniORB, where another one has the port
            if started:
                raise
            why = error.args[0].desc if isinstance(error, tango.DevFailed) else "the port is taken, or not this host's"
            raise DataError(f"{place} cannot be served: {one_line(why, 300)}. Nothing was started.") from error


def push_changes(device: Any, before: Any, now: Any) -> None:
    """Tell clients that wait for changes of each value that was set again."""
    from tango import AttrQuality, DevState

    for each in fields(ScanAttributes):
        name = each.name
        value, known = getattr(now.values, name), getattr(before.values, name)
        same = value == known or (value != value and known != known)  # NaN is not equal to itself
        if same and now.time(name) == before.time(name) and now.quality(name) == before.quality(name):
            continue
        quality = getattr(AttrQuality, now.quality(name))
        value = list(value) if isinstance(value, tuple) else value
        device.push_change_event(each.metadata["name"], value, now.time(name), quality)
    if now.values.device_state != before.values.device_state:
        device.push_change_event("State", getattr(DevState, now.values.device_state), math.floor(time.time()),
                                 AttrQuality.ATTR_VALID)  # fmt: skip
