"""A run of the fake instrument in passes, whose choices a test makes."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from beamline.config.load import Config, plan_of
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import ScanPlan
from beamline.scan.preflight import preflight
from beamline.scan.recorder import Recorder
from beamline.scan.supervision import Supervision

Chooser = Callable[[Passes], Choice]


@contextmanager
def choosing(patch: pytest.MonkeyPatch, choose: Chooser, pass_views: int = 0) -> Iterator[None]:
    """Scans in the block decide: `choose` is asked after each pass, and each answer is recorded."""
    recorders: list[Recorder] = []
    numbers = [0]  # of the passes so far

    def recorder(*given: Any, **more: Any) -> Recorder:
        recorders.append(Recorder(*given, **more))
        return recorders[-1]

    def next_pass(passes: Passes) -> Choice:
        choice = choose(passes)
        numbers[-1] += 1
        values = {"number": numbers[-1], "n_views": passes.n_views, "choice": choice, "predicted": float("nan")}
        recorders[-1].add_decision(values)
        return choice

    def ready(*given: Any, **more: Any) -> Any:
        made = preflight(*given, **more)
        numbers.append(len(made.plan.choices))
        return replace(made, info=replace(made.info, decides=True))

    def in_passes(config: Config) -> ScanPlan:
        return replace(plan_of(config), pass_views=pass_views)

    def supervised(*given: Any, **more: Any) -> Supervision:
        return Supervision(*given, **more | {"next_pass": next_pass})

    with patch.context() as within:
        for module in ("preflight", "resume"):
            within.setattr(f"beamline.scan.{module}.plan_of", in_passes)
        within.setattr("beamline.scan.run.preflight", ready)
        within.setattr("beamline.scan.measurement.Recorder", recorder)
        within.setattr("beamline.scan.measurement.Supervision", supervised)
        yield


class Asked:
    """Answers by a script, where they are possible, else that the plan goes on; keeps what it was asked."""

    def __init__(self, script: Iterable[Choice]) -> None:
        self.script, self.asked, self.answers = iter(script), list[Passes](), list[Choice]()

    def __call__(self, passes: Passes) -> Choice:
        choice = next(self.script, Choice.NEXT)
        possible = {
            Choice.NEXT: True, Choice.AGAIN: passes.may_repeat, Choice.WIDE: bool(passes.wide),
            Choice.RETAKE: passes.retakes > 0, Choice.ENOUGH: True,
        }  # fmt: skip
        self.asked.append(passes)
        self.answers.append(choice if possible[choice] else Choice.NEXT)
        return self.answers[-1]
