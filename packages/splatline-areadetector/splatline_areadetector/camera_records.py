"""Records of an IOC that the camera driver sets, and the labels that areaDetector's drivers need for each trigger
source.

Labels are written, never indices, because the choices of a driver change with its camera. Sources: the templates of
ADSpinnaker and ADGenICam, ADSimDetector, ADPcoWin, ADAndor3 and ADHamamatsuDCAM, eigerBase.template of ADEiger, and
what tomoscan (APS) writes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from drivers.base.clock import Clock
from drivers.base.errors import DeviceRefused
from drivers.base.protocols import TriggerSource
from drivers.epics.channel import ProcessVariable, open_channel

Writes = Mapping[str, str | float]
_MODES: Mapping[TriggerSource, str] = {
    TriggerSource.INTERNAL: "Multiple", TriggerSource.EXTERNAL: "Continuous", TriggerSource.SOFTWARE: "Continuous",
}  # fmt: skip

_SINGLE = {**_MODES, TriggerSource.SOFTWARE: "Single"}


@dataclass(frozen=True)
class DriverLabels:
    """The records and labels that a driver needs.

    Attributes:
        triggers: records to write for each trigger source; {line}: as configured.
        fire: the record that triggers a frame by software; "": each frame is an acquisition of one frame.
        modes: ImageMode for each trigger source; None: the driver has no such record.
        counted: True: ArrayCounter numbers frames from 1 after it was set to 0. False: the camera numbers them from its
            first frame.
        train: the record for the number of external triggers, with one image for each trigger; "": not needed.
        binning: label of A3Binning, which replaces BinX and BinY.
        binned_region: SizeX and SizeY are in binned pixels.
    """

    triggers: Mapping[TriggerSource, Writes]
    fire: str = ""
    modes: Mapping[TriggerSource, str] | None = field(default_factory=lambda: MappingProxyType(_MODES))
    counted: bool = True
    train: str = ""
    binning: str = ""
    binned_region: bool = False


def _labelled(
    record: str, internal: str, external: str, software: str, **all_of: str
) -> Mapping[TriggerSource, Writes]:
    """A record with a label for each trigger source, and other records that are the same for all sources."""
    labels = {TriggerSource.INTERNAL: internal, TriggerSource.EXTERNAL: external, TriggerSource.SOFTWARE: software}
    return {source: {record: label, **all_of} for source, label in labels.items()}


_WAITS: Writes = {"TriggerMode": "On", "TriggerOverlap": "ReadOut", "ExposureMode": "Timed", "FrameRateEnable": 0}
_BY_GENICAM: Mapping[TriggerSource, Writes] = {
    TriggerSource.INTERNAL: {"TriggerMode": "Off"},
    TriggerSource.EXTERNAL: {"TriggerSource": "{line}", **_WAITS},
    TriggerSource.SOFTWARE: {"TriggerSource": "Software", **_WAITS},
}
DRIVERS: Mapping[str, DriverLabels] = {
    "spinnaker": DriverLabels(_BY_GENICAM, fire="TriggerSoftware", counted=False, binned_region=True),
    "simdetector": DriverLabels(_labelled("TriggerMode", "Internal", "External", "Internal"), modes=_SINGLE),
    "pco": DriverLabels(_labelled("TriggerMode", "Auto", "Ext Only", "Auto"), modes=_SINGLE),
    "andor3": DriverLabels(
        _labelled("TriggerMode", "Internal", "External", "Software"), fire="SoftwareTrigger",
        modes={**_MODES, TriggerSource.INTERNAL: "Fixed"}, binning="{0}x{0}",
    ),
    "hamamatsu": DriverLabels(
        _labelled(
            "HamaTriggerSource", "Internal", "External", "Software", HamaTriggerMode="Normal", HamaTriggerActive="Edge"
        ),
        fire="HamaFireTrigger", counted=False,
    ),
    "eiger": DriverLabels(
        _labelled("TriggerMode", "Internal Series", "External Series", "Internal Series"),
        modes=None, train="NumTriggers",
    ),
}  # fmt: skip
"""The drivers, by their names in a configuration."""

LOOK_EVERY = 0.02  # s between two reads of a readback


class Records:
    """The records of an IOC by their names after the prefix, each opened once."""

    def __init__(self, prefix: str, name: str, timeout: float, clock: Clock) -> None:
        self._prefix, self._name, self._timeout, self._clock = prefix, name, timeout, clock
        self._opened: dict[str, ProcessVariable] = {}

    def read(self, record: str) -> float | str:
        (value,) = self._channel(record).read("")
        return value.label or value.value

    def write(self, record: str, value: float | str) -> None:
        self._channel(record).write("", value)

    def set(self, record: str, value: float | str, within: float = 0.01) -> float | str:
        """Write a value, and wait for its readback. A number may differ by this fraction. Returns the readback."""
        self.write(record, value)
        return self.await_value(record, value, within)

    def await_value(self, record: str, value: float | str, within: float = 0.01) -> float | str:
        """Wait until the readback has this value. Raises DeviceRefused if the readback does not reach it."""
        deadline = self._clock.now() + self._timeout
        while not _is_near(shown := self.read(f"{record}_RBV"), value, within):
            if self._clock.now() > deadline:
                raise DeviceRefused(
                    self._name, f"{record} did not accept {value!r}", request=f"{self._prefix}{record} = {value}",
                    reply=f"{record}_RBV is {shown!r}", state="Other settings may have changed",
                    advice=(
                        "Try this setting in the camera's control screen, and check that `driver` names the "
                        "camera's driver"
                    ),
                )  # fmt: skip
            self._clock.sleep(LOOK_EVERY)
        return shown

    def close(self) -> None:
        for channel in self._opened.values():
            channel.close()

    def _channel(self, record: str) -> ProcessVariable:
        if record not in self._opened:
            self._opened[record] = open_channel(f"{self._prefix}{record}", self._name, self._timeout)
        return self._opened[record]


def _is_near(shown: float | str, value: float | str, within: float) -> bool:
    if isinstance(shown, str) or isinstance(value, str):
        return shown == value or (isinstance(shown, str) and shown in _SWITCHED.get(value, ()))
    return abs(shown - value) <= within * abs(value) + 1e-9


_SWITCHED: dict[float | str, tuple[str, ...]] = {
    0: ("No", "Disable", "Off", "Done"), 1: ("Yes", "Enable", "On", "Acquire", "Acquiring"),
}  # fmt: skip
"""Labels of switches that are written as 0 or 1."""
