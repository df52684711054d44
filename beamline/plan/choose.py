"""The choices after a pass: their costs, their expected improvements, and the choice that the target requires."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Block, Timeline
from drivers.base.frame import FrameKind
from recon.base.error_law import ErrorLaw, Gain


@dataclass(frozen=True)
class PassOption:
    """A choice, with its costs and the predicted improvement of the PSNR in dB (NaN: no error model is known).

    Attributes:
        frames, seconds, bytes: the costs of the choice. dose: number of exposures of the sample by this choice, as a
            fraction of those in the whole plan.
        low, high: ends of the range of the improvement, as in `recon.base.error_law.Gain`.
    """

    choice: Choice
    frames: int
    seconds: float
    dose: float
    bytes: int
    gain: float
    low: float
    high: float


@dataclass(frozen=True)
class ScanTarget:
    """The targets of a scan. None: there is no such target.

    Attributes:
        quality_db: dB of PSNR by which the volume may be worse than that of the whole plan.
        seconds: longest duration of the scan.
        dose: largest dose, as a fraction of that of the plan.
    """

    quality_db: float | None = None
    seconds: float | None = None
    dose: float | None = None


def frame_dose(timeline: Timeline) -> float:
    """The dose of one frame, as a fraction of that of the whole plan."""
    return 1 / sum(block.n for block in timeline.blocks if block.kind in (FrameKind.PROJECTION, FrameKind.OFFSET_VIEW))


def options(
    passes: Passes, error_law: ErrorLaw | None, timeline: Timeline, seconds_of: Callable[[Block], float]
) -> tuple[PassOption, ...]:
    """The choices that are possible now. ENOUGH is always possible and comes last.

    Args:
        error_law: the error model with `passes.n_frames` as its `n_views`; None: not known.
        seconds_of: function that returns the duration of a block, from the present position of the stage.
    """

    def option(choice: Choice, frames: int, seconds: float, **added: Any) -> PassOption:
        gain = Gain(math.nan, math.nan, math.nan) if error_law is None else error_law.gain(**added)
        cost = frames, seconds, frames * frame_dose(timeline), frames * timeline.total_bytes // timeline.n_frames
        return PassOption(choice, *cost, gain.mean, gain.low, gain.high)

    offered, n = [], passes.retakes
    if passes.to_come:
        following, last = passes.to_come[0], passes.done[-1]
        offered.append(option(Choice.NEXT, following.n_to_take, seconds_of(following), views=following.n_to_take))
        if passes.may_repeat:
            offered.append(option(Choice.AGAIN, last.n_to_take, seconds_of(last), again=last.n_to_take))
    if passes.offset:
        frames, seconds = sum(block.n_to_take for block in passes.offset), sum(map(seconds_of, passes.offset))
        offered.append(option(Choice.OFFSET, frames, seconds, wide=True))
    if n:
        offered.append(option(Choice.RETAKE, n, n * timeline.retake_seconds / timeline.plan.retakes, views=n))
    return (*offered, PassOption(Choice.ENOUGH, 0, 0.0, 0.0, 0, 0.0, 0.0, 0.0))


def choose(
    offered: Sequence[PassOption], target: ScanTarget, remaining: Gain, seconds: float, dose: float
) -> tuple[Choice, str]:
    """The choice with the largest improvement per second, as long as the target is not reached; and the reason for the
    choice.

    It is the next pass of the plan, unless another choice is better by more than the uncertainty of both.

    Args:
        offered: the possible choices, with known improvements.
        remaining: the improvement by the rest of the plan, see `remaining_gain`.
        seconds, dose: time and dose of the scan so far, plus those of the frames that follow the passes in any case:
            laterally offset projections, darks and flats.
    """
    if target.quality_db is not None and remaining.at_most <= target.quality_db:
        return Choice.ENOUGH, (
            f"the remaining projections of the plan would improve the PSNR by {remaining.mean:.2f} dB "
            f"({remaining.low:.2f} to {remaining.high:.2f}); the target accepts a loss of {target.quality_db:g} dB"
        )
    excesses = {option: _excess(option, target, seconds, dose) for option in offered if option.gain > 0}
    allowed = [option for option, excess in excesses.items() if not excess]
    if not allowed:
        return Choice.ENOUGH, next(iter(excesses.values()), "none of the choices would improve the volume")
    best = max(allowed, key=lambda option: option.gain / option.seconds)
    following = next((option for option in allowed if option.choice is Choice.NEXT), best)
    taken = following if best.low / best.seconds <= following.high / following.seconds else best
    return taken.choice, (
        f"{taken.gain:.2f} dB ({taken.low:.2f} to {taken.high:.2f}) in {taken.seconds:.0f} s; no other choice gains "
        "significantly more dB per second"
    )


def remaining_gain(passes: Passes, error_law: ErrorLaw) -> Gain:
    """The predicted improvement by the rest of the plan."""
    views = sum(block.n_to_take for block in passes.to_come) + passes.retakes
    return replace(error_law, n_views=passes.n_frames).gain(views=views, wide=bool(passes.offset))


def next_is_sure(
    passes: Passes, offered: Sequence[PassOption], target: ScanTarget, error_law: ErrorLaw, seconds: float, dose: float
) -> bool:
    """True if the error model of an earlier pass is enough for the decision. It must choose the next pass; and after
    this pass, the rest of the plan must still be certain to improve the volume by more than the loss that the target
    accepts.
    """
    choice, _ = choose(offered, target, remaining_gain(passes, error_law), seconds, dose)
    later = remaining_gain(passes.after(Choice.NEXT), error_law)
    return choice is Choice.NEXT and (target.quality_db is None or later.low > target.quality_db)


def _excess(option: PassOption, target: ScanTarget, seconds: float, dose: float) -> str:
    """A sentence on the limit of the target that an option would exceed; "" if it exceeds none. (Laterally offset
    projections are taken in any case.)"""
    if option.choice is Choice.OFFSET:
        return ""
    seconds, percent = seconds + option.seconds, 100 * (dose + option.dose)
    if target.seconds is not None and seconds > target.seconds:
        return f"{option.choice} would end the scan after {seconds:.0f} s; the target allows {target.seconds:g} s"
    if target.dose is not None and percent > 100.0000001 * target.dose:  # more than rounding of the sum
        return (
            f"with {option.choice} the scan would take {percent:.3g} % of the plan's dose; the target allows "
            f"{100 * target.dose:g} %"
        )
    return ""
