"""Stop: a request and a deadline, alone and together."""

from __future__ import annotations

import math

from recon.base.decisions import GoesOn, Stop
from recon.base.method import RunControl


def test_who_has_asked_is_not_asked_again() -> None:
    answers = iter([False, True])
    stop = Stop(lambda: next(answers))
    assert [stop(), stop(), stop()] == [False, True, True]
    assert stop.stopped and stop.cut(3, 9) and not stop.cut(9, 9) and stop.cut(9, 0)


def test_work_that_was_ended_is_not_asked_again() -> None:
    answers = [True, False, True]
    going = GoesOn(lambda step, residual: answers.pop(0))
    assert going.going
    assert [going(step, 0.1) for step in range(4)] == [True, False, False, False]
    assert not going.going and answers == [True]


def test_iterations_that_follow_others_count_on_and_end_with_them() -> None:
    heard: list[int] = []
    first = GoesOn(lambda step, residual: not heard.append(step) and step < 8)
    then = first.after(3, each=2)
    assert [then(step, 0.1) for step in (1, 2, 3, 4)] == [True, True, False, False]
    assert heard == [5, 7, 9] and not first.going and not then.going


def test_the_end_of_trials_is_not_the_end_of_the_iterations() -> None:
    nobody, ended = GoesOn(lambda step, residual: True), GoesOn(trials=GoesOn(lambda step, residual: False))
    assert nobody.trials() and nobody.trials.trials() and nobody()
    assert not ended.trials() and ended() and ended.after(3).trials is ended.trials


def test_a_deadline_ends_work_and_is_nobodys_stop() -> None:
    times = iter([59.9, 60.0])
    stop = Stop(deadline=60.0, now=lambda: next(times))
    assert [stop(), stop()] == [False, True] and not stop.stopped
    assert Stop(deadline=60.0, now=lambda: 54.0).leaves(6.0) and not Stop(deadline=60.0, now=lambda: 54.0).leaves(6.1)
    assert Stop().leaves(math.inf)


def test_the_earlier_of_two_deadlines_and_either_of_two_askers_count() -> None:
    first = Stop(lambda: asked, deadline=9.0, now=lambda: now)
    both = first.by(5.0, lambda: now)
    asked, now = False, 4.0
    assert not both()
    now = 5.0
    assert both() and not first()
    now, asked = 1.0, True
    assert both() and both.stopped and first.stopped


def test_a_control_asks_any_function_and_keeps_a_stop() -> None:
    assert not RunControl().stop() and RunControl(lambda: True).stop()
    stop = Stop()
    assert RunControl(stop).stop is stop
    control = RunControl(lambda: False, now=lambda: 3.0, stop_trials=lambda: True).by(3.0)
    assert control.stop() and control.stop_of_trials()
    assert RunControl(lambda: True).stop_of_trials()
