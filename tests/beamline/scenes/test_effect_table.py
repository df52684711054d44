"""The effects with their parameters, without a look at the source."""

from dataclasses import fields

import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.scenes.request import effects_text, parameters
from simulators.effects.catalogue import CATALOGUE, load_effect


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_parameter_has_its_meaning(name: str) -> None:
    effect = load_effect(name)
    found = {key: (default, meaning) for key, default, meaning in parameters(effect)}
    assert [*found] == [field.name for field in fields(effect) if field.init]
    assert all(meaning for _, meaning in found.values())


def test_defaults_and_parameters_that_must_be_given() -> None:
    found = {key: default for key, default, _ in parameters(load_effect("zingers"))}
    assert found == {"rate": "", "charge": "3000", "tracks": "0", "length": "20", "radius": "0"}


def test_a_docstring_may_describe_two_parameters_at_once_and_go_on_in_the_next_line() -> None:
    found = {key: meaning for key, _, meaning in parameters(load_effect("motion_blur"))}
    assert found["tolerance_px"].endswith("it crosses the middle of the frame.")
    assert found["max_samples"] == "largest number of moments; each costs a frame's line integrals."


def test_the_command_prints_all_of_them_without_a_scene() -> None:
    done = CliRunner().invoke(main, ["simulate", "--effects"])
    assert done.exit_code == 0 and done.stdout.strip() == effects_text()
    assert all(f"{name}  ({row.domain.words}): {row.summary}" in done.stdout for name, row in CATALOGUE.items())
