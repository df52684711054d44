"""ORCA-Quest: limits of its settings, its timing from the data sheet (for planning without a camera), and its options.

C15550-20UP (ORCA-Quest): limits and line times from the vendor's property table. C15550-22UP (ORCA-Quest 2) has the
same sensor. Its line time in ultra quiet mode follows from 25.4 full frames per second. No public source states the
line time for photon number resolving; it is assumed to be the same. The values of a connected camera take precedence.
Two rows are read together in one line time, so row r starts r / 2 line times after row 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from drivers.base.protocols import CameraSettings, CameraTiming
from recon.base.registry import unknown
from recon.base.setting import CheckedSettings, setting

SENSOR_SHAPE = (2304, 4096)
PITCH_MM = 4.6e-3
BITS = 16
ROI_STEP = 4
BINNINGS = (1, 2, 4)
MODEL = "C15550-20UP"
LINE_TIME = MappingProxyType({"standard": 7.2e-6, "ultra_quiet": 172.8e-6, "photon_number": 172.8e-6})
"""Line time in s for two rows, which is also the shortest exposure. The mode for photon number resolving is as slow as
ultra quiet."""
LINE_TIMES = MappingProxyType(
    {MODEL: LINE_TIME, "C15550-22UP": {"standard": 7.2e-6, "ultra_quiet": 34.0e-6, "photon_number": 34.0e-6}}
)
"""Line times for each model."""
MAX_EXPOSURE = 1800.0
FRAME_OVERHEAD_LINES = 5
"""Number of line times between two frames.

With the 1152 lines of a frame, they give the 120 frames/s of the standard mode.
"""
LINK_BYTES_PER_S = MappingProxyType({"usb3": 4096 * 2304 * 2 * 17.6996, "coaxpress": 4096 * 2304 * 2 * 120.04})
"""Transfer rates, computed from the full-frame 16-bit frame rates of the two interfaces."""

QE_NM = (300, 350, 400, 425, 450, 475, 500, 550, 600, 650, 700, 750, 800, 850, 900, 950, 1000)
QE = (0.50, 0.66, 0.80, 0.83, 0.85, 0.83, 0.80, 0.70, 0.62, 0.55, 0.50, 0.46, 0.40, 0.33, 0.30, 0.20, 0.09)
"""Quantum efficiency of ORCA-Quest 2 at QE_NM, read off the catalogue's figure.

At 600 to 800 nm it may be 0.1 to 0.15 too low.
"""


def quantum_efficiency(wavelength_nm: float) -> float:
    """Photoelectrons per photon of light, linear between the points of the curve."""
    return float(np.interp(wavelength_nm, QE_NM, QE))


@dataclass(frozen=True)
class LightPath:
    """The path from X-ray photons to photoelectrons: screen, lenses and mirror behind it, and sensor.

    Attributes:
        absorbed: share of the X-ray photons that the screen stops.
        light: photons of light per stopped X-ray photon: its energy in keV times the yield of the screen.
        aperture: numerical aperture of the objective on the side of the screen.
        index: refractive index of the screen.
        transmission: transmission of lenses, mirror and windows together.
        wavelength_nm: wavelength of the light.
    """

    absorbed: float
    light: float
    aperture: float
    index: float = 1.84
    transmission: float = 0.9
    wavelength_nm: float = 535.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("absorbed", 1e-6, 1.0), ("light", 1e-3, 1e6), ("aperture", 1e-3, 0.999), ("index", 1.0, 4.0),
            ("transmission", 1e-6, 1.0), ("wavelength_nm", QE_NM[0], QE_NM[-1]),
        ):  # fmt: skip
            if not low <= (value := getattr(self, name)) <= high:
                raise ValueError(f"{name} must be {low:g} ... {high:g}, got {value:g}")

    @property
    def collected(self) -> float:
        """Share of the light that the objective collects: a cone on one side of the screen."""
        return (1 - math.sqrt(1 - (self.aperture / self.index) ** 2)) / 2

    @property
    def electrons(self) -> float:
        """Photoelectrons per X-ray photon that the screen stops."""
        return self.light * self.collected * self.transmission * quantum_efficiency(self.wavelength_nm)

    def x_rays_per_count(self, gain: float) -> float:
        """Number of X-ray photons at the screen per count.

        Args:
            gain: counts per photoelectron as measured by photon transfer. If `electrons` arrive together, the variance
                is 1 + electrons times the variance for single electrons.
        """
        return (1 + self.electrons) / (gain * self.absorbed * self.electrons)


def refusal(settings: CameraSettings, model: str = MODEL) -> str:
    """The reason why the camera would reject the settings, with the legal values; "" if it would accept them."""
    if settings.readout not in LINE_TIME:
        return unknown("readout", settings.readout, LINE_TIME)
    if settings.binning not in BINNINGS:
        return f"binning {settings.binning} does not exist; legal: {', '.join(map(str, BINNINGS))}"
    shortest = LINE_TIMES[model][settings.readout]
    if not shortest <= settings.exposure <= MAX_EXPOSURE:
        return f"exposure {settings.exposure:g} s is outside {shortest:g} ... {MAX_EXPOSURE:g} s ({settings.readout})"
    row0, col0, rows, cols = settings.roi or (0, 0, *SENSOR_SHAPE)
    if any(value % ROI_STEP for value in (row0, col0, rows, cols)):
        return f"roi {[row0, col0, rows, cols]} must be in steps of {ROI_STEP} pixels"
    if not (0 <= row0 < row0 + rows <= SENSOR_SHAPE[0] and 0 <= col0 < col0 + cols <= SENSOR_SHAPE[1]):
        return (
            f"roi {[row0, col0, rows, cols]} (row0, col0, rows, cols) extends beyond the sensor of "
            f"{SENSOR_SHAPE[0]} x {SENSOR_SHAPE[1]}"
        )
    return ""


def timing(settings: CameraSettings, link: str = "usb3", model: str = MODEL) -> CameraTiming:
    """Frame shape and timing with external or software triggers. The readout does not overlap the next exposure.

    The shortest period is exposure + readout, or the transfer time of a frame if that is longer.

    Raises:
        ValueError: the camera would reject the settings.
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


