"""A run of the fake instrument in passes, in which the test makes the decisions."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from beamline.config.load import Config
from beamline.config.planned import plan_of
from beamline.plan.passes import Choice, Passes
from beamline.plan.plan import ScanPlan
from beamline.scan.preflight import preflight
from beamline.scan.recorder import Recorder
from beamline.scan.supervision import Supervision

Chooser = Callable[[Passes], Choice | None]


@contextmanager
def choosing(patch: pytest.MonkeyPatch, choose: Chooser, pass_views: int = 0) -> Iterator[None]:
    """Scans in this context decide: `choose` is called after each pass, and its answer is recorded (None: no answer).

    Args:
        pass_views: also set in the configuration of the scans, which is used to read their files.
    """
    recorders: list[Recorder] = []
    pass_numbers = [0]  # number of the newest pass of each scan, from 1; a resumed scan continues counting

    def recorder(*given: Any, **more: Any) -> Recorder:
        recorders.append(Recorder(*given, **more))
        return recorders[-1]

    def next_pass(passes: Passes) -> Choice:
        if (choice := choose(passes)) is None:
            return Choice.NEXT
        pass_numbers[-1] += 1
        values = {"number": pass_numbers[-1], "n_views": passes.n_frames, "choice": choice, "predicted": float("nan")}
        recorders[-1].add_decision(values)
        return choice

    def ready(*given: Any, **more: Any) -> Any:
        checked = preflight(*given, **more)
        pass_numbers.append(len(checked.plan.choices))
        return replace(checked, info=replace(checked.info, decides=True))

    def in_passes(config: Config) -> ScanPlan:
        return replace(plan_of(config), pass_views=pass_views)

    def supervised(*given: Any, **more: Any) -> Supervision:
        return Supervision(*given, **more | {"next_pass": next_pass})

    with patch.context() as patched:
        patched.setattr("beamline.scan.preflight.plan_of", in_passes)
        patched.setattr("beamline.scan.run.preflight", ready)
        patched.setattr("beamline.scan.measurement.Recorder", recorder)
        patched.setattr("beamline.scan.measurement.Supervision", supervised)
        yield


class Scripted:
    """Chooses according to a script, or NEXT if that is impossible or the script has ended; records all choices."""

    def __init__(self, script: Iterable[Choice]) -> None:
        self.script, self.asked, self.answers = iter(script), list[Passes](), list[Choice]()

    def __call__(self, passes: Passes) -> Choice:
        choice = next(self.script, Choice.NEXT)
        possible = {
            Choice.NEXT: True, Choice.AGAIN: passes.may_repeat, Choice.OFFSET: bool(passes.offset),
            Choice.RETAKE: passes.retakes > 0, Choice.ENOUGH: True,
        }  # fmt: skip
        self.asked.append(passes)
        self.answers.append(choice if possible[choice] else Choice.NEXT)
        return self.answers[-1]
