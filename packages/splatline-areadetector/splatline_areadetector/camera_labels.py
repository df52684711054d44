"""What drivers of areaDetector are told for each source of triggers: records of `cam1:` and labels, in this order.

Labels, never indices: a driver's choices change with its camera. Sources: the templates of ADSpinnaker and ADGenICam,
ADSimDetector, ADPcoWin, ADAndor3 and ADHamamatsuDCAM, eigerBase.template of ADEiger, and what tomoscan (APS) writes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from drivers.base.protocols import TriggerSource

Writes = Mapping[str, str | float]
_MODES: Mapping[TriggerSource, str] = {
    TriggerSource.INTERNAL: "Multiple", TriggerSource.EXTERNAL: "Continuous", TriggerSource.SOFTWARE: "Continuous",
}  # fmt: skip

_SINGLE = {**_MODES, TriggerSource.SOFTWARE: "Single"}


@dataclass(frozen=True)
class DriverLabels:
    """What a driver is told.

    Attributes:
        triggers: for each source that it has; {line}: as configured.
        fire: the record that exposes a frame by software; "": each is an acquisition of one frame.
        modes: ImageMode for each source; None: it has no such record.
        counted: frames are numbered from 1 by ArrayCounter, which is set to 0 before; else by the camera, from its
            first.
        train: the record that takes the number of external triggers, each of one image; "": it needs none.
        binning: a label of A3Binning, in place of BinX and BinY.
        binned_region: SizeX and SizeY are in binned pixels.
    """

    triggers: Mapping[TriggerSource, Writes]
    fire: str = ""
    modes: Mapping[TriggerSource, str] | None = field(default_factory=lambda: MappingProxyType(_MODES))
    counted: bool = True
    train: str = ""
    binning: str = ""
    binned_region: bool = False


def _by_mode(internal: str, external: str, software: str) -> Mapping[TriggerSource, Writes]:
    labels = {TriggerSource.INTERNAL: internal, TriggerSource.EXTERNAL: external, TriggerSource.SOFTWARE: software}
    return {source: {"TriggerMode": label} for source, label in labels.items()}


def _by_genicam() -> Mapping[TriggerSource, Writes]:
    waits: Writes = {"TriggerMode": "On", "TriggerOverlap": "ReadOut", "ExposureMode": "Timed", "FrameRateEnable": 0}
    return {
        TriggerSource.INTERNAL: {"TriggerMode": "Off"},
        TriggerSource.EXTERNAL: {"TriggerSource": "{line}", **waits},
        TriggerSource.SOFTWARE: {"TriggerSource": "Software", **waits},
    }


def _by_hamamatsu() -> Mapping[TriggerSource, Writes]:
    sources = {
        TriggerSource.INTERNAL: "Internal",
        TriggerSource.EXTERNAL: "External",
        TriggerSource.SOFTWARE: "Software",
    }
    return {
        source: {"HamaTriggerSource": label, "HamaTriggerMode": "Normal", "HamaTriggerActive": "Edge"}
        for source, label in sources.items()
    }  # fmt: skip


DRIVERS: Mapping[str, DriverLabels] = {
    "spinnaker": DriverLabels(_by_genicam(), fire="TriggerSoftware", counted=False, binned_region=True),
    "simdetector": DriverLabels(_by_mode("Internal", "External", "Internal"), modes=_SINGLE),
    "pco": DriverLabels(_by_mode("Auto", "Ext Only", "Auto"), modes=_SINGLE),
    "andor3": DriverLabels(
        _by_mode("Internal", "External", "Software"), fire="SoftwareTrigger",
        modes={**_MODES, TriggerSource.INTERNAL: "Fixed"}, binning="{0}x{0}",
    ),
    "hamamatsu": DriverLabels(_by_hamamatsu(), fire="HamaFireTrigger", counted=False),
    "eiger": DriverLabels(
        _by_mode("Internal Series", "External Series", "Internal Series"), modes=None, train="NumTriggers",
    ),
}  # fmt: skip
"""By the name that a configuration gives the driver."""
