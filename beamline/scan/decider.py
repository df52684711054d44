"""Decider: after each pass of projections, decides from the error model, or asks the operator, what to measure next.

It needs no additional frame, and the scan does not depend on it: if no error model arrives in time, the plan continues.
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
    """Called after each pass with the passes so far and to come, it returns what is measured next.

    Attributes:
        asks: True: the operator is asked; False: the program chooses.
        wait: real s to wait for the error model of a pass, and again for the operator's answer, at most; pauses do not
            count.
        seconds_of: duration of a block, from the present position of the stage.
        now: the instrument's clock, s.
        began: time of the first frame; inf: no frame yet, because a resumed scan makes a choice first.
        added_seconds: s that count in addition to those since `began`: of earlier parts of the run, and of the darks
            and flats that follow the projections.
        retaken: projections that earlier parts of the run took again.
        number: of the pass that ended last, from 1; at first the last one of earlier parts of the run.
        why_no_law: why no error model can come any more; "" while one may. Then the plan continues without a wait.
        wait_a_moment: waits `PAUSE_POLL` real s, or as long as the scan is paused; returns True if Enter was pressed.
        close_shutter: called before the scan waits.
        record: takes the values of a decision, for the file.
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
    _chosen: dict[int, Mapping[str, Any]] = field(default_factory=dict)  # options, by the pass before each
    _outcome: Mapping[str, Any] = field(default_factory=dict)  # the result of a choice, as in `NextChosen`
    _no_more_laws: str = ""  # why, once it was reported
    _answers: frozenset[Choice] = frozenset()  # choices that the operator can make now
    _answer: Choice | None = None

    def add_law(self, law: LawMeasured) -> None:
        """Take an error model from the live reconstruction; may be called in any thread."""
        self._law = law
        option = self._chosen.get(law.number - 1, {})
        if law.gained is not None and option.get("choice", Choice.NEXT) in (Choice.NEXT, Choice.AGAIN):
            ends = {"gained_low": (1 - BELOW) * law.gained, "gained_high": (1 + BELOW) * law.gained}
            self._outcome = {"predicted": option.get("gain"), "gained": law.gained, **ends, "judged": law.number - 1}

    def answer(self, choice: Choice) -> None:
        """Take the operator's choice; may be called in any thread. A choice that is not possible becomes a warning."""
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
        law, offered = self._predict(passes)
        if self.stop.stopping:
            return Choice.NEXT
        if law is not None:
            spent = self._spent(passes)
            by, (choice, reason) = "program", choose(offered, self.target, remaining_gain(passes, law), *spent)
        else:
            by, choice, self._no_more_laws = "plan", Choice.NEXT, self.why_no_law()
            reason = (
                self._no_more_laws
                or (self._law.reason if self._law.number == self.number else "")
                or f"no prediction within {self.wait:g} s"
            )
        asks, remark = (
            self.asks and not self._no_more_laws,
            "" if law else f"The expected improvement is not known: {reason}.",
        )
        pass_ended, done = (self.number, passes.n_frames // self.timeline.plan.frames_per_view), len(passes.done)
        rows = [  # an event has None for NaN
            {name: None if value != value else value for name, value in vars(option).items()} for option in offered
        ]
        self.sink(PassEnded(*pass_ended, rows, choice, self.wait if asks else 0.0, remark, done))
        if asks:
            by, choice, reason = self._ask(choice, offered)
            if self.stop.stopping:
                return Choice.NEXT
        self._chosen[self.number] = {row["choice"]: row for row in rows}.get(choice, {})
        dropped = passes.n_planned - passes.after(choice).n_planned
        event = NextChosen(*pass_ended, choice, by, reason, rows, **self._outcome, passes=done, dropped=dropped)
        self._outcome = {}
        self.sink(event)
        self.record({"predicted": None, "gained": None} | event.data)
        return choice

    def _predict(self, passes: Passes) -> tuple[ErrorLaw | None, tuple[PassOption, ...]]:
        """The error model of the projections so far and the options that it predicts; None if none comes in time.

        An earlier error model is used if the next pass is certain with it, so that the stage does not wait.
        """
        law = self._newest_law(passes)
        offered = options(passes, law, self.timeline, self.seconds_of)
        if (
            law is None
            or self.asks
            or self.why_no_law()
            or not next_is_sure(passes, offered, self.target, law, *self._spent(passes))
        ):
            if not self._law_has_come():
                self.close_shutter()  # an error model takes seconds
                self._wait(self._law_has_come)
            law = self._newest_law(passes) if self._law.number == self.number else None
            offered = options(passes, law, self.timeline, self.seconds_of)
        return law, offered

    def _law_has_come(self) -> bool:
        """True if the error model of all projections so far is there, or none can come."""
        return self._law.number == self.number or bool(self.why_no_law())

    def _newest_law(self, passes: Passes) -> ErrorLaw | None:
        """The newest error model, applied to all frames so far; None if there is none.

        It may have been measured on some of the projections, because the improvement depends only on ratios of their
        numbers.
        """
        values = self._law.exponent, self._law.exponent_error, self._law.noise, self._law.offset
        # from another process, so check it
        if self._law.reason or None in values or not 0 <= values[2] + values[3] <= 1:
            return None
        return ErrorLaw(passes.n_frames, *values)

    def _spent(self, passes: Passes) -> tuple[float, float]:
        """Seconds and share of the dose that the scan has used, including what follows the passes in any case."""
        retaken = sum(option["frames"] for option in self._chosen.values() if option.get("choice") is Choice.RETAKE)
        offset = sum(block.n for block in self.timeline.blocks if block.kind is FrameKind.OFFSET_VIEW)
        seconds = max(0.0, self.now() - self.began) + self.added_seconds + sum(map(self.seconds_of, passes.offset))
        return seconds, (passes.n_frames + self.retaken + retaken + offset) * frame_dose(self.timeline)

    def _wait(self, until: Callable[[], bool], at_enter: Callable[[], None] = lambda: None) -> None:
        """Wait until this is true, at most `wait` s, and not beyond a stop."""
        for _ in range(round(self.wait / PAUSE_POLL)):
            if self.stop.stopping or until():
                return
            if self.wait_a_moment():
                at_enter()

    def _ask(self, recommended: Choice, offered: Sequence[PassOption]) -> tuple[str, Choice, str]:
        """Who chose, what, and why: the operator, or the plan if there is no answer in time."""
        messages = iter([""])  # none when it asks for the first time

        def answered() -> bool:
            if self.states.state is not State.ASKING:  # at first, and after a pause
                self.close_shutter()
                self.states.enter(
                    State.ASKING, next(messages, "The scan again waits for a decision on what to measure next")
                )
            return self._answer is not None

        self.wait_a_moment()  # earlier input does not count
        self._answer, self._answers = None, frozenset({Choice.NEXT, *(option.choice for option in offered)})
        self._wait(answered, lambda: self.answer(recommended))
        self._answers = frozenset()
        if self._answer is None:
            return "plan", Choice.NEXT, f"no answer within {self.wait:g} s"
        return "operator", self._answer, "chosen by the operator"
