"""Description of a DCAM camera: who it is, how it is set and what its counts mean, for the file's metadata."""

from __future__ import annotations

from drivers.dcam import codes
from drivers.dcam.abi import DcamError
from drivers.dcam.codes import Cooler, Error, Property, Text
from drivers.dcam.options import DcamOptions
from drivers.dcam.properties import Properties
from drivers.dcam.session import Session
from drivers.protocols import CameraSettings


def description(
    session: Session, properties: Properties, settings: CameraSettings, options: DcamOptions
) -> dict[str, str | int | float]:
    """What the camera itself says, as far as this model can say it.

    An electron number is (count - conversion_offset) * conversion_factor; both depend on the readout.
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
    return {
        **{which.name.lower(): text for which in Text if (text := _text(session, which))},
        "capabilities": str(session.dcam.dev_getcapability(session.camera).name or "none").lower(),
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
        "sensor_temperature_c": properties.get(Property.SENSORTEMPERATURE),
        "cooler": "unknown" if cooler is None else Cooler(round(cooler)).name.lower(),
        "conversion_factor": properties.get(Property.CONVERSIONFACTOR_COEFF),
        "conversion_offset": properties.get(Property.CONVERSIONFACTOR_OFFSET),
        "defect_correction": "on" if repairs else "off",
        "hot_pixels": str(options.hot_pixels) if repairs and options.hot_pixels else "as measured",
        **producers,
    }


def _text(session: Session, which: Text) -> str:
    try:
        return session.dcam.dev_getstring(session.camera, which)
    except DcamError as error:
        if error.code not in (Error.NOTSUPPORT, Error.UNKNOWNSTRID, Error.INVALIDPARAM):
            raise
        return ""
