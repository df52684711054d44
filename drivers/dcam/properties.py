"""Properties of one DCAM camera: CameraSettings and CameraTiming in terms of what it can be set to and asked."""

from __future__ import annotations

from contextlib import suppress

from drivers.dcam import codes
from drivers.dcam.abi import Dcam, DcamError
from drivers.dcam.codes import Error, Property
from drivers.errors import DeviceRefused
from drivers.protocols import CameraSettings, CameraTiming, TriggerSource

_TRIGGERS = {
    TriggerSource.INTERNAL: codes.TRIGGERSOURCE_INTERNAL,
    TriggerSource.EXTERNAL: codes.TRIGGERSOURCE_EXTERNAL,
    TriggerSource.SOFTWARE: codes.TRIGGERSOURCE_SOFTWARE,
}
_READOUTS = {"standard": codes.READOUTSPEED_STANDARD, "ultra_quiet": codes.READOUTSPEED_ULTRA_QUIET}
_SIZES = (Property.SUBARRAYVSIZE, Property.SUBARRAYHSIZE)

# What a camera answers to a value that it cannot take, or not now; the vendor's manuals disagree on which it will be.
_REFUSALS = frozenset(
    (
        *(Error.INVALIDPARAM, Error.INVALIDVALUE, Error.OUTOFRANGE, Error.WRONGPROPERTYVALUE, Error.INVALIDSUBARRAY),
        *(Error.NOTWRITABLE, Error.ACCESSDENY, Error.NOTSTABLE, Error.BUSY, Error.NOTSUPPORT, Error.INVALIDPROPERTYID),
    )
)


