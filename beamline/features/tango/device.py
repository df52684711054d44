"""The Tango device of a run (pytango), the run that it serves, and what clients may ask the scan for."""

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
from beamline.page.followed_run import PERIOD, FollowedRun, RunValues, Severity, StampedValues
from beamline.page.recording import Recording
from beamline.page.tiles import MOST, TileRegion
from beamline.scan.control import Asked, State, Verb, ask
from beamline.scan.runs import newest
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.run_record import DIED

Picture = NDArray[np.float32]
SHOWN = [each for each in fields(RunValues) if each.name not in ("data_rate", "residual", "skipped")]
"""The values of a run that are attributes of the device, by the names of the process variables (docs/page.md)."""
_RAISED = {"warnings": "ATTR_WARNING", "alarms": "ATTR_ALARM"}

_STATES: dict[str, str] = {
    **dict.fromkeys((State.FAILED, State.ABORTED, DIED), "FAULT"), State.PAUSED: "STANDBY", State.PREPARING: "INIT",
    **dict.fromkeys((State.IDLE, State.DONE, State.STOPPED), "ON"),
}  # fmt: skip


def device_state(values: RunValues) -> str:
    """The name of Tango's state: RUNNING, ALARM if the monitor has alarms, STANDBY while the scan is paused, ON when
    none runs, FAULT after one that failed.
    """
    return _STATES.get(values.state, "ALARM" if values.alarms else "RUNNING")


def quality(stamped: StampedValues, name: str) -> str:
    """The name of Tango's quality of a value: INVALID if it is unknown or old."""
    if stamped.stamp(name).severity is Severity.INVALID:
        return "ATTR_INVALID"
    return _RAISED[name] if name in _RAISED and getattr(stamped.values, name) else "ATTR_VALID"


class ServedRun:
    """The newest run of a folder, with its pictures and commands. Calls may come from any thread.

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
        """The current values."""
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
        """Send a command to the run. Returns at once; a later refusal is in `refused`.

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
        """The arguments in the form that a device server expects."""
        address = "" if self.address == "0.0.0.0" else self.address
        named = [] if self.instance else ["-nodb", "-dlist", self.device]
        return ["splatline", self.instance or "scan", *named, "-ORBendPoint", f"giop:tcp:{address}:{self.port}"]

    def __str__(self) -> str:
        if self.instance:
            return f"Devices of splatline/{self.instance} in the database, at {self.address}:{self.port}"
        return f"tango://{self.address}:{self.port}/{self.device}#dbase=no"


def device_class(run: ServedRun, control: bool) -> type[Any]:
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
            stamped = run.followed.stamped
            value = getattr(stamped.values, name)
            value = list(value) if isinstance(value, tuple) else value
            return value, stamped.stamp(name).time, getattr(AttrQuality, quality(stamped, name))

        return read

    def init_device(device: Any) -> None:
        Device.init_device(device)
        for name in ("State", "Status", *(each.metadata["name"] for each in SHOWN)):
            device.set_change_event(name, True, False)

    body: dict[str, Any] = {
        "__doc__": "The newest run of a folder.",
        "init_device": init_device,
        "dev_state": lambda device: getattr(DevState, device_state(run.followed.stamped.values)),
        "dev_status": lambda device: status_of(run),
    }
    for each in SHOWN:
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


def _picture_reader(run: ServedRun, taken: Callable[[], Picture]) -> Callable[[Any], tuple[Any, float, Any]]:
    """Reads a picture as an attribute; where there is no picture yet, its quality is invalid."""
    from tango import AttrQuality

    def read(device: Any) -> tuple[Any, float, Any]:
        try:
            return taken(), run.followed.stamped.stamp("stored").time, AttrQuality.ATTR_VALID
        except (DataError, NotReadyError, OSError):
            return np.zeros((1, 1), np.float32), run.followed.stamped.began, AttrQuality.ATTR_INVALID

    return read


def _sender(run: ServedRun, verb: Verb) -> Callable[[Any], None]:
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


def status_of(run: ServedRun) -> str:
    """The state and the last message of the scan, and why it refused the last command."""
    values = run.followed.stamped.values
    return one_line("; ".join(filter(None, (values.state, values.message, run.refused))), 1000)


def serve(runs: Path, place: ServerPlace, control: bool, say: Callable[[str], None], ready: Callable[[], None]) -> None:
    """Serve the newest run of a folder, and each one that begins later, until SIGINT or SIGTERM.

    Args:
        control: verbs are taken, from everybody who reaches the address.
        say: takes a line for each verb that is refused late.
        ready: is called when clients can connect.

    Raises:
        ConfigError: pytango is not installed.
        DataError: the address cannot be listened at, or the database does not answer.
    """
    with closing(ServedRun(runs, say)) as run:
        served = device_class(run, control)
        import tango
        from tango.server import run as run_server

        def look() -> bool:
            before, now = run.followed.stamped, run.look()
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


def push_changes(device: Any, before: StampedValues, now: StampedValues) -> None:
    """Notify clients that subscribed to changes of each value that was set again."""
    from tango import AttrQuality, DevState

    for each in SHOWN:
        name = each.name
        value, known = getattr(now.values, name), getattr(before.values, name)
        same = value == known or (value != value and known != known)  # NaN is not equal to itself
        at, how = now.stamp(name).time, quality(now, name)
        if same and (at, how) == (before.stamp(name).time, quality(before, name)):
            continue
        value = list(value) if isinstance(value, tuple) else value
        device.push_change_event(each.metadata["name"], value, at, getattr(AttrQuality, how))
    if (state := device_state(now.values)) != device_state(before.values):
        device.push_change_event("State", getattr(DevState, state), math.floor(time.time()),
                                 AttrQuality.ATTR_VALID)  # fmt: skip
