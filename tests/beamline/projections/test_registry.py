"""Correction steps: their order, their options by default, and the record of steps that state nothing."""

from __future__ import annotations

import pytest

from beamline.projections.corrections.rings.rings import Rings
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import PrepStep
from beamline.projections.registry import all_steps, recorded, registered, steps_of
from beamline.projections.step import StepDone, key_of, options_of


def test_each_comes_after_those_that_it_follows_and_no_two_share_a_name() -> None:
    names = [step.name for step in all_steps()]
    assert len(set(names)) == len(registered()) == len(names)
    assert all(names.index(before) < names.index(step.name) for step in all_steps() for before in step.follows)


def test_options_as_they_stand_are_the_steps_of_nothing_asked() -> None:
    options = [each for step in registered() for each in options_of(step).values()]
    values = {key_of(each.name): None if each.default is None else each.parse(each.default) for each in options}
    assert len(values) == len(options)
    assert steps_of(values) == tuple(step() for step in registered())
    assert not any(step.needs_finished for step in steps_of(values))
    with pytest.raises(ValueError, match="--gain"):
        steps_of(values | {"noise": "log", "gain": 2.0})


def test_the_file_records_what_a_step_says_or_its_options() -> None:
    steps: list[PrepStep] = [Preparation("ignore", noise="counts", gain=2.0), Rings("vo")]
    done = {"rings": StepDone("none was found", {"rings_removed": "none was found"}), "noise": StepDone("counted")}
    expected = {
        "flags": "ignore",
        "references": "check",
        "noise": "counts",
        "gain": 2.0,
        "flat_fields": "groups",
        "ring_current": "ignore",
        "noise_said": "counted",
        "rings_removed": "none was found",
    }
    assert recorded(steps, done) == expected
