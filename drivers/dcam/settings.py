"""Settings of a DCAM camera as its properties, and its description for the file: identity, settings, unit of counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import partial
from types import MappingProxyType

from drivers.base.errors import DeviceRefused
from drivers.base.protocols import CameraSettings, CameraTiming, TriggerSource
from drivers.dcam import codes
from drivers.dcam.abi import DcamError
from drivers.dcam.codes import Cooler, Error, Property, Text
from drivers.dcam.properties import Properties
from drivers.dcam.session import Session
from drivers.orca_quest import DcamOptions, GlobalExposure, HotPixelMode, TriggerActive, TriggerMode, TriggerPolarity

_NOT_AVAILABLE = (Error.NOTSUPPORT, Error.NOTIMPLEMENT, Error.UNKNOWNSTRID, Error.INVALIDPARAM)
_OPTIONAL = MappingProxyType(
    {
        "sensor_temperature_c": Property.SENSORTEMPERATURE,
        "conversion_factor": Property.CONVERSIONFACTOR_COEFF,
        "conversion_offset": Property.CONVERSIONFACTOR_OFFSET,
    }
)


def description(
    session: Session, properties: Properties, settings: CameraSettings, options: DcamOptions
) -> dict[str, str | int | float]:
    """Identity and settings that this camera model reports, by name.

    Number of electrons = (count - conversion_offset) * conversion_factor. Both depend on the readout; the entries are
    missing for a camera that does not report them. `row_period`: time in s by which each row starts later than the row
    above. The entry is missing if all rows start together.
    """
    cooler = properties.find(Property.SENSORCOOLERSTATUS)
    repairs = properties.find(Property.DEFECTCORRECT_MODE) == codes.ON
    producers = {
        name: codes.PRODUCERS.get(round(properties.find(prop) or 0), "unknown")
        for name, prop in (
            ("timestamps_by", Property.TIMESTAMP_PRODUCER),
            ("framestamps_by", Property.FRAMESTAMP_PRODUCER),
        )
    }
    dcam, camera = session.dcam, session.camera
    row_period = properties.get(Property.TIMING_READOUTTIME) / properties.get(Property.IMAGE_HEIGHT)
    texts = {which: _answer_or(partial(dcam.dev_getstring, camera, which), "") for which in Text}
    return {
        **{which.name.lower(): text for which, text in texts.items() if text},
        "capabilities": _answer_or(lambda: str(dcam.dev_getcapability(camera).name or "none").lower(), "not reported"),
        "exposure": properties.get(Property.EXPOSURETIME),
        "trigger": str(settings.trigger),
        "trigger_active": str(options.trigger_active),
        "trigger_mode": str(options.trigger_mode),
        "trigger_polarity": str(options.trigger_polarity),
        "trigger_times": options.trigger_times,
        "trigger_delay": options.trigger_delay,
        "global_exposure": str(options.global_exposure),
        "readout": settings.readout,
        "binning": settings.binning,
        "cooler": "unknown" if cooler is None else Cooler(round(cooler)).name.lower(),
        "defect_correction": "on" if repairs else "off",
        "hot_pixels": str(options.hot_pixels) if repairs and options.hot_pixels else "as measured",
        **producers,
        **({"row_period": row_period} if options.global_exposure is GlobalExposure.DELAYED else {}),
        **{name: value for name, prop in _OPTIONAL.items() if (value := properties.find(prop)) is not None},
    }


def _answer_or(ask: Callable[[], str], otherwise: str) -> str:
    """The answer of the camera, or `otherwise` if it does not answer."""
    try:
        return ask()
    except DcamError as error:
        if error.code not in _NOT_AVAILABLE:
            raise
        return otherwise


_VALUES: Mapping[StrEnum, int] = MappingProxyType(
    {
        TriggerSource.INTERNAL: 1,
        TriggerSource.EXTERNAL: 2,
        TriggerSource.SOFTWARE: 3,
        TriggerActive.EDGE: 1,
        TriggerActive.LEVEL: 2,
        TriggerActive.SYNC_READOUT: 3,
        TriggerMode.NORMAL: 1,
        TriggerMode.START: 6,
        TriggerPolarity.NEGATIVE: 1,
        TriggerPolarity.POSITIVE: 2,
        GlobalExposure.DELAYED: 3,
        GlobalExposure.GLOBAL_RESET: 5,
        HotPixelMode.STANDARD: 1,
        HotPixelMode.MINIMUM: 2,
        HotPixelMode.AGGRESSIVE: 3,
    }
)
"""Our options as values of the camera's properties."""
PHOTON_NUMBER = "photon_number"
_READOUTS = MappingProxyType(
    {
        "standard": (codes.SENSORMODE_AREA, codes.READOUTSPEED_STANDARD),
        "ultra_quiet": (codes.SENSORMODE_AREA, codes.READOUTSPEED_ULTRA_QUIET),
        PHOTON_NUMBER: (codes.SENSORMODE_PHOTONNUMBERRESOLVING, None),  # has only one speed
    }
)
"""Sensor mode and readout speed. With photon_number the camera itself converts a pixel's charge to photoelectrons."""
_PLAIN = DcamOptions()


