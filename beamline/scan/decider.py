"""Decider: after each pass of projections, decides from the error model, or asks the operator, what to measure next.

The decider needs no additional frame, and the scan does not depend on it: if no error model arrives in time, the scan
continues its plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from beamline.core.events import NextChosen, PassEnded, Sink, Warned
from beamline.core.recon_events import LawMeasured
from beamline.core.stop import StopRequest
from beamline.plan.choose import PassOption, ScanTarget, choose, frame_dose, next_is_sure, options, remaining_gain
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Block, Timeline
from beamline.scan.control import State, StateMachine
from beamline.scan.supervision import PAUSE_POLL
from drivers.base.frame import FrameKind
from recon.base.error_law import BELOW, ErrorLaw

_NO_LAW = LawMeasured(0, 0, math.nan, math.nan, math.nan, math.nan, reason="no prediction has arrived yet")


@dataclass(eq=False, kw_only=True)
class Decider:
    """Decides what is measured next. It is called after each pass, with the passes so far and to come.

    Attributes:
        asks: True: the operator is asked; False: the program chooses. wait: longest real time in s to wait for the
            error model of a pass, and again for the answer of the operator; pauses do not count. seconds_of: function
            that returns the duration of a block, from the present position of the stage. now: clock of the instrument,
            in s. began: time of the first frame; inf: no frame yet, because a resumed scan makes a choice first.
            added_seconds: time in s that counts in addition to the time since `began`: that of earlier parts of the
            run, and of the darks and flats after the projections. retaken: number of projections that earlier parts of
            the run took again. number: number of the pass that ended last, from 1; at first that of the last pass of
            earlier parts of the run. why_no_law: why no error model can come any more; "" if one may still come. If
            none can come, the plan continues without a wait. wait_a_moment: function that waits `PAUSE_POLL` real s, or
            as long as the scan is paused. It returns True if Enter was pressed. close_shutter: function that is called
            before the scan waits. record: function that gets the values of a decision, for the file.
    """

    asks: bool
    target: ScanTarget
    wait: float
    timeline: Timeline
    seconds_of: Callable[[Block], float]
    now: Callable[[], float]
    states: StateMachine
    stop: StopRequest
    sink: Sink
    began: float = math.inf
    added_seconds: float = 0.0
    retaken: int = 0
    number: int = 0
    why_no_law: Callable[[], str] = lambda: ""
    wait_a_moment: Callable[[], bool] = lambda: False
    close_shutter: Callable[[], None] = lambda: None
    record: Callable[[Mapping[str, Any]], None] = lambda values: None
    _law: LawMeasured = _NO_LAW  # the newest
    # options, by the number of the pass before them
    _chosen: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    _outcome: Mapping[str, Any] = field(default_factory=dict)  # the result of a choice, as in `NextChosen`
    _no_more_laws: str = ""  # the reason, after it was reported
    _answers: frozenset[Choice] = frozenset()  # choices that the operator can make at present
    _answer: Choice | None = None

    def add_law(self, error_law: LawMeasured) -> None:
        """Receive an error model from the live reconstruction. The method may be called in any thread."""
        self._law = error_law
        option = self._chosen.get(error_law.number - 1, {})
        if error_law.gained is not None and option.get("choice", Choice.NEXT) in (Choice.NEXT, Choice.AGAIN):
            ends = {"gained_low": (1 - BELOW) * error_law.gained, "gained_high": (1 + BELOW) * error_law.gained}
            self._outcome = {
                "predicted": option.get("gain"),
                "gained": error_law.gained,
                **ends,
                "judged": error_law.number - 1,
            }

    def answer(self, choice: Choice) -> None:
        """Receive the operator's choice. The method may be called in any thread. If the choice is not possible, a
        warning is given."""
        if choice in self._answers:
            self._answer = choice
        else:
            expected = (
                f"expected {', '.join(sorted(self._answers))}"
                if self._answers
                else "the scan is not waiting for a decision now"
            )
            self.sink(Warned(f"The choice {choice!s} had no effect: {expected}."))

    def __call__(self, passes: Passes) -> Choice:
        """Decide what is measured next, after a wait for the error model and, if asked for, the operator's answer."""
        self.number += 1
        if self._no_more_laws:
            return Choice.NEXT
        error_law, offered = self._predict(passes)
        if self.stop.stopping:
            return Choice.NEXT
        if error_law is not None:
            used = self._used_so_far(passes)
            decided_by, (choice, reason) = (
                "program",
                choose(offered, self.target, remaining_gain(passes, error_law), *used),
            )
        else:
            decided_by, choice, self._no_more_laws = "plan", Choice.NEXT, self.why_no_law()
            reason = (
                self._no_more_laws
                or (self._law.reason if self._law.number == self.number else "")
                or f"no prediction within {self.wait:g} s"
            )
        asks = self.asks and not self._no_more_laws
        remark = "" if error_law else f"The expected improvement is not known: {reason}."
        pass_values, n_passes = (self.number, passes.n_frames // self.timeline.plan.frames_per_view), len(passes.done)
        rows = [  # an event has None for NaN
            {name: None if value != value else value for name, value in vars(option).items()} for option in offered
        ]
        self.sink(PassEnded(*pass_values, rows, choice, self.wait if asks else 0.0, remark, n_passes))
        if asks:
            decided_by, choice, reason = self._ask(choice, offered)
            if self.stop.stopping:
                return Choice.NEXT
        self._chosen[self.number] = {row["choice"]: row for row in rows}.get(choice, {})
        n_dropped = passes.n_planned - passes.after(choice).n_planned
        event = NextChosen(
            *pass_values, choice, decided_by, reason, rows, **self._outcome, passes=n_passes, dropped=n_dropped
        )
        self._outcome = {}
        self.sink(event)
        self.record({"predicted": None, "gained": None} | event.data)
        return choice

    def _predict(self, passes: Passes) -> tuple[ErrorLaw | None, tuple[PassOption, ...]]:
        """The error model of the projections so far, and the options with its predictions; None if no error model comes
        in time.

        If an earlier error model makes the next pass certain, it is used, so that the stage does not wait.
        """
        error_law = self._newest_law(passes)
        offered = options(passes, error_law, self.timeline, self.seconds_of)
        if (
            error_law is None
            or self.asks
            or self.why_no_law()
            or not next_is_sure(passes, offered, self.target, error_law, *self._used_so_far(passes))
        ):
            if not self._law_is_known():
                self.close_shutter()  # computing an error model takes seconds
                self._wait(self._law_is_known)
            error_law = self._newest_law(passes) if self._law.number == self.number else None
            offered = options(passes, error_law, self.timeline, self.seconds_of)
        return error_law, offered

    def _law_is_known(self) -> bool:
        """True if the error model of all projections so far has arrived, or if no error model can come."""
        return self._law.number == self.number or bool(self.why_no_law())

    def _newest_law(self, passes: Passes) -> ErrorLaw | None:
        """The newest error model, applied to all frames so far; None if there is none.

        The error model may have been measured on a part of the projections, because the improvement depends only on
        ratios of their numbers.
        """
        values = self._law.exponent, self._law.exponent_error, self._law.noise, self._law.offset
        # checked, because it comes from another process
        if self._law.reason or None in values or not 0 <= values[2] + values[3] <= 1:
            return None
        return ErrorLaw(passes.n_frames, *values)

    def _used_so_far(self, passes: Passes) -> tuple[float, float]:
        """Seconds and share of the dose that the scan has used, plus those of the frames that follow the passes in any
        case."""
        retaken = sum(option["frames"] for option in self._chosen.values() if option.get("choice") is Choice.RETAKE)
        offset = sum(block.n for block in self.timeline.blocks if block.kind is FrameKind.OFFSET_VIEW)
        seconds = max(0.0, self.now() - self.began) + self.added_seconds + sum(map(self.seconds_of, passes.offset))
        return seconds, (passes.n_frames + self.retaken + retaken + offset) * frame_dose(self.timeline)

    def _wait(self, until: Callable[[], bool], at_enter: Callable[[], None] = lambda: None) -> None:
        """Wait until the function returns True, but at most `wait` s. A stop ends the wait."""
        for _ in range(round(self.wait / PAUSE_POLL)):
            if self.stop.stopping or until():
                return
            if self.wait_a_moment():
                at_enter()

    def _ask(self, recommended: Choice, offered: Sequence[PassOption]) -> tuple[str, Choice, str]:
        """The decision: who made it, the choice, and the reason. The operator makes it; without an answer in time, the
        plan."""
        messages = iter([""])  # no message when it asks for the first time

        def answered() -> bool:
            if self.states.state is not State.ASKING:  # at the beginning, and after a pause
                self.close_shutter()
                self.states.enter(
                    State.ASKING, next(messages, "The scan again waits for a decision on what to measure next")
                )
            return self._answer is not None

        self.wait_a_moment()  # earlier input is ignored
        self._answer, self._answers = None, frozenset({Choice.NEXT, *(option.choice for option in offered)})
        self._wait(answered, lambda: self.answer(recommended))
        self._answers = frozenset()
        if self._answer is None:
            return "plan", Choice.NEXT, f"no answer within {self.wait:g} s"
        return "operator", self._answer, "chosen by the operator"
