"""Options of a DCAM camera beyond CameraSettings: response to trigger pulses, and correction of counts.

They are fixed for the life of a driver. The defaults suit a fly scan whose stage sends one short rising pulse a view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


class TriggerActive(StrEnum):
    """How an external pulse controls the exposure.

    EDGE starts an exposure of the set length. LEVEL exposes for as long as the pulse lasts. SYNC_READOUT ends one
    exposure and starts the next without dead time: the first pulse only starts one, so n pulses give n - 1 frames.
    """

    EDGE = "edge"
    LEVEL = "level"
    SYNC_READOUT = "sync_readout"


class TriggerMode(StrEnum):
    """NORMAL: one frame a pulse. START: the first pulse starts a free run, later pulses have no effect."""

    NORMAL = "normal"
    START = "start"


class TriggerPolarity(StrEnum):
    """The active edge (or level). A camera that was just switched on is set to NEGATIVE."""

    POSITIVE = "positive"
    NEGATIVE = "negative"


class GlobalExposure(StrEnum):
    """When rows start to expose after a pulse.

    DELAYED: one after the other (rolling shutter). GLOBAL_RESET: all at once; since they are read one after the other,
    later rows are exposed for longer unless the light is shut off.
    """

    DELAYED = "delayed"
    GLOBAL_RESET = "global_reset"


class HotPixelMode(StrEnum):
    """Sensitivity of the camera's own correction of hot pixels."""

    MINIMUM = "minimum"
    STANDARD = "standard"
    AGGRESSIVE = "aggressive"


@dataclass(frozen=True)
class DcamOptions:
    """Options of a `DcamCamera`.

    trigger_active, _mode, _times and _delay apply to external triggers; a software trigger always gives one frame of
    the set exposure. With LEVEL or SYNC_READOUT the pulses set the exposure. The exposure in CameraSettings must still
    equal their length (or distance), since the time of the first frame of a run is computed from it.

    Attributes:
        trigger_active, trigger_mode, trigger_polarity, global_exposure: see the types.
        trigger_times: number of pulses for one frame, 1 to 10 000.
        trigger_delay: s from a pulse to the exposure, 0 to 10 in steps of 1 us; frames carry the time of the pulse.
        hot_pixels: None: counts as measured; else the camera corrects hot pixels with this sensitivity.
        exposure_tolerance: fraction of the exposure, added to one line time, by which the camera may round it.
        ring_bytes: most memory for the ring of frames; one full 16-bit frame of an ORCA-Quest takes 18.9 MB.

    Raises:
        ValueError: a number outside its range.
    """

    trigger_active: TriggerActive = TriggerActive.EDGE
    trigger_mode: TriggerMode = TriggerMode.NORMAL
    trigger_polarity: TriggerPolarity = TriggerPolarity.POSITIVE
    global_exposure: GlobalExposure = GlobalExposure.DELAYED
    trigger_times: int = 1
    trigger_delay: float = 0.0
    hot_pixels: HotPixelMode | None = None
    exposure_tolerance: float = 0.01
    ring_bytes: int = 1 << 30

    def __post_init__(self) -> None:
        if not 1 <= self.trigger_times <= 10_000:
            raise ValueError(f"trigger_times must be 1 to 10000, not {self.trigger_times}")
        if not 0 <= self.trigger_delay <= 10:  # also refuses NaN
            raise ValueError(f"trigger_delay must be 0 to 10 s, not {self.trigger_delay}")
        if not (math.isfinite(self.exposure_tolerance) and self.exposure_tolerance >= 0):
            raise ValueError(f"exposure_tolerance is a fraction of 0 or more, not {self.exposure_tolerance}")
        if self.ring_bytes < 1:
            raise ValueError(f"ring_bytes must be positive, not {self.ring_bytes}")