def apply_settings(properties: Properties, device: str, settings: CameraSettings, options: DcamOptions) -> None:
    """Set every property that a triggered scan depends on, and compare it with the value read back.

    Only the exposure may be rounded.

    Raises:
        DeviceRefused: the camera rejects a property; earlier properties have been set.
    """
    if settings.readout not in _READOUTS:
        problem = f"there is no readout {settings.readout!r}"
        raise DeviceRefused(
            device,
            problem,
            expected=f"another one, legal: {', '.join(_READOUTS)}",
            advice="Choose one of the legal values in the configuration",
            state="Its settings were not changed",
        )
    # Sensor mode and speed first, because they change the ranges of the other properties.
    mode, speed = _READOUTS[settings.readout]
    properties.set_exactly(Property.SENSORMODE, mode)
    if speed is not None:
        properties.set_exactly(Property.READOUTSPEED, speed)
    properties.set_exactly(Property.IMAGE_PIXELTYPE, codes.PIXELTYPE_MONO16)
    properties.set_if_available(Property.BITSPERCHANNEL, 16)
    if options.hot_pixels is None:
        properties.set_if_available(Property.DEFECTCORRECT_MODE, codes.OFF)
    else:
        properties.set_exactly(Property.DEFECTCORRECT_MODE, codes.ON)
        properties.set_exactly(Property.HOTPIXELCORRECT_LEVEL, _VALUES[options.hot_pixels])
    properties.set_exactly(Property.BINNING, settings.binning)
    _apply_roi(properties, device, settings.roi)
    if properties.find(Property.FRAMEBUNDLE_MODE) == codes.ON:
        problem = "the camera combines several frames of this size into one transfer, which this driver cannot separate"
        raise DeviceRefused(
            device,
            problem,
            request=f"a region of {settings.roi or 'the whole sensor'}",
            expected="FRAMEBUNDLE_MODE off",
            advice="Choose a larger region of interest",
            state="No frame was taken",
        )
    sensor_rows = properties.get(Property.IMAGE_HEIGHT) * settings.binning
    line = 2 * properties.get(Property.TIMING_READOUTTIME) / sensor_rows
    tolerance = options.exposure_tolerance * settings.exposure + line
    properties.set_nearly(Property.EXPOSURETIME, settings.exposure, tolerance)
    apply_trigger_source(properties, settings.trigger)
    # Pulse options do not apply to software triggers. Each of them gives one frame with the set exposure.
    pulses = options if settings.trigger is TriggerSource.EXTERNAL else _PLAIN
    properties.set_exactly(Property.TRIGGER_MODE, _VALUES[pulses.trigger_mode])
    properties.set_exactly(Property.TRIGGERACTIVE, _VALUES[pulses.trigger_active])
    properties.set_exactly(Property.TRIGGERPOLARITY, _VALUES[options.trigger_polarity])
    properties.set_exactly(Property.TRIGGER_GLOBALEXPOSURE, _VALUES[options.global_exposure])
    properties.set_exactly(Property.TRIGGERDELAY, pulses.trigger_delay)
    properties.set_exactly(Property.TRIGGERTIMES, pulses.trigger_times)


def apply_trigger_source(properties: Properties, source: TriggerSource) -> None:
    """Set the trigger source. In START mode the first pulse resets the source, so it must be set before each run."""
    properties.set_exactly(Property.TRIGGERSOURCE, _VALUES[source])


