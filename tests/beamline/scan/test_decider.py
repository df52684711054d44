"""The decider asks the error model or the operator after each pass; without an answer, the plan continues."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from beamline.core.event_lines import event_of
from beamline.core.events import Event
from beamline.core.recon_events import LawMeasured
from beamline.core.stop import StopRequest
from beamline.plan.choose import ScanTarget
from beamline.plan.passes import Choice, Passes, pass_blocks
from beamline.plan.timeline import block_seconds
from beamline.scan.control import State, StateMachine
from beamline.scan.decider import Decider
from beamline.scan.supervision import PAUSE_POLL
from tests.beamline.fakes import FakeInstrument

PASS_VIEWS = 12  # of each of four passes
QUALITY = ScanTarget(quality_db=1.0)


def law(
    n: int, exponent: float | None = 1.0, error: float | None = 0.1, noise: float | None = 0.3, **more: Any
) -> LawMeasured:
    """The law of n views, as the line of another process gives it: None is a null there."""
    numbers = {"exponent": exponent, "exponent_error": error, "noise": noise, "offset": 0.0}
    event = event_of({"event": "error_law", "number": -(-n // PASS_VIEWS), "n_views": n, **numbers, **more})
    assert isinstance(event, LawMeasured)
    return event


class Scan:
    """A decider in a scan that is stood still; `moments` happen one after the other while it waits."""

    def __init__(
        self, target: ScanTarget = QUALITY, asks: bool = False, wait: float = 1.0, wide: int = 0, **more: Any
    ) -> None:
        instrument = FakeInstrument()
        plan = replace(
            instrument.plan(4 * PASS_VIEWS, passes=4), retake_share=0.25, offset_views=wide, offset_places=(1.0,)[:wide]
        )
        self.timeline = instrument.worked_out(plan)
        self.moments: list[Callable[[], object]] = []
        self.waited, self.why_no_law = 0, ""
        self.events: list[Event] = []
        self.recorded: list[Any] = []
        self.log: list[str] = []
        self.stop = StopRequest()
        self.states = StateMachine(lambda event: self.log.append(event.data["state"]), State.ACQUIRING)

        def seconds_of(block: Any) -> float:
            return block_seconds(block, instrument.stage.limits, instrument.camera.timing, 0.05)

        self.now = 100.0
        self.decide = Decider(
            asks=asks, target=target, wait=wait, timeline=self.timeline, seconds_of=seconds_of, now=lambda: self.now,
            states=self.states, stop=self.stop, sink=self.events.append, began=90.0, **more,
            why_no_law=lambda: self.why_no_law, wait_a_moment=self.moment, record=self.recorded.append,
            close_shutter=lambda: self.log.append("close shutter"),
        )  # fmt: skip

    def moment(self) -> bool:
        self.waited += 1
        return bool(self.moments and self.moments.pop(0)() is True)

    def after(self, n: int, *measured: LawMeasured, retakes: int = 0, again: int = 0) -> Choice:
        """What follows n passes and some that were taken again; the laws come one by one while it waits."""
        self.moments += [partial(self.decide.add_law, each) for each in measured]
        self.waited, self.decide.number = 0, n - 1
        blocks = pass_blocks(self.timeline.views, 0)
        done, to_come = blocks[: n - again], blocks[n - again : len(blocks) - again]
        wide = tuple(block for block in self.timeline.blocks if block.aside)
        return self.decide(Passes(done + done[-1:] * again, to_come, wide, retakes))

    def of(self, name: str) -> list[dict[str, Any]]:
        return [event.data for event in self.events if event.event == name]

    @property
    def chosen(self) -> dict[str, Any]:
        return self.of("next_chosen")[-1]


def test_it_waits_for_the_law_of_these_views_and_says_what_it_chose() -> None:
    scan = Scan()
    assert scan.after(1, law(12)) is Choice.NEXT
    (ended,), chosen = scan.of("pass_ended"), scan.chosen
    assert ended["number"] == chosen["number"] == 1 and ended["n_views"] == chosen["n_views"] == 12
    assert ended["recommended"] == chosen["choice"] == "next" and chosen["by"] == "program"
    assert [option["choice"] for option in ended["options"]] == ["next", "again", "enough"]
    assert ended["options"] == chosen["options"] and ended["wait"] == 0 and "remark" not in ended
    assert "dB" in chosen["reason"] and "predicted" not in chosen and scan.waited == 1
    assert json.loads(json.dumps(scan.recorded)) == [chosen | {"predicted": None, "gained": None}]


def test_what_came_of_a_prediction_stands_beside_it() -> None:
    scan = Scan(ScanTarget(1.6))  # which it waits for a law to tell
    scan.after(1, law(12, error=0.5))
    predicted = scan.chosen["options"][0]["gain"]
    scan.after(2, law(24, error=0.5, gained=2.5))
    assert (scan.chosen["predicted"], scan.chosen["gained"], scan.chosen["judged"]) == (predicted, 2.5, 1)
    scan.decide.add_law(law(24, gained=2.4))  # comes again while the next pass is taken
    scan.after(3, law(36, error=0.5, gained=1.0))
    assert scan.chosen["gained"] == 1.0
    assert scan.chosen["predicted"] == scan.of("next_chosen")[1]["options"][0]["gain"]


def test_a_choice_before_the_first_frame_of_a_later_part_counts_the_seconds_of_earlier_ones() -> None:
    scan = Scan(ScanTarget(seconds=100.0), added_seconds=99.0)
    scan.decide.began = math.inf
    assert scan.after(1, law(12)) is Choice.ENOUGH
    assert "next would end the scan after" in scan.chosen["reason"]


def test_where_the_next_pass_is_sure_the_stage_does_not_wait_and_the_outcome_comes_later() -> None:
    scan = Scan(ScanTarget(1.0))
    scan.after(1, law(12, exponent=2.0, noise=0.0))
    predicted = scan.chosen["options"][0]["gain"]
    assert scan.after(2) is Choice.NEXT and scan.waited == 0 and scan.chosen["by"] == "program"
    assert "gained" not in scan.chosen
    scan.decide.add_law(
        law(24, exponent=2.0, noise=0.0, gained=5.0)
    )  # of the second pass, while the third one is taken
    assert scan.after(3, law(36)) is Choice.NEXT and scan.waited == 1  # after the last one the target may be met
    assert (scan.chosen["predicted"], scan.chosen["gained"], scan.chosen["judged"]) == (predicted, 5.0, 1)


def test_enough_is_chosen_with_its_reason_and_left_to_the_scan_to_do() -> None:
    scan = Scan()
    assert scan.after(3, law(36, exponent=0.5)) is Choice.ENOUGH
    assert not scan.stop.stopping
    assert scan.chosen["reason"].startswith("the remaining projections of the plan would improve the PSNR by 0.62 dB")
    assert scan.chosen["choice"] == "enough" and scan.recorded[0]["reason"] == scan.chosen["reason"]


def test_the_seconds_of_a_target_are_those_since_the_first_frame_and_what_follows() -> None:
    takes = Scan().decide.seconds_of(pass_blocks(Scan().timeline.views, 0)[1])
    for added, choice in ((0.0, Choice.NEXT), (1.0, Choice.ENOUGH)):
        scan = Scan(ScanTarget(seconds=10.5 + takes), added_seconds=added)
        assert scan.after(1, law(12)) is choice


def test_wide_views_count_as_taken_as_they_come_in_any_case() -> None:
    scan = Scan(wide=5)
    views, wide = pass_blocks(scan.timeline.views, 0)[1], next(block for block in scan.timeline.blocks if block.aside)
    takes = scan.decide.seconds_of(views) + scan.decide.seconds_of(wide)
    for target in (ScanTarget(seconds=10 + takes), ScanTarget(dose=29 / 53)):
        for less, choice in ((0.999, Choice.ENOUGH), (1.001, Choice.NEXT)):
            tried = ScanTarget(
                seconds=target.seconds and less * target.seconds, dose=target.dose and less * target.dose
            )
            assert Scan(tried, wide=5).after(1, law(12)) is choice


def test_what_wide_views_or_retakes_brought_is_not_measured_and_a_pass_has_a_range() -> None:
    scan = Scan(ScanTarget(0.01), asks=True, wide=5)
    for choice, measured in ((Choice.OFFSET, False), (Choice.RETAKE, False), (Choice.NEXT, True)):
        scan.moments = [partial(scan.decide.add_law, law(12)), lambda: None]
        scan.moments += [partial(scan.decide.answer, choice)]
        assert scan.after(1, retakes=2) is choice and scan.chosen["passes"] == 1
        scan.decide.add_law(law(24, gained=0.5))
        assert scan.decide._outcome.get("gained") == (0.5 if measured else None)
    assert (scan.decide._outcome["gained_low"], scan.decide._outcome["gained_high"]) == pytest.approx((0.25, 0.75))


def test_retakes_of_earlier_parts_count_in_the_dose() -> None:
    assert Scan(ScanTarget(dose=0.75), retaken=2).after(2, law(24)) is Choice.ENOUGH


@pytest.mark.parametrize(("retaken", "choice"), [(0, Choice.NEXT), (2, Choice.ENOUGH)])
def test_the_dose_of_a_target_counts_retakes_that_were_chosen(retaken: int, choice: Choice) -> None:
    scan = Scan(ScanTarget(dose=0.75), asks=bool(retaken))
    if retaken:
        scan.moments = [lambda: scan.decide.add_law(law(24)), lambda: None]
        scan.moments += [lambda: scan.decide.answer(Choice.RETAKE)]
        assert scan.after(2, retakes=retaken) is Choice.RETAKE
        scan.decide.asks = False
    assert scan.after(2, law(24)) is choice


def test_a_late_law_means_the_plan_and_the_next_one_counts_again() -> None:
    scan = Scan(wait=0.5)
    assert scan.after(1) is Choice.NEXT and scan.waited == round(0.5 / PAUSE_POLL)
    assert (scan.chosen["by"], scan.chosen["reason"]) == ("plan", "no prediction within 0.5 s")
    assert scan.of("pass_ended")[0]["remark"] == "The expected improvement is not known: no prediction within 0.5 s."
    assert {option["gain"] for option in scan.chosen["options"]} == {None, 0.0}
    assert scan.after(3, law(12), law(33, exponent=0.2)) is Choice.ENOUGH  # the first is of an earlier pass, and late
    assert scan.waited == 2


def test_the_law_after_what_an_earlier_part_chose_has_no_prediction_beside_it() -> None:
    scan = Scan(ScanTarget(0.01), wait=0.2)
    scan.after(2, law(21, error=0.5, gained=1.0))  # of fewer views, as some were flagged
    assert (scan.chosen["number"], scan.chosen["by"], scan.chosen["judged"]) == (2, "program", 1)
    assert "predicted" not in scan.chosen


@pytest.mark.parametrize("asks", [False, True])
def test_a_dead_live_process_means_the_plan_and_is_said_once(asks: bool) -> None:
    scan = Scan(asks=asks, wait=0.5)

    def die() -> None:
        scan.why_no_law = "the live reconstruction has ended"

    scan.moments = [die]
    assert scan.after(1) is Choice.NEXT and scan.waited == 1
    assert [scan.after(n) for n in (2, 3)] == [Choice.NEXT] * 2
    assert scan.waited == 0 and scan.states.state is State.ACQUIRING
    assert [(each["by"], each["reason"]) for each in scan.of("next_chosen")] == [("plan", scan.why_no_law)]
    assert [each["remark"] for each in scan.of("pass_ended")] == [
        f"The expected improvement is not known: {scan.why_no_law}."
    ]


def test_a_law_of_before_does_not_serve_when_the_process_is_dead() -> None:
    scan = Scan(ScanTarget(1.0))
    scan.after(1, law(12, exponent=2.0, noise=0.0))
    scan.why_no_law = "the live reconstruction has ended"
    assert scan.after(2) is Choice.NEXT and scan.chosen["by"] == "plan"


@pytest.mark.parametrize("asks", [False, True])
def test_a_stop_ends_every_wait(asks: bool) -> None:
    scan = Scan(asks=asks, wait=60)
    if asks:
        scan.moments = [lambda: scan.decide.add_law(law(12)), lambda: None]
    scan.moments += [lambda: None, scan.stop.stop]
    assert scan.after(1) is Choice.NEXT and scan.waited <= 5
    assert len(scan.of("pass_ended")) == asks and not scan.of("next_chosen") and not scan.recorded


def test_the_operator_is_asked_with_a_closed_shutter() -> None:
    scan = Scan(asks=True, wait=60)
    scan.moments = [lambda: scan.decide.add_law(law(12)), lambda: None, lambda: None]
    scan.moments += [lambda: scan.decide.answer(Choice.OFFSET), lambda: scan.decide.answer(Choice.AGAIN)]
    assert scan.after(1) is Choice.AGAIN
    assert scan.log == ["close shutter", "close shutter", "asking"]  # while it waits for the law, too
    (ended,) = scan.of("pass_ended")
    assert ended["wait"] == 60 and ended["recommended"] == "next"
    assert (scan.chosen["by"], scan.chosen["reason"]) == ("operator", "chosen by the operator")
    (refused,) = scan.of("warning")
    assert refused["message"] == "The choice offset had no effect: expected again, enough, next."
    scan.decide.answer(Choice.ENOUGH)  # too late
    assert (
        scan.of("warning")[1]["message"]
        == "The choice enough had no effect: the scan is not waiting for a decision now."
    )
    assert not scan.stop.stopping


def test_enter_takes_what_is_recommended_but_not_an_earlier_one() -> None:
    scan = Scan(asks=True, wait=60)
    scan.moments = [lambda: scan.decide.add_law(law(36, exponent=0.3)), lambda: True, lambda: None, lambda: True]
    assert scan.after(3) is Choice.ENOUGH and scan.waited == 4
    assert scan.chosen["by"] == "operator"


def test_without_an_answer_the_plan_goes_on_though_no_law_came() -> None:
    scan = Scan(asks=True, wait=0.5)
    assert scan.after(3) is Choice.NEXT
    assert (scan.chosen["by"], scan.chosen["reason"]) == ("plan", "no answer within 0.5 s")
    assert scan.of("pass_ended")[0]["remark"].startswith("The expected improvement is not known: ")


def test_after_a_pause_it_asks_again() -> None:
    scan = Scan(asks=True, wait=60)

    def pause() -> None:
        scan.states.enter(State.PAUSED)
        scan.states.enter(State.ACQUIRING)

    scan.moments = [lambda: scan.decide.add_law(law(12)), lambda: None, pause, lambda: None]
    scan.moments += [lambda: scan.decide.answer(Choice.NEXT)]
    scan.after(1)
    assert scan.log[1:] == ["close shutter", "asking", "paused", "acquiring", "close shutter", "asking"]


def test_the_shutter_stays_open_where_the_law_is_there() -> None:
    scan = Scan()
    scan.decide.add_law(law(12))
    assert scan.after(1) is Choice.NEXT
    assert not scan.log


@pytest.mark.parametrize("asks", [False, True])
def test_a_reason_in_place_of_a_law_ends_the_wait(asks: bool) -> None:
    scan = Scan(asks=asks, wait=0.5)
    none = law(12, exponent=None, error=None, noise=None, reason="30 views are few")
    assert scan.after(1, none) is Choice.NEXT
    assert scan.waited == 1 or asks
    assert scan.of("pass_ended")[0]["remark"] == "The expected improvement is not known: 30 views are few."
    assert (scan.chosen["by"], scan.chosen["reason"]) == (
        "plan",
        "no answer within 0.5 s" if asks else "30 views are few",
    )
    scan.decide.asks = False
    assert scan.after(2, law(24)) is Choice.NEXT and scan.chosen["by"] == "program" and scan.waited == 1


def test_a_law_without_its_numbers_is_none() -> None:
    scan = Scan(wait=0.2)
    assert scan.after(1, law(12, exponent=None)) is Choice.NEXT
    assert scan.chosen["by"] == "plan"
