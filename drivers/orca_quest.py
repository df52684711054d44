"""ORCA-Quest data sheet: limits of settings and timing, for planning without a camera.

C15550-20UP (ORCA-Quest): limits and line times from the vendor's property table. C15550-22UP (ORCA-Quest 2) has the
same sensor. Its line time in ultra quiet follows from 25.4 full frames a second. No public source states that of photon
number resolving; the same is assumed. The values of a connected camera take precedence. Two rows are read together
in one line time, so row r starts r / 2 line times after row 0.
"""

from __future__ import annotations

from types import MappingProxyType

from drivers.base.protocols import CameraSettings, CameraTiming
from recon.base.registry import unknown

SENSOR_SHAPE = (2304, 4096)
PITCH_MM = 4.6e-3
BITS = 16
ROI_STEP = 4
BINNINGS = (1, 2, 4)
MODEL = "C15550-20UP"
LINE_TIME = MappingProxyType({"standard": 7.2e-6, "ultra_quiet": 172.8e-6, "photon_number": 172.8e-6})
"""s for two rows; also the shortest exposure. Photon number resolving reads as slowly as ultra quiet."""
LINE_TIMES = MappingProxyType(
    {MODEL: LINE_TIME, "C15550-22UP": {"standard": 7.2e-6, "ultra_quiet": 34.0e-6, "photon_number": 34.0e-6}}
)
"""By model."""
MAX_EXPOSURE = 1800.0
FRAME_OVERHEAD_LINES = 5
"""Line times between two frames: with the 1152 lines of a frame they give the standard mode's 120 frames/s."""
LINK_BYTES_PER_S = MappingProxyType({"usb3": 4096 * 2304 * 2 * 17.6996, "coaxpress": 4096 * 2304 * 2 * 120.04})
"""Computed from the full-frame 16-bit frame rates of the two interfaces."""


def refusal(settings: CameraSettings, model: str = MODEL) -> str:
    """Reason for which the camera would refuse the settings, with the legal values; "" if it takes them."""
    if settings.readout not in LINE_TIME:
        return unknown("readout", settings.readout, LINE_TIME)
    if settings.binning not in BINNINGS:
        return f"binning {settings.binning} is not offered; legal: {', '.join(map(str, BINNINGS))}"
    shortest = LINE_TIMES[model][settings.readout]
    if not shortest <= settings.exposure <= MAX_EXPOSURE:
        return f"exposure {settings.exposure:g} s lies outside {shortest:g} ... {MAX_EXPOSURE:g} s ({settings.readout})"
    row0, col0, rows, cols = settings.roi or (0, 0, *SENSOR_SHAPE)
    if any(value % ROI_STEP for value in (row0, col0, rows, cols)):
        return f"roi {[row0, col0, rows, cols]} must be in steps of {ROI_STEP} pixels"
    if not (0 <= row0 < row0 + rows <= SENSOR_SHAPE[0] and 0 <= col0 < col0 + cols <= SENSOR_SHAPE[1]):
        return (
            f"roi {[row0, col0, rows, cols]} (row0, col0, rows, cols) does not lie on the sensor of "
            f"{SENSOR_SHAPE[0]} x {SENSOR_SHAPE[1]}"
        )
    return ""


def timing(settings: CameraSettings, link: str = "usb3", model: str = MODEL) -> CameraTiming:
    """Frame shape and timing under external or software triggers: readout does not overlap the next exposure.

    The shortest period is exposure + readout, or the transfer time of a frame if that is longer.

    Raises:
        ValueError: the camera would refuse the settings.
    """
    if problem := refusal(settings, model):
        raise ValueError(problem)
    _, _, rows, cols = settings.roi or (0, 0, *SENSOR_SHAPE)
    shape = (rows // settings.binning, cols // settings.binning)
    line = LINE_TIMES[model][settings.readout]
    readout = rows / 2 * line
    transfer = shape[0] * shape[1] * 2 / LINK_BYTES_PER_S[link]
    return CameraTiming(
        shape=shape,
        min_period=max(settings.exposure + readout + FRAME_OVERHEAD_LINES * line, transfer),
        readout=readout,
        row_period=line / 2 * settings.binning,
        bits=BITS,
    )
