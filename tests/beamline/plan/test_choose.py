"""Choice of the next measurement: the best gain per second until the target is met, and no further."""

import math
from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from beamline.plan.choose import PassOption, ScanTarget, choose, frame_dose, next_is_sure, options, remaining_gain
from beamline.plan.passes import Choice, Passes, pass_blocks
from beamline.plan.plan import Block, Mode, Timeline
from beamline.plan.timeline import block_seconds
from recon.base.error_law import ErrorLaw, Gain
from tests.beamline.fakes import FakeInstrument

NOTHING = 0.0, 0.0
QUALITY = ScanTarget(quality_db=1.0)
LAW = ErrorLaw(12, 1.0, 0.1, 0.3, 0.2)


def scan(views: int = 48, passes: int = 4, wide: int = 0) -> Timeline:
    instrument = FakeInstrument()
    plan = instrument.plan(views, passes=passes)
    return instrument.worked_out(
        replace(plan, retake_share=0.25, offset_views=wide, offset_places=(-1.0, 1.0)[: 2 * wide])
    )


def seconds_of(block: Block) -> float:
    instrument = FakeInstrument()
    return block_seconds(block, instrument.stage.limits, instrument.camera.timing, 0.05)


def after(timeline: Timeline, n: int, retakes: int = 0) -> Passes:
    blocks, wide = pass_blocks(timeline.views, 0), tuple(block for block in timeline.blocks if block.aside)
    return Passes(blocks[:n], blocks[n:], wide, retakes)


def test_options_are_what_is_possible_with_what_each_takes() -> None:
    timeline = scan(wide=5)
    offered = {option.choice: option for option in options(after(timeline, 1, retakes=3), LAW, timeline, seconds_of)}
    assert list(offered) == [Choice.NEXT, Choice.AGAIN, Choice.OFFSET, Choice.RETAKE, Choice.ENOUGH]
    assert [option.frames for option in offered.values()] == [12, 12, 10, 3, 0]
    assert offered[Choice.NEXT].dose == pytest.approx(12 / 58) and offered[Choice.OFFSET].dose == pytest.approx(10 / 58)
    assert offered[Choice.NEXT].bytes == pytest.approx(12 * timeline.total_bytes / timeline.n_frames, abs=1)
    assert offered[Choice.NEXT].seconds == seconds_of(pass_blocks(timeline.views, 0)[1])
    assert offered[Choice.RETAKE].seconds == pytest.approx(3 / 12 * timeline.retake_seconds)
    gains = {choice: (option.gain, option.low, option.high) for choice, option in offered.items()}
    assert gains == {
        Choice.NEXT: tuple(vars(LAW.gain(views=12)).values()), Choice.AGAIN: tuple(vars(LAW.gain(again=12)).values()),
        Choice.OFFSET: tuple(vars(LAW.gain(wide=True)).values()),
        Choice.RETAKE: tuple(vars(LAW.gain(views=3)).values()),
        Choice.ENOUGH: (0, 0, 0),
    }  # fmt: skip


def test_what_is_not_possible_is_no_option_and_without_a_law_no_gain_is_known() -> None:
    timeline = scan()
    last = options(after(timeline, 4), LAW, timeline, seconds_of)
    assert [option.choice for option in last] == [Choice.ENOUGH]
    unknown = options(after(timeline, 1), None, timeline, seconds_of)
    assert [option.choice for option in unknown] == [Choice.NEXT, Choice.AGAIN, Choice.ENOUGH]
    assert [math.isnan(option.gain) for option in unknown] == [True, True, False]
    instrument = FakeInstrument()
    steps = instrument.timeline(10, Mode.STEP)
    blocks = pass_blocks(steps.views, 4)  # the last one has two views, so four take too much
    offered = options(Passes(blocks[:1], blocks[1:]), LAW, steps, seconds_of)
    assert Choice.AGAIN not in {option.choice for option in offered}


def option(choice: Choice, gain: float, seconds: float = 10.0, off: float = 0.0, dose: float = 0.1) -> PassOption:
    return PassOption(choice, 12, seconds, dose, 10**6, gain, gain - off, gain + off)


