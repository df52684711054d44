"""`beamline config`: its output can be used as a configuration."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config import load as config


def run(*arguments: str, environment: dict[str, str] | None = None) -> Result:
    return CliRunner().invoke(main, ["config", *arguments], env=environment)


@pytest.mark.parametrize(("arguments", "name"), [((), "simulated"), (("--instrument",), "instrument")])
def test_init_prints_a_commented_configuration_that_loads(
    arguments: tuple[str, ...], name: str, tmp_path: Path
) -> None:
    result = run("init", *arguments)
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == (config.config_folder() / f"{name}.yaml").read_text(encoding="utf-8")
    (tmp_path / "my.yaml").write_text(result.stdout, encoding="utf-8")
    # Away from the package's own folder it still finds its scene.
    loaded = config.load(tmp_path / "my.yaml", environment={})
    assert loaded.simulated == (name == "simulated")
    if loaded.simulated:
        assert "phantom" in config.scene_mapping(loaded)


def test_show_resolves_overrides_and_environment(tmp_path: Path) -> None:
    demo = str(config.config_folder() / "demo.yaml")
    result = run("show", demo, "--set", "scan.period_s=0.2", environment={"BEAMLINE_SAMPLE__NAME": "cell-7"})
    assert result.exit_code == 0
    assert result.stdout.startswith("# splatline ")
    shown = yaml.safe_load(result.stdout)
    assert (shown["scan"]["period_s"], shown["sample"]["name"], shown["storage"]["folder"]) == (0.2, "cell-7", "runs")
    (tmp_path / "resolved.yaml").write_text(result.stdout, encoding="utf-8")
    assert run("show", str(tmp_path / "resolved.yaml")).stdout == result.stdout


def test_schema_is_json() -> None:
    result = run("schema")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == config.schema()
