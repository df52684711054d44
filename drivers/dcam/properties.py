"""Properties of one DCAM camera: sets them, reads them back and compares; waits until the sensor is cold."""

from __future__ import annotations

from collections.abc import Callable

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.dcam import codes
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import Cooler, Error, PropAttr, Property

_UNKNOWN = frozenset((Error.NOTSUPPORT, Error.INVALIDPROPERTYID))
"""Errors that a camera returns for a property that it does not have."""

_ILLEGAL = frozenset((Error.INVALIDPARAM, Error.INVALIDVALUE, Error.OUTOFRANGE, Error.WRONGPROPERTYVALUE))

_REFUSALS = frozenset(
    (
        *(*_UNKNOWN, *_ILLEGAL, Error.INVALIDSUBARRAY),
        *(Error.NOTWRITABLE, Error.ACCESSDENY, Error.NOTSTABLE, Error.BUSY),
    )
)
"""Errors for a value that a camera never accepts, or does not accept at the moment. (The manuals of the vendor disagree
on which error means what.)"""
_STATE = "No frame was taken with this setting; earlier frames are good"


class Properties:
    """One open camera's properties.

    Args:
        dcam: the library.
        camera: the open camera's handle.
        device: name of the camera in error messages.
    """

    def __init__(self, dcam: Dcam, camera: int, device: str) -> None:
        self._dcam, self._camera, self._device = dcam, camera, device

    def get(self, prop: Property) -> float:
        return self._dcam.prop_getvalue(self._camera, prop)

    def find(self, prop: Property) -> float | None:
        """The value of a property; None if this camera has no such property."""
        try:
            return self.get(prop)
        except DcamError as error:
            if error.code not in _UNKNOWN:
                raise
            return None

    def maximum(self, prop: Property) -> float:
        return self._limits(prop).maximum

    def set(self, prop: Property, value: float) -> float:
        """Set a value within the property's range; returns the value that the camera accepted, which may be rounded.

        Raises:
            DeviceRefused: the value is out of range, or the camera does not accept it now.
        """
        limits = self._limits(prop)
        if limits.attribute & codes.ATTRIBUTE_HASRANGE and not limits.minimum <= value <= limits.maximum:
            # Otherwise the camera might silently use the nearest limit.
            raise self._refused(f"{prop.name} = {value:g} is out of range", prop, value)
        try:
            self._dcam.prop_setvalue(self._camera, prop, value)
        except DcamError as error:
            if error.code not in _REFUSALS:
                raise
            reply = codes.error_name(error.code)
            raise self._refused(f"it rejects {prop.name} = {value:g}", prop, value, reply) from error
        return self.get(prop)

    def set_exactly(self, prop: Property, value: float) -> None:
        """Set a value and read it back. Raises DeviceRefused if the camera rounded or ignored the value."""
        accepted = self.set(prop, value)
        if abs(accepted - value) > 1e-9 * abs(value):
            raise self._refused(
                f"the camera set {prop.name} = {accepted:g} instead of {value:g}", prop, value, f"{accepted:g}"
            )

    def set_if_available(self, prop: Property, value: float) -> None:
        """Call `set_exactly` if the camera has the property. A camera without the property behaves as if it had this
        value."""
        if self.find(prop) is not None:
            self.set_exactly(prop, value)

    def set_nearly(self, prop: Property, value: float, tolerance: float) -> None:
        """Set a value and read it back. Raises DeviceRefused if the result differs by more than `tolerance`."""
        accepted = self.set(prop, value)
        if abs(accepted - value) > tolerance:
            raise DeviceRefused(
                self._device,
                f"the camera set {prop.name} = {accepted:g} instead of {value:g}",
                request=f"{prop.name} = {value:g}",
                reply=f"{accepted:g}",
                expected=f"{value:g} within {tolerance:g}",
                advice="Choose a value that the camera supports, or a larger exposure_tolerance",
                state=_STATE,
            )

    def _limits(self, prop: Property) -> PropAttr:
        try:
            return self._dcam.prop_getattr(self._camera, prop)
        except DcamError as error:
            if error.code not in _UNKNOWN:
                raise
            raise DeviceRefused(
                self._device,
                f"this camera has no {prop.name}",
                request=error.request,
                reply=codes.error_name(error.code),
                expected="an ORCA-Quest, or a camera with the same properties",
                advice="Check that index is the number of the right camera, and check its firmware",
                state=_STATE,
            ) from error

    def _refused(self, problem: str, prop: Property, value: float, reply: str = "") -> DeviceRefused:
        """The error for a rejected value, with the allowed values."""
        return DeviceRefused(
            self._device,
            problem,
            request=f"{prop.name} = {value:g}",
            reply=reply,
            expected=f"another value, legal: {self._legal(prop)}",
            advice="Choose one of the legal values in the configuration",
            state=_STATE,
        )

    def _legal(self, prop: Property) -> str:
        """Legal values of a property, in words."""
        limits = self._limits(prop)
        if limits.attribute & codes.ATTRIBUTE_TYPE_MASK != codes.ATTRIBUTE_TYPE_MODE:
            unit = " s" if limits.unit == codes.UNIT_SECOND else ""
            return f"{limits.minimum:g} to {limits.maximum:g}{unit} in steps of {limits.step:g}{unit}"
        values = [limits.minimum]
        try:
            # Stop if the value does not grow, because the loop would then never end.
            while (value := self._dcam.prop_queryvalue(self._camera, prop, values[-1], codes.QUERY_NEXT)) > values[-1]:
                values.append(value)
        except DcamError as error:
            if error.code not in _UNKNOWN | _ILLEGAL:  # these errors mark the end of the list
                raise
        return ", ".join(f"{value:g}" for value in values)


Progress = Callable[[float, str], None]  # Called with the sensor's temperature in °C and the cooler's status

POLL = 1.0  # s
STEADY_BAND, STEADY_FOR = 0.5, 60.0
"""Band in °C and time in s.

If a cooler does not report READY, the sensor counts as cold when its temperature has stayed within this band for this
time.
"""


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
            problem = (
                f"the sensor of the camera is not cold after {timeout:g} s: {celsius:.1f} °C, cooler "
                f"{status.name.lower()}"
            )
        else:
            clock.sleep(min(POLL, deadline - now))
            continue
        raise kind(device, problem, expected=_target(properties), advice=advice, state="Nothing was measured")


def _status(properties: Properties) -> Cooler:
    status = properties.find(Property.SENSORCOOLERSTATUS)
    return Cooler.NONE if status is None else Cooler(round(status))


def _target(properties: Properties) -> str:
    target = properties.find(Property.SENSORTEMPERATURETARGET)
    return "the cooler to become ready" if target is None else f"{target:.1f} °C"


def _steady(history: list[tuple[float, float]]) -> bool:
    """True if the temperatures cover at least STEADY_FOR s and stay within STEADY_BAND °C."""
    values = [value for _, value in history]
    return history[-1][0] - history[0][0] >= STEADY_FOR and max(values) - min(values) <= STEADY_BAND
