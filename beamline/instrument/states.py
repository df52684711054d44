"""States: reads identity and status of each device of a configuration before a scan. Nothing moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import Any

from beamline.config.beam import BeamMonitorSection, FoundFilter, FoundMonochromator, MotorFilter, StageMover
from beamline.config.devices import DcamOrca
from beamline.config.load import Config
from beamline.instrument.connect import ask_operator, connect, make_beam_monitor, make_camera, shutter_of
from drivers.base.clock import Clock
from drivers.base.errors import DeviceError
from drivers.base.protocols import ConnectedShutter


@dataclass(frozen=True)
class DeviceState:
    """Identity and status of a device, or why it cannot be used.

    Attributes:
        name: name of the device.
        fault: the reason why the device cannot be used; "" if it answers.
        values: identity, settings and state of the device, by name.
    """

    name: str
    fault: str
    values: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def device_states(config: Config, clock: Clock, usb: Any = None) -> Iterator[DeviceState]:
    """Connect the devices one after the other, read the identity and status of each, and disconnect all of them.

    Nothing moves, and the function does not wait, for example until the sensor is cold. If a device does not answer,
    the others are still read. Devices that the operator moves by hand are left out.

    Args:
        usb: a pyusb backend; None: the installed libusb.

    Raises:
        ConfigError: the simulated scene is wrong.
    """
    camera = config.devices.camera
    if isinstance(camera, DcamOrca) and camera.link == "usb3":
        yield _link(camera, usb)
    with ExitStack() as opened:
        for name, make in _devices(config, clock, opened):
            try:
                device = make()
                state = None if device is None else DeviceState(name, "", _READ[name](device))
            except DeviceError as error:
                state = DeviceState(name, str(error))
            if state is not None:
                yield state


def _link(camera: DcamOrca, usb: Any) -> DeviceState:
    """The camera on USB, from its USB descriptors. These also show a slow link that would lose frames."""
    session = import_module(f"drivers.{camera.kind}.session")
    link = session.preflight(product=camera.usb_product, serial=camera.usb_serial, backend=usb)
    usable = link.verdict not in (session.Verdict.SLOW, session.Verdict.ABSENT)
    return DeviceState("camera link", "" if usable else link.message, {"usb": link.message} if usable else {})


def _devices(config: Config, clock: Clock, opened: ExitStack) -> Iterator[tuple[str, Callable[[], Any]]]:
    """For each device, its name and the function that connects it. None: there is no such device, or the operator moves
    it."""
    wanted = config.devices
    if config.simulation is not None:
        instrument = opened.enter_context(connect(config))
        devices = instrument.devices
        for name, device in (
            ("stage", devices.stage), ("camera", devices.camera), ("shutter", devices.shutter),
            ("filter", devices.filter), ("monochromator", devices.monochromator),
            ("beam monitor", instrument.beam_monitor),
        ):  # fmt: skip
            yield name, lambda device=device: device  # type: ignore[misc]
        return
    stages: list[Any] = []

    def held(device: Any) -> Any:
        opened.callback(device.disconnect if isinstance(device, ConnectedShutter) else device.close)
        return device

    def stage() -> Any:
        stages.append(held(wanted.stage.connect(clock)))
        return stages[0]

    def shutter() -> Any:
        shutter = shutter_of(config, stages[0], clock, ask_operator)
        return None if shutter.by_hand else held(shutter) if isinstance(shutter, ConnectedShutter) else shutter

    yield "stage", stage
    camera: Any = wanted.camera
    yield "camera", lambda: held(make_camera(camera, clock) if isinstance(camera, DcamOrca) else camera.connect(clock))
    if stages:
        yield "shutter", shutter
    for name, section, kinds in (
        ("sample mover", wanted.sample_mover, StageMover),
        ("filter", wanted.filter, MotorFilter | FoundFilter),
        ("monochromator", wanted.monochromator, FoundMonochromator),
    ):
        if isinstance(section, kinds):
            yield name, lambda section=section: held(section.connect(clock))  # type: ignore[misc]
    if isinstance(monitor := wanted.beam_monitor, BeamMonitorSection):
        yield "beam monitor", lambda: held(make_beam_monitor(monitor, clock))


SHOWN = frozenset({
    "usb", "model", "identity", "cameraid", "serial", "firmware", "cameraversion", "cooler", "found_at_opening",
    "position_deg", "moves", "open", "place", "energy_kev", "value", "unit", "answers",
})  # fmt: skip
"""The values that are shown to people. Programs get all values."""
_READ: Mapping[str, Callable[[Any], dict[str, Any]]] = {
    "stage": lambda stage: {
        **stage.describe(), "position_deg": round(math.degrees(stage.position()), 6), "moves": stage.moving(),
    },
    "camera": lambda camera: camera.describe(),
    "shutter": lambda shutter: {"open": shutter.is_open()},
    "sample mover": lambda mover: {"answers": True},
    "filter": lambda filter_: {"place": filter_.place() or "none of the named places"},
    "monochromator": lambda monochromator: {"energy_kev": monochromator.energy()},
    "beam monitor": lambda monitor: vars(monitor.reading()),
}  # fmt: skip
