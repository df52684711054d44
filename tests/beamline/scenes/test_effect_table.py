"""The table of effects and their parameters is complete, without reading the source."""

from dataclasses import fields

from click.testing import CliRunner

from beamline.cli.main import main
from simulators.effects.catalogue import CATALOGUE, load_effect


def test_the_command_prints_each_effect_with_its_parameters_their_defaults_and_meaning() -> None:
    done = CliRunner().invoke(main, ["simulate", "--effects"])
    assert done.exit_code == 0
    for name, row in CATALOGUE.items():
        line, _, rest = done.stdout.partition(f"  {row.domain.words}: {row.summary}\n")
        assert line.rpartition("\n")[2].startswith(f"{name}("), name
        for field in (field for field in fields(load_effect(name)) if field.init):
            assert field.name in line.rpartition("\n")[2] and field.name in rest, (name, field.name)
    assert "zingers(rate, charge=3000.0, tracks=0.0" in done.stdout