class Properties:
    """One open camera's properties.

    Args:
        dcam: the library.
        camera: the open camera's handle.
        device: what errors call it.
    """

    def __init__(self, dcam: Dcam, camera: int, device: str) -> None:
        self._dcam, self._camera, self._device = dcam, camera, device

    def get(self, prop: Property) -> float:
        return self._dcam.prop_getvalue(self._camera, prop)

    def set(self, prop: Property, value: float) -> None:
        """Set within the property's range; a camera may round to the next value that it has.

        Raises:
            DeviceRefused: out of range, or not now.
        """
        limits = self._dcam.prop_getattr(self._camera, prop)
        if limits.attribute & codes.ATTRIBUTE_HASRANGE and not limits.minimum <= value <= limits.maximum:
            # Left to itself, a property that rounds would take the nearest limit without a word.
            raise DeviceRefused(self._device, f"{prop.name} = {value:g} is out of range", advice=self.legal(prop))
        try:
            self._dcam.prop_setvalue(self._camera, prop, value)
        except DcamError as error:
            if error.code not in _REFUSALS:
                raise
            problem, reply = f"it refuses {prop.name} = {value:g}", codes.error_name(error.code)
            raise DeviceRefused(self._device, problem, reply=reply, advice=self.legal(prop)) from error

    def legal(self, prop: Property) -> str:
        """What a property can be, in words."""
        limits = self._dcam.prop_getattr(self._camera, prop)
        if limits.attribute & codes.ATTRIBUTE_TYPE_MASK != codes.ATTRIBUTE_TYPE_MODE:
            unit = " s" if limits.unit == codes.UNIT_SECOND else ""
            return f"legal: {limits.minimum:g} to {limits.maximum:g}{unit} in steps of {limits.step:g}{unit}"
        values = [limits.minimum]
        with suppress(DcamError):  # that is how the list ends
            while True:
                values.append(self._dcam.prop_queryvalue(self._camera, prop, values[-1], codes.QUERY_NEXT))
        return f"legal: {', '.join(f'{value:g}' for value in values)}"

    def set_exactly(self, prop: Property, value: int) -> None:
        """Set, read back, and refuse a value that the camera has rounded or ignored."""
        self.set(prop, value)
        accepted = self.get(prop)
        if accepted != value:
            problem = f"it made {prop.name} = {accepted:g} of {value}"
            raise DeviceRefused(self._device, problem, advice=self.legal(prop))

    def apply(self, settings: CameraSettings) -> None:
        """Write everything that a triggered scan depends on; only the exposure may be rounded.

        Raises:
            DeviceRefused: at the first thing that the camera cannot do; those before it are set.
        """
        if settings.readout not in _READOUTS:
            problem = f"there is no readout {settings.readout!r}"
            raise DeviceRefused(self._device, problem, advice=f"legal: {', '.join(_READOUTS)}")
        # Sensor mode and speed first: they change the ranges of what follows.
        self.set_exactly(Property.SENSORMODE, codes.SENSORMODE_AREA)
        self.set_exactly(Property.READOUTSPEED, _READOUTS[settings.readout])
        self.set_exactly(Property.IMAGE_PIXELTYPE, codes.PIXELTYPE_MONO16)
        self.set_exactly(Property.BITSPERCHANNEL, 16)
        self.set_exactly(Property.DEFECTCORRECT_MODE, codes.OFF)  # counts as measured; repairs come later, on record
        self.set_exactly(Property.BINNING, settings.binning)
        self.set_exactly(Property.SUBARRAYMODE, codes.OFF)
        if settings.roi is not None:
            row0, col0, rows, cols = settings.roi
            height, width = (self._dcam.prop_getattr(self._camera, prop).maximum for prop in _SIZES)
            if not (0 <= row0 <= height - rows and 0 <= col0 <= width - cols):
                problem = f"the region {settings.roi} (row0, col0, rows, cols) does not lie on the sensor"
                raise DeviceRefused(self._device, problem, expected=f"a region within {height:g} x {width:g}")
            # Positions to 0 first: position + size must stay within the sensor at every step.
            self.set_exactly(Property.SUBARRAYVPOS, 0)
            self.set_exactly(Property.SUBARRAYHPOS, 0)
            self.set_exactly(Property.SUBARRAYVSIZE, rows)
            self.set_exactly(Property.SUBARRAYHSIZE, cols)
            self.set_exactly(Property.SUBARRAYVPOS, row0)
            self.set_exactly(Property.SUBARRAYHPOS, col0)
            self.set_exactly(Property.SUBARRAYMODE, codes.ON)
        if self.get(Property.FRAMEBUNDLE_MODE) == codes.ON:
            problem = (
                "the camera bundles several frames of this size into one transfer, which this driver cannot take apart"
            )
            raise DeviceRefused(self._device, problem, advice="Ask for a larger region of interest")
        self.set(Property.EXPOSURETIME, settings.exposure)
        self.set_exactly(Property.TRIGGERSOURCE, _TRIGGERS[settings.trigger])
        self.set_exactly(Property.TRIGGER_MODE, codes.TRIGGER_MODE_NORMAL)
        self.set_exactly(Property.TRIGGERACTIVE, codes.TRIGGERACTIVE_EDGE)
        self.set_exactly(Property.TRIGGERPOLARITY, codes.TRIGGERPOLARITY_POSITIVE)  # the camera's default: falling edge
        self.set_exactly(Property.TRIGGER_GLOBALEXPOSURE, codes.TRIGGER_GLOBALEXPOSURE_DELAYED)
        self.set_exactly(Property.TRIGGERDELAY, 0)
        self.set_exactly(Property.TRIGGERTIMES, 1)

    def read(self) -> CameraSettings:
        """The camera's present settings."""
        triggers, readouts = {v: k for k, v in _TRIGGERS.items()}, {v: k for k, v in _READOUTS.items()}
        subarray = (Property.SUBARRAYVPOS, Property.SUBARRAYHPOS, *_SIZES)
        row0, col0, rows, cols = (round(self.get(prop)) for prop in subarray)
        return CameraSettings(
            exposure=self.get(Property.EXPOSURETIME),
            trigger=triggers[round(self.get(Property.TRIGGERSOURCE))],
            roi=(row0, col0, rows, cols) if self.get(Property.SUBARRAYMODE) == codes.ON else None,
            binning=round(self.get(Property.BINNING)),
            readout=readouts[round(self.get(Property.READOUTSPEED))],
        )

    def timing(self) -> CameraTiming:
        """The least period follows the vendor's rule for external triggers (DCAM property reference):

        with exposure Tx, cyclic trigger period Tc and minimum blanking Tb, triggers are at least max(Tc, Tx + Tb)
        apart, and never closer than the minimum trigger interval.
        """
        rows, cols = round(self.get(Property.IMAGE_HEIGHT)), round(self.get(Property.IMAGE_WIDTH))
        readout = self.get(Property.TIMING_READOUTTIME)
        if self.get(Property.TRIGGERSOURCE) == codes.TRIGGERSOURCE_INTERNAL:
            min_period = self.get(Property.INTERNAL_FRAMEINTERVAL)
        else:
            min_period = max(
                self.get(Property.TIMING_MINTRIGGERINTERVAL),
                self.get(Property.TIMING_CYCLICTRIGGERPERIOD),
                self.get(Property.EXPOSURETIME) + self.get(Property.TIMING_MINTRIGGERBLANKING),
            )
        bits = round(self.get(Property.BITSPERCHANNEL))
        return CameraTiming((rows, cols), min_period, readout, row_period=readout / rows, bits=bits)