NEXT, ENOUGH = option(Choice.NEXT, 1.0, off=0.2), PassOption(Choice.ENOUGH, 0, 0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("offered", "target", "spent", "rest", "chosen", "why"),
    [
        ([NEXT], QUALITY, NOTHING, 1.01, Choice.NEXT, "1.00 dB (0.80 to 1.20) in 10 s"),
        ([NEXT], QUALITY, NOTHING, 1.0, Choice.ENOUGH, "would improve the PSNR by 1.00 dB"),
        ([NEXT], ScanTarget(), NOTHING, 0.1, Choice.NEXT, "1.00 dB"),
        ([NEXT], ScanTarget(seconds=100), (90.0, 0), 9, Choice.NEXT, "1.00 dB"),
        ([NEXT], ScanTarget(seconds=100), (91.0, 0), 9, Choice.ENOUGH, "after 101 s; the target allows 100 s"),
        ([NEXT], ScanTarget(dose=0.5), (0, 0.4), 9, Choice.NEXT, "1.00 dB"),
        ([NEXT], ScanTarget(dose=0.5), (0, 0.41), 9, Choice.ENOUGH, "51 % of the plan's dose; the target allows 50 %"),
        (
            [NEXT],
            ScanTarget(5.0, 100, 1),
            NOTHING,
            2,
            Choice.ENOUGH,
            "the target accepts a loss of 5 dB",
        ),  # whichever is met first
        (
            [NEXT, option(Choice.AGAIN, 1.1)],
            QUALITY,
            NOTHING,
            9,
            Choice.NEXT,
            "no other choice gains significantly more",
        ),
        ([NEXT, option(Choice.AGAIN, 1.2)], QUALITY, NOTHING, 9, Choice.NEXT, "no other choice"),
        ([NEXT, option(Choice.AGAIN, 1.3)], QUALITY, NOTHING, 9, Choice.AGAIN, "1.30 dB"),
        ([NEXT, option(Choice.AGAIN, 1.3, off=0.2)], QUALITY, NOTHING, 9, Choice.NEXT, "no other choice"),
        ([NEXT, option(Choice.OFFSET, 1.0, 5.0)], QUALITY, NOTHING, 9, Choice.OFFSET, "1.00 dB (1.00 to 1.00) in 5 s"),
        ([NEXT, option(Choice.RETAKE, 0.1, 0.5)], QUALITY, NOTHING, 9, Choice.RETAKE, "0.10 dB"),
        # The next pass takes too long, a few retakes do not.
        ([NEXT, option(Choice.RETAKE, 0.01, 1)], ScanTarget(seconds=5), NOTHING, 9, Choice.RETAKE, "0.01 dB"),
        (
            [option(Choice.OFFSET, 0.0)],
            ScanTarget(seconds=99),
            NOTHING,
            0,
            Choice.ENOUGH,
            "none of the choices would improve",
        ),
        (
            [option(Choice.NEXT, 0.0), option(Choice.OFFSET, 1.0)],
            ScanTarget(dose=1),
            NOTHING,
            9,
            Choice.OFFSET,
            "1.00 dB",
        ),
        (
            [option(Choice.OFFSET, 1.0, 5.0)],
            ScanTarget(seconds=99),
            (98.0, 0),
            9,
            Choice.OFFSET,
            "1.00 dB",
        ),  # they come anyway
        ([], ScanTarget(dose=1), NOTHING, 0, Choice.ENOUGH, "none of the choices would improve"),
    ],
)
def test_the_choice_and_its_reason(
    offered: list[PassOption], target: ScanTarget, spent: tuple[float, float], rest: float, chosen: Choice, why: str
) -> None:
    choice, reason = choose([*offered, ENOUGH], target, Gain(rest, rest / 2, 1.5 * rest), *spent)
    assert choice is chosen and why in reason


@pytest.mark.parametrize(("high", "chosen"), [(1.35, Choice.ENOUGH), (1.4, Choice.NEXT), (0.95, Choice.ENOUGH)])
def test_where_no_law_is_known_to_half_of_it_the_scan_ends_only_if_even_its_high_end_is_accepted(
    high: float, chosen: Choice
) -> None:
    assert choose([NEXT, ENOUGH], ScanTarget(1.0), Gain(0.9, 0.05, high), 0.0, 0.0)[0] is chosen
    assert choose([NEXT, ENOUGH], ScanTarget(1.4), Gain(0.9, 0.05, high), 0.0, 0.0)[0] is Choice.ENOUGH


def test_the_rest_is_all_that_the_plan_still_has() -> None:
    timeline = scan(wide=5)
    assert remaining_gain(after(timeline, 1, retakes=3), LAW) == LAW.gain(views=39, wide=True)
    later = after(timeline, 1, retakes=3).after(Choice.NEXT)
    assert remaining_gain(later, LAW) == replace(LAW, n_views=24).gain(views=27, wide=True)
    assert remaining_gain(after(scan(), 4), LAW) == Gain(0, 0, 0)


