"""Python interface for operators: connect to the instrument, scan, watch, check and reconstruct, from a script or a
notebook.

`docs/python.md` begins with three scripts. The functions of this package call the same code as the commands, so files,
checks, messages and errors are the same. Importing this package loads neither torch nor a driver. Each function loads
its modules when it is first called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from beamline.core.errors import BeamlineError, ConfigError, DataError, ReferencesError, ScanStopped
from beamline.core.events import Event
from beamline.core.stop import ScanAborted, StopRequest, to_stderr
from drivers.base.errors import DeviceError
from recon.base.registry import loaded

if TYPE_CHECKING:
    from beamline.api.instrument import Instrument, ScanResult, connect, plan, scan
    from beamline.api.reconstruction import ReconResult, monitor, reconstruct, stream, volumes
    from beamline.plan.needs import ScanNeeds
    from beamline.projections.replay import ScanVerdict
    from beamline.projections.selection import Selection
    from beamline.scan.queue_plan import PlannedScan, QueuePlan, ScanFault

__all__ = [
    "BeamlineError",
    "ConfigError",
    "DataError",
    "DeviceError",
    "Event",
    "Instrument",
    "PlannedScan",
    "QueuePlan",
    "ReconResult",
    "ReferencesError",
    "ScanAborted",
    "ScanFault",
    "ScanNeeds",
    "ScanResult",
    "ScanStopped",
    "ScanVerdict",
    "Selection",
    "StopRequest",
    "connect",
    "monitor",
    "plan",
    "reconstruct",
    "scan",
    "stream",
    "to_stderr",
    "volumes",
]

_LAZY = {
    **dict.fromkeys(("Instrument", "ScanResult", "connect", "plan", "scan"), "beamline.api.instrument"),
    **dict.fromkeys(("monitor", "stream", "volumes"), "beamline.api.reconstruction"),
    **dict.fromkeys(("ReconResult", "reconstruct"), "beamline.api.reconstruction"),
    **dict.fromkeys(("PlannedScan", "QueuePlan", "ScanFault"), "beamline.scan.queue_plan"),
    "ScanNeeds": "beamline.plan.needs",
    "ScanVerdict": "beamline.projections.replay",
    "Selection": "beamline.projections.selection",
}


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(loaded(_LAZY[name]), name)
    raise AttributeError(f"module 'beamline.api' has no attribute {name!r}")
