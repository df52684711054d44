"""A fake IOC over PVAccess in this process: an image of areaDetector, and records that a test sets."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from p4p.nt import NTEnum, NTNDArray, NTScalar
from p4p.server import Server, StaticProvider
from p4p.server.thread import SharedPV

IMAGE = "Pva1:Image"
SHAPE = (16, 24)
_ATTRIBUTE = {"name": "", "descriptor": "", "sourceType": 0, "source": ""}


def counts_of(unique_id: int, shape: tuple[int, int] = SHAPE) -> NDArray[np.uint16]:
    """The pixels of a frame, by its number."""
    return np.random.default_rng(unique_id).integers(1000, 1400, shape).astype(np.uint16)


def array_value(
    counts: NDArray[Any],
    unique_id: int,
    attributes: Mapping[str, Any] | None = None,
    seconds: float | None = None,
    **changed: Any,
) -> Any:
    """An NTNDArray as areaDetector sends it. `changed`: fields of it, such as codec."""
    value = NTNDArray().wrap(counts)
    value.uniqueId = unique_id
    now = time.time() if seconds is None else seconds
    value.timeStamp = {"secondsPastEpoch": int(now), "nanoseconds": int(now % 1 * 1e9), "userTag": 0}
    given = {"ColorMode": 0, **(attributes or {})}
    value.attribute = [{**_ATTRIBUTE, "name": name, "value": each} for name, each in given.items()]
    for name, each in changed.items():
        setattr(value, name, each)
    return value


PLUGIN: dict[str, float | str] = {
    "Pva1:NDArrayPort_RBV": "CAM", "Pva1:EnableCallbacks_RBV": "Enable", "Pva1:MinCallbackTime_RBV": 0.0,
    "Pva1:DroppedArrays_RBV": 0.0, "Pva1:ArrayCounter_RBV": 0.0, "Pva1:QueueFree": 20.0,
}  # fmt: skip
CAMERA: dict[str, float | str] = {
    "cam1:PortName_RBV": "CAM", "cam1:Acquire_RBV": "Done", "cam1:DetectorState_RBV": "Idle",
    "cam1:ArrayCallbacks_RBV": "Enable", "cam1:NumImagesCounter_RBV": 0.0, "cam1:ArrayCounter_RBV": 0.0,
    "cam1:AcquireTime_RBV": 0.02, "cam1:AcquirePeriod_RBV": 0.05, "cam1:BinX_RBV": 1.0, "cam1:BinY_RBV": 1.0,
}  # fmt: skip
TOMOSCAN: dict[str, float | str] = {
    "ScanStatus": "Scan complete", "FrameType": "Projection", "RotationStart": 10.0, "RotationStep": 0.5,
    "NumAngles": 8.0, "NumDarkFields": 3.0, "DarkFieldMode": "Start", "NumFlatFields": 4.0, "FlatFieldMode": "Both",
    "ExposureTime": 0.03, "FlatExposureTime": 0.01, "DifferentFlatExposure": "Different",
}  # fmt: skip
MODES = ("Start", "End", "Both", "None")
_CHOICES = {
    "FrameType": ("DarkField", "FlatField", "Projection"), "DarkFieldMode": MODES, "FlatFieldMode": MODES,
    "DifferentFlatExposure": ("Same", "Different"),
}  # fmt: skip


class FakeIoc:
    """Serves PREFIXPva1:Image, the records of its plugin, and one for each name that is put.

    Args:
        camera: those of the camera, too.
    """

    def __init__(self, prefix: str = "T:", *, camera: bool = False) -> None:
        self.prefix, self._provider, self._records = prefix, StaticProvider("fake"), dict[str, SharedPV]()
        self._image = SharedPV(initial=NTNDArray().wrap(np.zeros(SHAPE, np.uint16)))
        self._provider.add(prefix + IMAGE, self._image)
        self.put({**PLUGIN, **(CAMERA if camera else {})})
        self._server = Server(providers=[self._provider])

    @property
    def url(self) -> str:
        return f"pva://{self.prefix}{IMAGE}"

    def put(self, values: Mapping[str, float | str], seconds: float | None = None) -> None:
        """Set records; of enumerations a value is a label. `seconds`: the time that they state; None: now."""
        stamp = time.time() if seconds is None else seconds
        for name, value in values.items():
            labels = _CHOICES.get(name.rpartition(":")[2])
            kind = NTEnum() if labels else NTScalar("s" if isinstance(value, str) else "d")
            wrapped = {"index": labels.index(str(value)), "choices": [*labels]} if labels else value
            if name in self._records:
                self._records[name].post(wrapped, timestamp=stamp)
            else:
                self._records[name] = SharedPV(nt=kind, initial=wrapped, timestamp=stamp)
                self._provider.add(self.prefix + name, self._records[name])

    def post(self, value: Any) -> None:
        """Send an NTNDArray."""
        self._image.post(value)

    def tomoscan(self, **values: float | str) -> None:
        """Set tomoscan's records."""
        self.put({f"TomoScan:{name}": value for name, value in values.items()})

    def send(self, ids: range, period: float = 0.01, attributes: Mapping[str, Any] | None = None) -> None:
        """Send frames of these numbers, whose pixels follow from them."""
        for unique_id in ids:
            self.post(array_value(counts_of(unique_id), unique_id, attributes))
            time.sleep(period)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.stop()
