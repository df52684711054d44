"""The Tango device of a run, with the commands by which clients control the scan."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import tango
from tango.server import Device, attribute, command
from tango.server import run as run_server

from beamline.core.errors import BeamlineError, DataError, user_message
from beamline.page.followed_run import PERIOD, FollowedRun, RunValues, Severity, StampedValues, choice_of
from beamline.plan.passes import Choice
from beamline.scan.control import State, Verb, ask
from beamline.scan.runs import newest

ATTRIBUTES = [each for each in fields(RunValues) if each.name not in ("data_rate", "residual", "skipped")]
"""The values of a run that are attributes of the device. `metadata` has their names, meanings and units."""
_CLASS = "SplatlineScan"
_CHECKS = 64  # largest number of checks of the monitor, or of options for the next pass
_TYPES: dict[str, dict[str, Any]] = {
    "str": {"dtype": str},
    "int": {"dtype": int},
    "float": {"dtype": float},
    "tuple[str, ...]": {"dtype": (str,), "max_dim_x": _CHECKS},
    "tuple[int, ...]": {"dtype": (int,), "max_dim_x": _CHECKS},
    "tuple[float, ...]": {"dtype": (float,), "max_dim_x": _CHECKS},
}
_RAISED = {"warnings": tango.AttrQuality.ATTR_WARNING, "alarms": tango.AttrQuality.ATTR_ALARM}
_STATES: dict[str, str] = {
    **dict.fromkeys((State.FAILED, State.ABORTED, "died"), "FAULT"), State.PREPARING: "INIT",
    **dict.fromkeys((State.PAUSED, State.ASKING), "STANDBY"),
    **dict.fromkeys((State.IDLE, State.DONE, State.STOPPED), "ON"),
}  # fmt: skip


def device_state(values: RunValues) -> tango.DevState:
    """State of the device. RUNNING: a scan is running. ALARM: the monitor has alarms. STANDBY: the scan is paused or
    waits for a decision. ON: no scan is running. FAULT: the last scan failed.
    """
    return getattr(tango.DevState, _STATES.get(values.state, "ALARM" if values.alarms else "RUNNING"))


def reading(stamped: StampedValues, name: str) -> tuple[Any, float, tango.AttrQuality]:
    """A value, its time in s since the Unix epoch, and its quality: INVALID if the value is unknown or old."""
    value, stamp = getattr(stamped.values, name), stamped.stamp(name)
    quality = _RAISED.get(name, tango.AttrQuality.ATTR_VALID) if value else tango.AttrQuality.ATTR_VALID
    if stamp.severity is Severity.INVALID:
        quality = tango.AttrQuality.ATTR_INVALID
    shown = [latin(each) for each in value] if isinstance(value, tuple) else latin(value)
    return shown, stamp.time, quality


def latin(value: Any) -> Any:
    """A text with "?" for each character that is not Latin-1, as Tango needs it; any other value unchanged."""
    return value.encode("latin-1", "replace").decode("latin-1") if isinstance(value, str) else value


@dataclass(frozen=True)
class ServerPlace:
    """The address and the name of a served device.

    Attributes:
        address, port: where clients connect.
        device: name of the device, without a database.
        instance: instance of the server `splatline` in the database, which names the device; None: no database.
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


def device_class(run: FollowedRun, control: bool) -> type[Any]:
    """The class of the device.

    Args:
        control: clients can send commands to the scan.
    """

    def reader(name: str) -> Callable[[Any], tuple[Any, float, Any]]:
        return lambda device: reading(run.stamped, name)

    def init_device(device: Any) -> None:
        Device.init_device(device)
        for name in ("State", *(each.metadata["name"] for each in ATTRIBUTES)):
            device.set_change_event(name, True, False)

    body: dict[str, Any] = {
        "__doc__": "The newest run of a folder.",
        "init_device": init_device,
        "dev_state": lambda device: device_state(run.stamped.values),
        "dev_status": lambda device: latin(f"{run.stamped.values.state}; {run.stamped.values.message}"),
    }
    for each in ATTRIBUTES:
        facts = {"doc": each.metadata["about"], "unit": each.metadata["unit"], **_TYPES[str(each.type)]}
        body[each.metadata["name"]] = attribute(fget=reader(each.name), **facts)
    for verb in Verb if control else ():
        body[verb.value.capitalize()] = command(_sender(run, verb))
    if control:
        body["Decide"] = command(_decider(run), dtype_in=str, doc_in="one of Options")
    return type(_CLASS, (Device,), body)


def _sender(run: FollowedRun, verb: Verb) -> Callable[[Any], None]:
    """The command of the device that sends a command to the run, and returns at once."""

    def send(device: Any) -> None:
        _send(run, lambda: verb, send.__name__)

    send.__name__ = verb.value.capitalize()
    send.__doc__ = (
        f"Same as `beamline {verb}`. The command returns at once; the state of the device shows when the scan has "
        "carried out the command."
    )
    return send


def _decider(run: FollowedRun) -> Callable[[Any, str], None]:
    def Decide(device: Any, choice: str) -> None:  # noqa: N802 - the name of the command
        """Same as `beamline decide`. Returns at once."""
        _send(run, lambda: choice_of(run.stamped.values, choice), "Decide")

    return Decide


def _send(run: FollowedRun, verb_of: Callable[[], Verb | Choice], command: str) -> None:
    try:
        ask(newest(run.runs), verb_of())
    except (BeamlineError, OSError) as error:
        tango.Except.throw_exception("SplatlineRefused", latin(user_message(error)), f"{_CLASS}.{command}")


def serve(runs: Path, place: ServerPlace, control: bool, ready: Callable[[], None]) -> None:
    """Serve the newest run of a folder, and each one that begins later, until SIGINT or SIGTERM.

    Args:
        control: everybody who reaches the address can send commands to the scan.
        ready: is called when clients can connect.

    Raises:
        DataError: the address cannot be used, or the database does not answer.
    """
    started = False

    def start() -> None:
        nonlocal started
        started = True
        ready()

    def look() -> bool:
        stamped = run.look()
        for device in tango.Util.instance().get_device_list_by_class(_CLASS):
            with tango.AutoTangoMonitor(device):
                push(device, stamped)
        time.sleep(PERIOD)
        return False

    with closing(FollowedRun(runs)) as run:
        run.look()
        try:
            run_server([device_class(run, control)], args=place.arguments, event_loop=look, post_init_callback=start,
                       raises=True, verbose=False)  # fmt: skip
        except (tango.DevFailed, RuntimeError) as error:  # omniORB raises RuntimeError if the port is taken
            if started:
                raise
            why = (
                error.args[0].desc
                if isinstance(error, tango.DevFailed)
                else "another program uses the port, or the address is not an address of this computer"
            )
            raise DataError(f"{place} cannot be served: {why}. Nothing was started.") from error


def push(device: Any, stamped: StampedValues) -> None:
    """Send all values to the clients that subscribed to their changes."""
    for each in ATTRIBUTES:
        device.push_change_event(each.metadata["name"], *reading(stamped, each.name))
    device.push_change_event("State", device_state(stamped.values), time.time(), tango.AttrQuality.ATTR_VALID)
