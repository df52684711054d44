"""Decider: after each pass of views it asks the law of the error, or the operator, what to measure next.

It costs no frame, and the scan does not depend on it: without a law in time the plan goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from beamline.core.events import LawMeasured, NextChosen, PassEnded, Sink, Warned
from beamline.core.stop import StopRequest
from beamline.plan.choose import PassOption, Wish, choose, frame_dose, next_is_sure, options, rest_gain
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Block, Timeline
from beamline.scan.control import State, StateMachine
from beamline.scan.supervision import PAUSE_POLL
from drivers.base.frame import FrameKind
from recon.base.error_law import ErrorLaw

_NO_LAW = LawMeasured(0, 0, math.nan, math.nan, math.nan, math.nan, reason="none came yet")


@dataclass(eq=False, kw_only=True)
class Decider:
    """Called with the passes after each of them, it returns what is measured next.

    Attributes:
        asks: the operator is asked; otherwise the program chooses.
        wait: real s for the law of a pass, and again for the operator's answer, at most; pauses do not count.
        seconds_of: duration of a block, from where the stage stands.
        now: the instrument's clock, s.
        began: time of the first frame.
        seconds: that count beside those since then: of earlier parts of the run, and of what must follow the views.
        number: of the pass that ended last, from 1; at first the last one of earlier parts of the run.
        unable: why no law can come; "" while one may. Once it has said so, the plan goes on without a wait.
        wait_a_moment: waits `PAUSE_POLL` real s, or as long as the scan is paused; whether Enter was pressed.
        close_shutter: called before the scan waits.
        record: takes the values of a decision, for the file.
    """

    asks: bool
    wish: Wish
    wait: float
    timeline: Timeline
    seconds_of: Callable[[Block], float]
    now: Callable[[], float]
    states: StateMachine
    stop: StopRequest
    sink: Sink
    began: float = math.inf
    seconds: float = 0.0
    number: int = 0
    unable: Callable[[], str] = lambda: ""
    wait_a_moment: Callable[[], bool] = lambda: False
    close_shutter: Callable[[], None] = lambda: None
    record: Callable[[Mapping[str, Any]], None] = lambda values: None
    _law: LawMeasured = _NO_LAW  # the newest
    _chosen: dict[int, Mapping[str, Any]] = field(default_factory=dict)  # options by the number of the pass before
    _outcome: Mapping[str, Any] = field(default_factory=dict)  # what came of a choice, as `NextChosen` has it
    _unable: str = ""
    _answers: frozenset[Choice] = frozenset()  # that the operator can give now
    _answer: Choice | None = None

    def add_law(self, law: LawMeasured) -> None:
        """Take a law from the live reconstruction; any thread."""
        self._law = law
        if law.gained is not None:
            before = law.number - 1
            predicted = self._chosen.get(before, {}).get("gain")
            self._outcome = {"predicted": predicted, "gained": law.gained, "judged": before}

    def answer(self, choice: Choice) -> None:
        """Take the operator's choice; any thread. One that is not asked for becomes a warning."""
        if choice in self._answers:
            self._answer = choice
        else:
            expected = f"expected {', '.join(sorted(self._answers))}" if self._answers else "the scan does not ask now"
            self.sink(Warned(f"The choice {choice!s} changed nothing: {expected}."))

    def __call__(self, passes: Passes) -> Choice:
        """What is measured next, after a wait for the law and, where it asks, for the operator."""
        self.number += 1
        if self._unable:
            return Choice.NEXT
        law, offered = self._predict(passes)
        if self.stop.stopping:
            return Choice.NEXT
        if law is not None:
            by, (choice, reason) = "program", choose(offered, self.wish, rest_gain(passes, law), *self._spent(passes))
        else:
            self._unable, why = self.unable(), self._law.reason if self._law.number == self.number else ""
            by, choice, reason = "plan", Choice.NEXT, self._unable or why or f"no prediction within {self.wait:g} s"
        asks, remark = self.asks and not self._unable, "" if law else f"Gains are not known: {reason}."
        facts = self.number, passes.n_views // self.timeline.plan.frames_per_view
        values = [{name: None if value != value else value for name, value in vars(one).items()} for one in offered]
        self.sink(PassEnded(*facts, values, choice, self.wait if asks else 0.0, remark))
        if asks:
            by, choice, reason = self._ask(choice, offered)
            if self.stop.stopping:
                return Choice.NEXT
        self._chosen[self.number] = {one["choice"]: one for one in values}.get(choice, {})
        event = NextChosen(*facts, choice, by, reason, values, **self._outcome)
        self._outcome = {}
        self.sink(event)
        self.record({"predicted": None, "gained": None} | event.data)
        return choice

    def _predict(self, passes: Passes) -> tuple[ErrorLaw | None, tuple[PassOption, ...]]:
        """The law of the views so far and the options by it; None if no law comes in time.

        An earlier law serves where by it the next pass is sure, so that the stage does not wait.
        """
        law = self._newest(passes)
        offered = options(passes, law, self.timeline, self.seconds_of)
        spent = self._spent(passes)
        if law is None or self.asks or self.unable() or not next_is_sure(passes, offered, self.wish, law, *spent):
            if not self._law_has_come():
                self.close_shutter()  # a law takes seconds
                self._wait(self._law_has_come)
            law = self._newest(passes) if self._law.number == self.number else None
            offered = options(passes, law, self.timeline, self.seconds_of)
        return law, offered

    def _law_has_come(self) -> bool:
        """Whether the law of all views so far is there, or none can come."""
        return self._law.number == self.number or bool(self.unable())

    def _newest(self, passes: Passes) -> ErrorLaw | None:
        """The newest law. Gains depend on ratios of numbers of views alone: a law of some views serves for all."""
        values = self._law.exponent, self._law.exponent_error, self._law.noise, self._law.offset
        if self._law.reason or None in values or not 0 <= values[2] + values[3] <= 1:  # of a process that is not ours
            return None
        return ErrorLaw(passes.n_views, *values)

    def _spent(self, passes: Passes) -> tuple[float, float]:
        """Seconds and share of the dose that the scan has taken; the seconds include what must follow the views."""
        again = sum(one["frames"] for one in self._chosen.values() if one.get("choice") is Choice.RETAKE)
        wide = sum(block.n for block in self.timeline.blocks if block.kind is FrameKind.WIDE_VIEW)
        frames = passes.n_views + again + wide - sum(block.left for block in passes.wide)
        return self.now() - self.began + self.seconds, frames * frame_dose(self.timeline)

    def _wait(self, until: Callable[[], bool], at_enter: Callable[[], None] = lambda: None) -> None:
        """Wait at most as long as it may, or until a stop."""
        for _ in range(round(self.wait / PAUSE_POLL)):
            if self.stop.stopping or until():
                return
            if self.wait_a_moment():
                at_enter()

    def _ask(self, recommended: Choice, offered: Sequence[PassOption]) -> tuple[str, Choice, str]:
        """Who chose, what, and why, once the operator has answered or time is over."""
        at_first = iter(("",))

        def answered() -> bool:
            if self.states.state is not State.ASKING:  # at first, and after a pause
                self.close_shutter()
                self.states.enter(State.ASKING, next(at_first, "The scan asks again what to measure next"))
            return self._answer is not None

        self.wait_a_moment()  # earlier input does not count
        self._answer, self._answers = None, frozenset({Choice.NEXT, *(one.choice for one in offered)})
        self._wait(answered, lambda: self.answer(recommended))
        self._answers = frozenset()
        if self._answer is None:
            return "plan", Choice.NEXT, f"no answer within {self.wait:g} s"
        return "operator", self._answer, "the operator chose it"
