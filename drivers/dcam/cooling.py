"""Cooling: waits until the sensor has its final temperature, on which the dark counts of the scan depend."""

from __future__ import annotations

from collections.abc import Callable

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.dcam.codes import Cooler, Property
from drivers.dcam.properties import Properties

Progress = Callable[[float, str], None]  # Called with the sensor's temperature in °C and the cooler's status

POLL = 1.0  # s
STEADY_BAND, STEADY_FOR = 0.5, 60.0
"""°C and s: with a cooler that reports no READY, a temperature within this band for this time counts as final."""


def wait_until_cold(
    properties: Properties, device: str, clock: Clock, timeout: float, progress: Progress = lambda celsius, status: None
) -> float:
    """Wait until the cooler is ready; returns the sensor's temperature in °C. `progress` is called once a second.

    Raises:
        DeviceRefused: the cooler is off.
        DeviceTimeout: it was not ready within `timeout` s.
        DeviceError: the cooler reports a fault.
    """
    deadline = clock.now() + timeout
    history: list[tuple[float, float]] = []
    while True:
        now, celsius = clock.now(), properties.get(Property.SENSORTEMPERATURE)
        status = _status(properties)
        progress(celsius, status.name.lower())
        history = [(time, value) for time, value in history if time >= now - STEADY_FOR - POLL] + [(now, celsius)]
        if status is Cooler.READY or (status in (Cooler.NONE, Cooler.ALWAYS) and _steady(history)):
            return celsius
        kind, advice = DeviceError, "Check the camera's fan and cooling water"
        if status < 0:
            problem = f"its cooler reports {status.name} at {celsius:.1f} °C"
        elif status is Cooler.OFF:
            kind, problem = DeviceRefused, f"its cooler is off ({celsius:.1f} °C)"
            advice = "Switch the cooler on, or set devices.camera.cool_s: 0"
        elif now >= deadline:
            kind, advice = DeviceTimeout, "Wait longer, or check the camera's fan and cooling water"
            problem = f"its sensor is not cold after {timeout:g} s: {celsius:.1f} °C, cooler {status.name.lower()}"
        else:
            clock.sleep(min(POLL, deadline - now))
            continue
        raise kind(device, problem, expected=_target(properties), advice=advice, state="Nothing was measured")


def _status(properties: Properties) -> Cooler:
    status = properties.find(Property.SENSORCOOLERSTATUS)
    return Cooler.NONE if status is None else Cooler(round(status))


def _target(properties: Properties) -> str:
    target = properties.find(Property.SENSORTEMPERATURETARGET)
    return "the cooler to be ready" if target is None else f"{target:.1f} °C"


def _steady(history: list[tuple[float, float]]) -> bool:
    """Whether the temperatures cover STEADY_FOR s and stay within STEADY_BAND °C."""
    values = [value for _, value in history]
    return history[-1][0] - history[0][0] >= STEADY_FOR and max(values) - min(values) <= STEADY_BAND
