"""The process variables of tomoscan by Channel Access (caproto), as a program. Lines NAME=VALUE on stdin set them."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from caproto import ChannelType
from caproto.server import PVGroup, pvproperty, run

MODES = ["Start", "End", "Both", "None"]


def _choice(first: str, labels: list[str]) -> Any:
    return pvproperty(value=first, dtype=ChannelType.ENUM, enum_strings=labels)


class Tomoscan(PVGroup):  # type: ignore[misc]  # caproto has no types
    """As tomoscan.template: ScanStatus is an array of characters."""

    ScanStatus = pvproperty(value=b"Scan complete", dtype=ChannelType.CHAR, max_length=256)
    FrameType = _choice("Projection", ["DarkField", "FlatField", "Projection"])
    RotationStart = pvproperty(value=10.0)
    RotationStep = pvproperty(value=0.5)
    NumAngles = pvproperty(value=8)
    NumDarkFields = pvproperty(value=3)
    DarkFieldMode = _choice("Start", MODES)
    NumFlatFields = pvproperty(value=4)
    FlatFieldMode = _choice("Both", MODES)
    ExposureTime = pvproperty(value=0.03)
    FlatExposureTime = pvproperty(value=0.01)
    DifferentFlatExposure = _choice("Different", ["Same", "Different"])

    async def _listen(self, instance: Any, library: Any) -> None:
        while line := await asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline):
            name, _, value = line.strip().partition("=")
            given: Any = value
            if name == "ScanStatus":
                given = value.encode()
            elif name.startswith("Rotation"):
                given = float(value)
            await getattr(self, name).write(given)

    RotationStart.startup(_listen)


if __name__ == "__main__":
    run(Tomoscan(prefix=sys.argv[1]).pvdb, interfaces=["127.0.0.1"], log_pv_names=False)