def read_settings(properties: Properties, trigger: TriggerSource) -> CameraSettings:
    """The settings that the camera has, after `apply_settings`."""
    mode, speed = (round(properties.get(prop)) for prop in (Property.SENSORMODE, Property.READOUTSPEED))
    readouts = {numbers: name for name, numbers in _READOUTS.items()}
    subarray = (Property.SUBARRAYVPOS, Property.SUBARRAYHPOS, Property.SUBARRAYVSIZE, Property.SUBARRAYHSIZE)
    row0, col0, rows, cols = (round(properties.get(prop)) for prop in subarray)
    return CameraSettings(
        exposure=properties.get(Property.EXPOSURETIME),
        trigger=trigger,
        roi=(row0, col0, rows, cols) if properties.get(Property.SUBARRAYMODE) == codes.ON else None,
        binning=round(properties.get(Property.BINNING)),
        readout=PHOTON_NUMBER if mode == codes.SENSORMODE_PHOTONNUMBERRESOLVING else readouts[mode, speed],
    )


def read_timing(properties: Properties, trigger: TriggerSource, options: DcamOptions) -> CameraTiming:
    """Frame shape and timing that the camera reports, with the shortest trigger period.

    For external triggers, the shortest period follows the vendor's rule (DCAM property reference). With exposure Tx,
    cyclic trigger period Tc and minimum blanking Tb, triggers must be at least max(Tc, Tx + Tb) apart. They must also
    be at least the minimum trigger interval apart. Tx is left out if the pulses set the exposure. If n pulses give one
    frame, pulses may be n times as close.

    Frames with a set exposure are also not closer than in free run, because the camera's period in free run includes
    the transfer. A full frame takes 56 ms over USB and 8 ms on the sensor.
    """
    get = properties.get
    rows, cols = round(get(Property.IMAGE_HEIGHT)), round(get(Property.IMAGE_WIDTH))
    readout = get(Property.TIMING_READOUTTIME)
    if trigger is TriggerSource.INTERNAL:
        min_period = get(Property.INTERNAL_FRAMEINTERVAL)
    else:
        external = trigger is TriggerSource.EXTERNAL
        timed = not external or options.trigger_active is TriggerActive.EDGE
        exposure = get(Property.EXPOSURETIME) if timed else 0.0
        min_period = max(
            get(Property.TIMING_MINTRIGGERINTERVAL),
            get(Property.TIMING_CYCLICTRIGGERPERIOD),
            exposure + get(Property.TIMING_MINTRIGGERBLANKING),
            (properties.find(Property.INTERNAL_FRAMEINTERVAL) or 0.0) if timed else 0.0,
        )
        min_period /= options.trigger_times if external else 1
    bits = round(properties.find(Property.BITSPERCHANNEL) or 16)
    return CameraTiming((rows, cols), min_period, readout, row_period=readout / rows, bits=bits)


def _apply_roi(properties: Properties, device: str, roi: tuple[int, int, int, int] | None) -> None:
    properties.set_exactly(Property.SUBARRAYMODE, codes.OFF)
    if roi is None:
        return
    row0, col0, rows, cols = roi
    # Positions to 0 first, because position + size must stay within the sensor at every step, also in reported ranges.
    properties.set_exactly(Property.SUBARRAYVPOS, 0)
    properties.set_exactly(Property.SUBARRAYHPOS, 0)
    height, width = (properties.maximum(prop) for prop in (Property.SUBARRAYVSIZE, Property.SUBARRAYHSIZE))
    if not (0 <= row0 <= height - rows and 0 <= col0 <= width - cols):
        problem = f"the region {roi} (row0, col0, rows, cols) extends beyond the sensor"
        raise DeviceRefused(
            device,
            problem,
            expected=f"a region within {height:g} x {width:g}",
            advice="Move or shrink the region in the configuration",
            state="No frame was taken",
        )
    properties.set_exactly(Property.SUBARRAYVSIZE, rows)
    properties.set_exactly(Property.SUBARRAYHSIZE, cols)
    properties.set_exactly(Property.SUBARRAYVPOS, row0)
    properties.set_exactly(Property.SUBARRAYHPOS, col0)
    properties.set_exactly(Property.SUBARRAYMODE, codes.ON)
