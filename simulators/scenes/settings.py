"""Settings: detector and scan of a scene that is simulated without a configured instrument."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from drivers.orca_quest import BINNINGS, SENSOR_SHAPE

MOST_FRAMES = 1_000_000  # as in a configuration
LONGEST = 1e6  # s


@dataclass(frozen=True)
class DetectorSettings:
    """Attributes:
    shape: (rows, cols) of the frame, after binning.
    pixel_size_um: of an unbinned pixel, at the sample.
    exposure_s: of a frame.
    binning: sensor pixels summed per side.
    readout: the camera's mode.
    electrons_per_count: None: the camera's.
    """

    shape: tuple[int, int] = (512, 512)
    pixel_size_um: float = 4.6
    exposure_s: float = 0.05
    binning: int = 1
    readout: Literal["standard", "ultra_quiet", "photon_number"] = "standard"
    electrons_per_count: float | None = None

    def __post_init__(self) -> None:
        if not (min(self.shape) >= 1 and self.pixel_size_um > 0 and self.exposure_s > 0):
            raise ValueError(f"shape, pixel_size_um and exposure_s must be positive, got {self}")
        if not (1e-3 <= self.pixel_size_um <= 1e6 and self.exposure_s <= LONGEST):
            raise ValueError(
                f"pixel_size_um must lie in 0.001 ... 1e6 and exposure_s be {LONGEST:g} at most, got "
                f"{self.pixel_size_um} and {self.exposure_s}"
            )
        if self.binning not in BINNINGS:
            raise ValueError(f"binning must be 1, 2 or 4, got {self.binning}")
        if any(n * self.binning > whole for n, whole in zip(self.shape, SENSOR_SHAPE, strict=True)):
            raise ValueError(
                f"{self.shape} pixels of {self.binning} x {self.binning} do not lie on the sensor of "
                f"{SENSOR_SHAPE[0]} x {SENSOR_SHAPE[1]}"
            )
        if self.electrons_per_count is not None and not self.electrons_per_count > 0:
            raise ValueError(f"electrons_per_count must be positive, got {self.electrons_per_count}")


@dataclass(frozen=True)
class ScanSettings:
    """Attributes:
    views: evenly spaced over the range, its end excluded.
    range_deg: degrees.
    period_s: s from one trigger to the next.
    fly: the stage turns steadily; false: it stands while a view is exposed.
    darks, flats: taken before the views.
    """

    views: int = 180
    range_deg: float = 180.0
    period_s: float = 0.1
    fly: bool = True
    darks: int = 10
    flats: int = 10

    def __post_init__(self) -> None:
        if not (self.views >= 1 and self.period_s > 0 and self.range_deg != 0 and min(self.darks, self.flats) >= 0):
            raise ValueError(f"views and period_s must be positive, range_deg not 0, darks and flats >= 0, got {self}")
        if (
            max(self.views, self.darks, self.flats) > MOST_FRAMES
            or abs(self.range_deg) > 1e6
            or self.period_s > LONGEST
        ):
            raise ValueError(
                f"views, darks and flats must be {MOST_FRAMES} at most each, range_deg 1e6 and period_s {LONGEST:g}, "
                f"got {self}"
            )