class TriggerActive(StrEnum):
    """How an external pulse controls the exposure.

    EDGE: the pulse starts an exposure of the set length. LEVEL: the exposure lasts as long as the pulse. SYNC_READOUT:
    a pulse ends one exposure and starts the next without dead time. The first pulse only starts an exposure, so n
    pulses give n - 1 frames.
    """

    EDGE = "edge"
    LEVEL = "level"
    SYNC_READOUT = "sync_readout"


class TriggerMode(StrEnum):
    """NORMAL: one frame per pulse. START: the first pulse starts a free run, and later pulses have no effect."""

    NORMAL = "normal"
    START = "start"


class TriggerPolarity(StrEnum):
    """The active edge (or level). A camera that was just switched on is set to NEGATIVE."""

    POSITIVE = "positive"
    NEGATIVE = "negative"


class GlobalExposure(StrEnum):
    """Way in which the rows start to expose after a pulse.

    DELAYED: one after the other (rolling shutter). GLOBAL_RESET: all together. Because rows are read one after the
    other, later rows are then exposed longer, unless the light is shut off.
    """

    DELAYED = "delayed"
    GLOBAL_RESET = "global_reset"


class HotPixelMode(StrEnum):
    """Sensitivity of the camera's built-in correction of hot pixels."""

    MINIMUM = "minimum"
    STANDARD = "standard"
    AGGRESSIVE = "aggressive"


@dataclass(frozen=True)
class DcamOptions(CheckedSettings):
    """Options of a `DcamCamera`.

    trigger_active, _mode, _times and _delay apply to external triggers. A software trigger always gives one frame with
    the set exposure. With LEVEL or SYNC_READOUT the pulses set the exposure. The exposure in CameraSettings must still
    equal their length (or distance), because the time of the first frame of a run is computed from it.

    Raises:
        ValueError: a number is outside its range.
    """

    trigger_active: TriggerActive = setting(
        TriggerActive.EDGE,
        "edge: a pulse starts an exposure of exposure_s. level: the exposure lasts as long as the pulse; set "
        "exposure_s to the length of the pulse. sync_readout: a pulse ends an exposure and starts the next; n pulses "
        "give n - 1 frames, so fly scans do not allow it.",
    )
    trigger_mode: TriggerMode = setting(
        TriggerMode.NORMAL, "start: the first pulse starts a free run, so fly scans do not allow it."
    )
    trigger_polarity: TriggerPolarity = setting(
        TriggerPolarity.POSITIVE,
        "Edge of the trigger pulse that starts an exposure. A camera that was just switched on uses "
        "negative; the driver sets the value given here.",
    )
    trigger_times: int = setting(1, "Number of pulses per frame; a fly scan needs 1.", ge=1, le=10_000)
    trigger_delay: float = setting(
        0.0,
        "Delay in s from a pulse to the exposure. The angle in the file remains the angle at the pulse.",
        unit="s",
        ge=0,
        le=10,
    )
    global_exposure: GlobalExposure = setting(
        GlobalExposure.DELAYED,
        "delayed: rolling shutter. global_reset: all rows start together, and later rows are exposed "
        "longer unless the beam is cut off.",
    )
    hot_pixels: HotPixelMode | None = setting(
        None,
        "null: counts as measured. With a value, the camera replaces the counts of pixels that it takes for "
        "defective, which alters the data. The value says how many pixels the camera takes for defective.",
    )
    exposure_tolerance: float = setting(
        0.01,
        "The driver stops with an error if the camera changes an exposure by more than this fraction plus one "
        "line time.",
        ge=0,
    )
    ring: int = setting(
        1000, "Memory limit of the ring buffer in MB; a full frame has 18.9 MB.", unit="mb", gt=0, le=1_000_000
    )
