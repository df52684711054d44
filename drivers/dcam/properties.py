"""Properties of one DCAM camera: set, read back and compare; a refusal lists the legal values."""

from __future__ import annotations

from drivers.base.errors import DeviceRefused
from drivers.dcam import codes
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import Error, PropAttr, Property

_UNKNOWN = frozenset((Error.NOTSUPPORT, Error.INVALIDPROPERTYID))
"""Errors that a camera returns for a property that it does not have."""

_ILLEGAL = frozenset((Error.INVALIDPARAM, Error.INVALIDVALUE, Error.OUTOFRANGE, Error.WRONGPROPERTYVALUE))

_REFUSALS = frozenset(
    (
        *(*_UNKNOWN, *_ILLEGAL, Error.INVALIDSUBARRAY),
        *(Error.NOTWRITABLE, Error.ACCESSDENY, Error.NOTSTABLE, Error.BUSY),
    )
)
"""Errors for a value that a camera refuses, always or for now; the vendor's manuals disagree on their use."""
_STATE = "No frame was taken with it; earlier frames are good"


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
            # The camera itself may silently take the nearest limit instead.
            raise self._refused(f"{prop.name} = {value:g} is out of range", prop, value)
        try:
            self._dcam.prop_setvalue(self._camera, prop, value)
        except DcamError as error:
            if error.code not in _REFUSALS:
                raise
            reply = codes.error_name(error.code)
            raise self._refused(f"it refuses {prop.name} = {value:g}", prop, value, reply) from error
        return self.get(prop)

    def set_exactly(self, prop: Property, value: float) -> None:
        """Set and read back; DeviceRefused if the camera rounded or ignored the value."""
        accepted = self.set(prop, value)
        if abs(accepted - value) > 1e-9 * abs(value):
            raise self._refused(f"it set {prop.name} = {accepted:g} instead of {value:g}", prop, value, f"{accepted:g}")

    def set_if_available(self, prop: Property, value: float) -> None:
        """Call `set_exactly` if the camera has the property; one without it behaves as if it had this value."""
        if self.find(prop) is not None:
            self.set_exactly(prop, value)

    def set_nearly(self, prop: Property, value: float, tolerance: float) -> None:
        """Set and read back; DeviceRefused if the result differs by more than `tolerance`."""
        accepted = self.set(prop, value)
        if abs(accepted - value) > tolerance:
            raise DeviceRefused(
                self._device,
                f"it set {prop.name} = {accepted:g} instead of {value:g}",
                request=f"{prop.name} = {value:g}",
                reply=f"{accepted:g}",
                expected=f"{value:g} within {tolerance:g}",
                advice="Ask for a value that the camera has, or allow a larger exposure_tolerance",
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
                advice="Check that index names the right camera, and its firmware",
                state=_STATE,
            ) from error

    def _refused(self, problem: str, prop: Property, value: float, reply: str = "") -> DeviceRefused:
        """The error for a refused value, with the legal values."""
        return DeviceRefused(
            self._device,
            problem,
            request=f"{prop.name} = {value:g}",
            reply=reply,
            expected=f"another value, legal: {self._legal(prop)}",
            advice="Choose one of them in the configuration",
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
            # Stop if the value does not grow, which would repeat for ever.
            while (value := self._dcam.prop_queryvalue(self._camera, prop, values[-1], codes.QUERY_NEXT)) > values[-1]:
                values.append(value)
        except DcamError as error:
            if error.code not in _UNKNOWN | _ILLEGAL:  # these errors mark the end of the list
                raise
        return ", ".join(f"{value:g}" for value in values)
