"""Description of a DCAM camera for the file's metadata: identity, settings, and the meaning of its counts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import MappingProxyType

from drivers.base.protocols import CameraSettings
from drivers.dcam import codes
from drivers.dcam.abi import DcamError
from drivers.dcam.codes import Cooler, Error, Property, Text
from drivers.dcam.options import DcamOptions, GlobalExposure
from drivers.dcam.properties import Properties
from drivers.dcam.session import Session

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
    """Everything that this camera model reports of itself, by name.

    Number of electrons = (count - conversion_offset) * conversion_factor. Both depend on the readout; the entries are
    missing for a camera that does not report them. `row_period` (s): how much later each row starts than the one
    above. It is missing where all rows start together.
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
    texts = {which: _if_told(partial(dcam.dev_getstring, camera, which), "") for which in Text}
    return {
        **{which.name.lower(): text for which, text in texts.items() if text},
        "capabilities": _if_told(lambda: str(dcam.dev_getcapability(camera).name or "none").lower(), "not reported"),
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


def _if_told(ask: Callable[[], str], otherwise: str) -> str:
    """The answer; `otherwise` for a camera that does not give it."""
    try:
        return ask()
    except DcamError as error:
        if error.code not in _NOT_AVAILABLE:
            raise
        return otherwise
