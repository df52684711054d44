"""Options of a DCAM camera: how it takes triggers and what it does to its counts, beyond what every camera is asked.

They hold for the life of a driver. The defaults are those of a fly scan whose stage gives a short rising pulse a view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


class TriggerActive(StrEnum):
    """What of an external pulse counts.

    EDGE begins an exposure of the set length. LEVEL exposes while the pulse lasts. SYNC_READOUT ends one exposure and
    begins the next, without dead time: the first pulse only begins, so that n pulses give n - 1 frames.
    """

    EDGE = "edge"
    LEVEL = "level"
    SYNC_READOUT = "sync_readout"


class TriggerMode(StrEnum):
    """NORMAL: a pulse is a frame. START: the first pulse begins a free run, and the later ones do nothing."""

    NORMAL = "normal"
    START = "start"


class TriggerPolarity(StrEnum):
    """The edge (or level) that counts. A camera that was just switched on takes NEGATIVE."""

    POSITIVE = "positive"
    NEGATIVE = "negative"


class GlobalExposure(StrEnum):
    """Which rows a pulse begins to expose.

    DELAYED: one after the other (rolling shutter). GLOBAL_RESET: all at once, and as they are read one after the other,
    later rows expose longer unless the light is cut.
    """

    DELAYED = "delayed"
    GLOBAL_RESET = "global_reset"


class HotPixels(StrEnum):
    """How much the correction of defects takes for a hot pixel."""

    MINIMUM = "minimum"
    STANDARD = "standard"
    AGGRESSIVE = "aggressive"


@dataclass(frozen=True)
class DcamOptions:
    """What a DcamCamera is made with.

    What says how pulses are taken (active, mode, times, delay) holds for external triggers; a software trigger is
    always one frame of the set exposure. With LEVEL or SYNC_READOUT pulses make the exposure: set the camera's exposure
    to their length (or distance) all the same, for the first frame of a run is dated by it.

    Attributes:
        trigger_active, trigger_mode, trigger_polarity, global_exposure: see there.
        trigger_times: every so many pulses make one frame (1: each; up to 10 000).
        trigger_delay: s from a pulse to the exposure (0 to 10, in steps of 1 us); frames keep the time of the pulse.
        hot_pixels: None takes counts as they are measured; else the camera repairs defects, with this sensitivity.
        exposure_tolerance: fraction (besides one line time) by which the camera may change an exposure.
        ring_bytes: most memory for the ring; a full 16-bit frame of an ORCA-Quest has 18.9 MB.

    Raises:
        ValueError: a number outside its range.
    """

    trigger_active: TriggerActive = TriggerActive.EDGE
    trigger_mode: TriggerMode = TriggerMode.NORMAL
    trigger_polarity: TriggerPolarity = TriggerPolarity.POSITIVE
    global_exposure: GlobalExposure = GlobalExposure.DELAYED
    trigger_times: int = 1
    trigger_delay: float = 0.0
    hot_pixels: HotPixels | None = None
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