@pytest.mark.parametrize(
    ("done", "target", "error", "sure"),
    [
        (1, ScanTarget(1.0), 0.1, True),  # after the next one the rest of 24 still adds 2.4 dB at least
        (1, ScanTarget(2.5), 0.1, False),
        (1, ScanTarget(1.0), 0.4, True),  # 1.5 dB at least: no law is taken to err by more below
        (1, ScanTarget(1.6), 0.4, False),
        (2, ScanTarget(1.0), 0.1, False),
        (1, ScanTarget(4.0), 0.0, False),  # it is chosen, but then met
        (1, ScanTarget(7.0), 0.0, False),  # met already
        (1, ScanTarget(seconds=99), 0.1, True),
        (1, ScanTarget(seconds=9), 0.1, False),
    ],
)
def test_a_next_pass_is_sure_only_if_the_target_is_not_met_after_it_even_at_the_low_end(
    done: int, target: ScanTarget, error: float, sure: bool
) -> None:
    timeline = scan()
    law, passes = ErrorLaw(12 * done, 1.0, error, 0.0), after(timeline, done)
    offered = options(passes, law, timeline, seconds_of)
    assert next_is_sure(passes, offered, target, law, 4.0, 0.0) is sure


LAWS = st.builds(
    ErrorLaw, st.just(12), st.floats(0, 2), st.floats(0, 0.3), st.floats(0, 0.6), st.floats(0, 0.4)
)  # fmt: skip
WISHES = st.builds(
    ScanTarget, st.none() | st.floats(0.01, 10), st.none() | st.floats(1, 100), st.none() | st.floats(0.05, 1)
)  # fmt: skip
TIMELINE = scan(wide=5)
FIRST = after(TIMELINE, 1)
FIRST_SECONDS = sum(seconds_of(block) for block in (*FIRST.done, *FIRST.offset))  # offset views come in any case
FIRST_DOSE = (12 + 10) * frame_dose(TIMELINE)


def taken(law: ErrorLaw, target: ScanTarget) -> tuple[list[Choice], int, float, float]:
    """What is chosen to the end, by a law that stays: the choices, views and what was spent, offset views included."""
    passes, choices = after(TIMELINE, 1, retakes=3), list[Choice]()
    seconds, dose = FIRST_SECONDS, FIRST_DOSE
    while passes.to_come or passes.offset or passes.retakes:
        so_far = replace(law, n_views=passes.n_frames)
        offered = options(passes, so_far, TIMELINE, seconds_of)
        choice, _ = choose(offered, target, remaining_gain(passes, so_far), seconds, dose)
        choices.append(choice)
        if choice is Choice.ENOUGH:
            break
        option = next(option for option in offered if option.choice is choice)
        assert option.gain > 0  # nothing that brings nothing is taken before ENOUGH
        if choice is not Choice.OFFSET:
            seconds, dose = seconds + option.seconds, dose + option.dose
        passes = replace(passes, retakes=0) if choice is Choice.RETAKE else passes.after(choice)
    return choices, passes.n_frames, seconds, dose


@given(LAWS, WISHES)
def test_a_scan_that_does_stays_within_its_wishes_and_the_plan(law: ErrorLaw, target: ScanTarget) -> None:
    choices, views, seconds, dose = taken(law, target)
    assert views <= 48 and choices.count(Choice.OFFSET) <= 1
    assert seconds <= max(FIRST_SECONDS, target.seconds or math.inf) * (1 + 1e-9)
    assert dose <= max(FIRST_DOSE, target.dose or math.inf) * (1 + 1e-6)


@given(LAWS, st.floats(0.01, 10), st.floats(1, 3))
def test_with_less_quality_to_reach_no_more_views_are_taken(law: ErrorLaw, target_db: float, more: float) -> None:
    assert taken(law, ScanTarget(quality_db=more * target_db))[1] <= taken(law, ScanTarget(quality_db=target_db))[1]


@given(LAWS, st.floats(0.05, 1), st.floats(1, 3))
def test_with_more_dose_to_spend_no_less_is_reached(law: ErrorLaw, dose: float, more: float) -> None:
    assume(law.exponent > 0.05)
    few, many = (taken(law, ScanTarget(dose=share))[3] for share in (dose, min(1.0, more * dose)))
    assert few <= many * (1 + 1e-6)


@given(LAWS)
def test_noise_alone_is_worth_the_same_angles_only_where_it_is_better_than_new_ones(law: ErrorLaw) -> None:
    """New angles lower the noise, too: with an exponent of 1 or more they are never worse."""
    choices, *_ = taken(replace(law, exponent=max(1.0, law.exponent)), ScanTarget())
    assert Choice.AGAIN not in choices
