"""Settings of a PI GCS 2.0 stage, in degrees as the controller uses them, and its trigger pulse trains.

Trains use trigger mode 0 (PositionDistance). The controller gives a pulse at each step between the thresholds if the
stage entered through the start threshold. The stop threshold is half an interval after the last pulse, so that it does
not matter whether there is a pulse at the threshold itself. No manual states the position of the first pulse. We
assume, from memory, that it is at the start threshold; see `PiFirstPulse`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction

from drivers.base.protocols import StageLimits, TriggerTrain
from drivers.stages.settings import StageFigures, Wiring
from recon.base.setting import setting

PULLED_APART = Fraction(1, 10)
"""Largest error of the last pulse, in intervals, if the controller rounds the step in its reply. It is not known
whether the controller also uses the rounded step; a smaller error does not affect an image.
"""


class PiFirstPulse(StrEnum):
    """Position of the first pulse of a train, which depends on the firmware.

    To find it, arm 3 pulses, pass them, and count.
    """

    AT_THRESHOLD = "at_threshold"
    """The first pulse is at the start threshold, which is set to the position of the first pulse."""
    STEP_AFTER = "step_after"
    """The first pulse is one step after the start threshold, which is set one interval before the first pulse."""
    GRID = "grid"
    """Pulses are at whole steps from position 0 inside the window. The window begins half an interval before the first
    pulse, and trains must begin at a whole number of intervals.
    """


@dataclass(frozen=True)
class TriggerWindow:
    """Trigger window in counts: distance of pulses, begin and end, and the allowed error of a step.

    The error adds up over the train. The stage must be at rest before the window.
    """

    step: Fraction
    start: Fraction
    stop: Fraction
    step_tolerance: Fraction


def window_of(train: TriggerTrain, first_pulse: PiFirstPulse) -> TriggerWindow:
    """The window for a train of at least one pulse and an interval that is not 0.

    Raises:
        ValueError: this firmware cannot send pulses at these positions.
    """
    sign = 1 if train.interval > 0 else -1
    # If a controller rounds both thresholds to the same count, the window of a single pulse is empty.
    alone = train.n == 1 and first_pulse is not PiFirstPulse.GRID
    step = max(abs(train.interval), 2) if alone else abs(train.interval)
    if first_pulse is PiFirstPulse.GRID and train.start % step:
        raise ValueError(
            f"this controller sends pulses only at integer multiples of {step} counts, but the first pulse is at "
            f"{train.start} counts"
        )
    before = {PiFirstPulse.AT_THRESHOLD: Fraction(0), PiFirstPulse.STEP_AFTER: Fraction(step)}
    lead = before.get(first_pulse, Fraction(step, 2))
    tolerance = min(Fraction(1, 2), PULLED_APART * step / max(train.n - 1, 1))
    return TriggerWindow(Fraction(step), train.start - sign * lead, train.end + Fraction(sign * step, 2), tolerance)


def is_spent_by(train: TriggerTrain, here: int, target: int) -> bool:
    """True if the train must be disarmed for a move from `here` to `target` (counts).

    Either the train was emitted, and passing it would emit it again. Or it has begun, and moving back would give
    pulses.
    """
    sign = 1 if train.interval > 0 else -1
    started, passed = sign * (here - train.start) >= 0, sign * (here - train.end) >= 0
    return passed or (started and sign * (target - here) < 0)


SLOWEST = 1e-6
"""Smallest degrees/s that can be written."""
AXIS_NAME = r"^\w{1,16}$"


class Reference(StrEnum):
    """The target of the search for the reference."""

    SWITCH = "switch"
    NEGATIVE_LIMIT = "negative_limit"
    POSITIVE_LIMIT = "positive_limit"

    @property
    def command(self) -> str:
        return {"switch": "FRF", "negative_limit": "FNL", "positive_limit": "FPL"}[self]


@dataclass(frozen=True, kw_only=True)
class PiGcsSettings(Wiring, StageFigures):
    """Physik Instrumente controller with the command language GCS 2.0 and triggers by CTO and TRO, such as a C-863.

    The axis has the name that SAI? lists. `firmware_pulse` is from memory; trains need pauses between pulses that are
    as long. A servo holds a position to a few counts, which is the reason for the tolerance.

    Raises:
        ValueError: a speed or acceleration cannot be written, or a pulse width is given, which the firmware fixes.
    """

    axis: str = setting("1", "1 to 16 letters, digits and _", pattern=AXIS_NAME)
    serial: str | None = setting(
        None,
        "Serial number of the controller, as in *IDN?; the driver stops with an error if another device answers. "
        "null: accept any.",
    )
    trigger_line: int = setting(1, "Digital output of the trigger pulses.", gt=0)
    reference: Reference = setting(Reference.SWITCH, "Switch at which the search for the reference ends.")
    first_pulse: PiFirstPulse = setting(
        PiFirstPulse.AT_THRESHOLD,
        "Where the firmware puts the first pulse of a series. The manual does not say where; measure the place once "
        "(docs/hardware.md).",
    )
    firmware_pulse: float = setting(50e-6, "Pulse width of the firmware.", unit="s", gt=0)
    tolerance: int = setting(
        10, "Largest distance from the target, in counts, at which a move counts as finished.", unit="counts", ge=0
    )
    settle: float = setting(
        1.0,
        "Time in s that the driver waits after a move, because the controller may still settle on the target.",
        unit="s",
        ge=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pulse_width is not None:
            raise ValueError(
                "pulse_width_s cannot be set: the firmware of a pi_gcs controller fixes the pulse "
                "width; set pulse_width_s to null"
            )
        self.limits()

    @property
    def pulse_output(self) -> int:
        return self.trigger_line

    def limits(self) -> StageLimits:
        """See `StageSettings`.

        If the first pulse is one step after the threshold, the stage must be more than a step before the first pulse.
        The pause between pulses is as long as a pulse.
        """
        if min(math.degrees(self.max_speed), math.degrees(self.acceleration)) < SLOWEST:
            raise ValueError(f"speed and acceleration must be {SLOWEST:g} deg/s, deg/s² or more")
        run_up = 1 if self.first_pulse is PiFirstPulse.STEP_AFTER else 0
        spacing = 2 * self.firmware_pulse
        return self.limits_with(self.acceleration, spacing, run_up=run_up, tolerance=self.tolerance)
