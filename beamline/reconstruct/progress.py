"""Progress of a fit or of iterations as events (steps, rate, time left), and the corrections before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from beamline.core.events import FitReached, KernelsCompiled, Sink, StateEntered
from beamline.core.machine_speed import seconds_left
from drivers.base.clock import Clock
from recon.base.method import Progress


def progress_events(
    sink: Sink, clock: Clock, seconds: float | None = None, waiting: Callable[[], int] = lambda: 0
) -> Callable[[Progress], None]:
    """A listener that passes progress on as events, with `per_s` (steps) and `eta_s`; None where they are not known.
    `seconds`: time of the fit, if no number of steps is planned. `waiting`: views that it has not learnt yet.
    """
    first: Progress | None = None
    step = 0

    def on_progress(progress: Progress) -> None:
        nonlocal first, step
        if first is None or progress.step < step:  # a followed scan's fit may begin anew
            first = progress
        step = progress.step
        made, spent = progress.step - first.step, progress.seconds - first.seconds
        rate = made / spent if made > 0 and spent > 0 else None
        eta = None
        if progress.steps:
            eta = seconds_left(made, progress.steps - first.step, spent)
        elif seconds is not None and not progress.unit:
            eta = max(0.0, seconds - spent)
        sink(FitReached("recon", **vars(progress), per_s=rate, eta_s=eta, waiting=waiting(), time=clock.now()))

    return on_progress


def compilation_events(sink: Sink, clock: Clock) -> Callable[[int], None]:
    """A listener that passes the number of kernels compiled so far on as events."""
    begin = clock.now()

    def compiled(n: int) -> None:
        now = clock.now()
        sink(KernelsCompiled("kernels", n, now - begin, time=now))

    return compiled


def corrections_done(messages: Mapping[str, str], sink: Sink, clock: Clock) -> None:
    """Report what each correction did to the views; "" is not reported."""
    for state, message in messages.items():
        if message:
            sink(StateEntered(state, message, time=clock.now()))
