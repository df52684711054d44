"""Settings of a PI GCS 2.0 stage; the controller takes them as they are, in degrees."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from enum import StrEnum

from drivers.base.protocols import StageLimits
from drivers.stages.pi_gcs.train import PiFirstPulse
from drivers.stages.settings import StageFigures, Wiring, key

SLOWEST = 1e-6
"""Least degrees/s that can be written."""
AXIS_NAME = r"^\w{1,16}$"


class Reference(StrEnum):
    """The target of the search for the reference."""

    SWITCH = "switch"
    NEGATIVE_LIMIT = "negative_limit"
    POSITIVE_LIMIT = "positive_limit"

    @property
    def command(self) -> str:
        return {"switch": "FRF", "negative_limit": "FNL", "positive_limit": "FPL"}[self]


@dataclass(frozen=True)
class PiGcsSettings:
    """Physik Instrumente controller that talks GCS 2.0, with triggers from CTO and TRO, such as a C-863.

    The axis is named as SAI? lists it. `firmware_pulse` is from memory; trains need equal pauses between pulses. A
    servo holds to a few counts, hence the tolerance.

    Raises:
        ValueError: a speed or acceleration that cannot be written, or a pulse width, which the firmware fixes.
    """

    figures: StageFigures
    wiring: Wiring = field(default=Wiring())
    axis: str = key("1", "1 to 16 letters, digits and _", pattern=AXIS_NAME)
    serial: str | None = key(None, "Its serial number, as in *IDN?: another device is refused; null: any is taken.")
    trigger_line: int = key(1, "Digital output that the trigger pulses come from.", gt=0)
    reference: Reference = key(Reference.SWITCH, "What the search for the reference goes to.")
    first_pulse: PiFirstPulse = key(
        PiFirstPulse.AT_THRESHOLD,
        "Where the firmware puts a train's first pulse; not documented, to be found out once (docs/hardware.md).",
    )
    firmware_pulse: float = key(50e-6, "How long the firmware holds a pulse.", unit="s", gt=0)
    tolerance: int = key(10, "From the target, within which a move has arrived.", unit="counts", ge=0)
    settle: float = key(
        1.0, "After a move, in which the controller may still bring the axis on target.", unit="s", ge=0
    )

    def __post_init__(self) -> None:
        if self.wiring.pulse_width is not None:
            raise ValueError("pulse_width_s cannot be set: the firmware of a pi_gcs controller fixes it; set null")
        if not re.fullmatch(AXIS_NAME, self.axis):
            raise ValueError(f"axis {self.axis!r} is not a legal name; expected 1 to 16 letters, digits and _")
        self.limits()

    @property
    def pulse_output(self) -> int:
        return self.trigger_line

    def limits(self) -> StageLimits:
        """See `StageSettings`. If the first pulse comes a step after the threshold, the stage must stand more than a
        step before it. The pause between pulses is as long as a pulse.
        """
        figures = self.figures
        if min(math.degrees(figures.max_speed), math.degrees(figures.acceleration)) < SLOWEST:
            raise ValueError(f"speed and acceleration must be {SLOWEST:g} deg/s, deg/s² or more")
        run_up = 1 if self.first_pulse is PiFirstPulse.STEP_AFTER else 0
        spacing = 2 * self.firmware_pulse
        return figures.limits(figures.acceleration, spacing, run_up=run_up, tolerance=self.tolerance)
