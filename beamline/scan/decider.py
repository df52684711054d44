"""Decider: after each pass of views it asks the law of the error, or the operator, what to measure next.

It costs no frame, and the scan does not depend on it: without a law in time the plan goes on.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from beamline.core.events import LawMeasured, NextChosen, PassEnded, Sink, Warned
from beamline.core.stop import StopRequest
from beamline.plan.choose import PassOption, Spent, Wish, choose, frame_dose, next_is_sure, options, rest_gain
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import Block, Timeline
from beamline.scan.control import State, StateMachine
from beamline.scan.supervision import PAUSE_POLL
from recon.base.error_law import ErrorLaw


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
        frames: with light on the sample beside the views, of earlier parts of the run.
        unable: why no law can come; "" while one may.
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
    frames: int = 0
    unable: Callable[[], str] = lambda: ""
    wait_a_moment: Callable[[], bool] = lambda: False
    close_shutter: Callable[[], None] = lambda: None
    record: Callable[[Mapping[str, Any]], None] = lambda values: None
    _laws: deque[LawMeasured] = field(default_factory=lambda: deque(maxlen=1))  # that came: the newest
    _law: ErrorLaw | None = None  # the newest that was taken up; None: for a reason there is none
    _reason: str = ""
    _law_of: int = 0  # the number of its pass,
    _lost: int = 0  # and the frames that it lacks, as flagged ones are not in a law
    _ended: list[tuple[int, float | None]] = field(default_factory=list)  # passes: frames of views, dB of what followed
    _outcome: Mapping[str, Any] = field(default_factory=dict)  # what came of a choice, as `NextChosen` has it
    _unable: str = ""  # the reason that was given last
    _answers: frozenset[Choice] = frozenset()  # that the operator can give now
    _answer: Choice | None = None

    def add_law(self, law: LawMeasured) -> None:
        """Take a law from the live reconstruction; any thread."""
        self._laws.append(law)

    def answer(self, choice: Choice) -> None:
        """Take the operator's choice; any thread. One that is not asked for becomes a warning."""
        if choice in self._answers:
            self._answer = choice
        else:
            expected = f"expected {', '.join(sorted(self._answers))}" if self._answers else "the scan does not ask now"
            self.sink(Warned(f"The choice {choice!s} changed nothing: {expected}."))

    def __call__(self, passes: Passes) -> Choice:
        """What is measured next, after a wait for the law and, where it asks, for the operator."""
        plan, known = self.timeline.plan, self._unable
        earlier = [(passes.n_views - passes.done[-1].left, None)] * len(plan.choices)  # parts of the run
        self._ended = [*(self._ended or earlier), (passes.n_views, None)]
        self._take_law()
        self._unable = self.unable()
        if self._unable and self._unable == known:
            return Choice.NEXT
        law, offered = self._predict(passes)
        if self.stop.stopping:
            return Choice.NEXT
        if law is not None:
            by, (choice, reason) = "program", choose(offered, self.wish, self._spent(passes), rest_gain(passes, law))
        else:
            self._unable = self.unable()
            why = self._reason if self._law_of == len(self._ended) else ""
            by, choice = "plan", Choice.NEXT
            reason = self._unable or why or f"no prediction within {self.wait:g} s"
        asks, remark = self.asks and not self._unable, "" if law else f"Gains are not known: {reason}."
        facts = len(self._ended), passes.n_views // plan.frames_per_view
        values = [{name: None if value != value else value for name, value in vars(one).items()} for one in offered]
        self.sink(PassEnded(*facts, values, choice, self.wait if asks else 0.0, remark))
        if asks:
            by, choice, reason = self._ask(choice, offered)
            if self.stop.stopping:
                return Choice.NEXT
        for one in offered:
            if one.choice is choice:
                self._ended[-1] = passes.n_views, one.gain if law else None
                self.frames += one.frames * (choice in (Choice.WIDE, Choice.RETAKE))
        event = NextChosen(*facts, choice, by, reason, values, **self._outcome)
        self._outcome = {}
        self.sink(event)
        self.record({"predicted": None, "gained": None} | event.data)
        if choice is Choice.ENOUGH:
            self.stop.stop_as_enough(f"the views are enough: {reason}")
        return choice

    def _spent(self, passes: Passes) -> Spent:
        dose = (passes.n_views + self.frames) * frame_dose(self.timeline)
        return Spent(self.now() - self.began + self.seconds, dose)

    def _predict(self, passes: Passes) -> tuple[ErrorLaw | None, tuple[PassOption, ...]]:
        """The law of the views so far and the options by it; None if no law comes in time.

        An earlier law serves where by it the next pass is sure, so that the stage does not wait. Gains depend on ratios
        of numbers of views alone, so that a law of some of the views serves for all.
        """
        law = self._law and replace(self._law, n_views=passes.n_views)
        offered = options(passes, law, self.timeline, self.seconds_of)
        known = law and not (self.asks or self._unable)
        if law and known and next_is_sure(passes, offered, self.wish, self._spent(passes), law):
            return law, offered
        if not self._law_has_come():
            self.close_shutter()  # a law takes seconds
            self._wait(self._law_has_come)
        law = self._law and replace(self._law, n_views=passes.n_views) if self._law_of == len(self._ended) else None
        return law, options(passes, law, self.timeline, self.seconds_of)

    def _law_has_come(self) -> bool:
        """Whether the law of all views so far is there, or none can come."""
        return self._law_of == len(self._ended) or self._take_law() or bool(self.unable())

    def _take_law(self) -> bool:
        """Take up a law that has come; whether it is of all views so far, or late, and of an earlier pass."""
        if not self._laws:
            return False
        law = self._laws.pop()
        frames = law.n_views * self.timeline.plan.frames_per_view
        number = min(range(len(self._ended)), key=lambda i: (abs(self._ended[i][0] - frames - self._lost), -i)) + 1
        self._law_of, self._lost = number, self._ended[number - 1][0] - frames
        self._reason, of_law = law.reason, (law.exponent, law.exponent_error, law.noise, law.offset)
        self._law = None if law.reason or None in of_law else ErrorLaw(frames, *of_law)
        if law.gained is not None and number > 1:
            self._outcome = {"predicted": self._ended[number - 2][1], "gained": law.gained, "judged": number - 1}
        return number == len(self._ended)

    def _wait(self, until: Callable[[], bool], at_enter: Callable[[], None] = lambda: None) -> None:
        """Wait at most as long as it may, or until a stop."""
        for _ in range(round(self.wait / PAUSE_POLL)):
            if self.stop.stopping or until():
                return
            if self.wait_a_moment():
                at_enter()

    def _ask(self, recommended: Choice, offered: Sequence[PassOption]) -> tuple[str, Choice, str]:
        """Who chose, what, and why, once the operator has answered or time is over."""

        def answered() -> bool:
            if self.states.state is not State.ASKING:  # at first, and after a pause
                self.close_shutter()
                self.states.enter(State.ASKING)
            return self._answer is not None

        self.wait_a_moment()  # earlier input does not count
        self._answer, self._answers = None, frozenset({Choice.NEXT, *(one.choice for one in offered)})
        self._wait(answered, lambda: self.answer(recommended))
        self._answers = frozenset()
        if self._answer is None:
            return "plan", Choice.NEXT, f"no answer within {self.wait:g} s"
        return "operator", self._answer, "the operator chose it"
