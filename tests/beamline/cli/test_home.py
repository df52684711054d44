"""`beamline home`: asks before the stage turns, reports the position, and stops the stage if it is interrupted."""

import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config import load as config
from drivers.stages.pm16c.stage import PM16CStage
from drivers.stages.zaber.stage import ZaberStage

pytestmark = pytest.mark.usefixtures("simulated_zaber")

SIMULATED = str(config.config_folder() / "simulated.yaml")
FAST = ("--set", "simulation.clock=virtual")
FIGURES = "counts_per_turn: 360000, max_speed_deg_s: 30, acceleration_deg_s2: 60"


def run(*arguments: str, answer: str = "") -> Result:
    return CliRunner().invoke(main, ["home", SIMULATED, *FAST, *arguments], input=answer)


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
def test_a_stage_finds_its_reference(kind: str) -> None:
    result = run("--yes", "--set", f"devices.stage={{kind: {kind}, port: 'sim://{kind}', {FIGURES}}}")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == "The stage has found its reference mark and is at 0.0000 deg.\n"


def test_a_home_switch_gets_its_angle() -> None:
    result = run("--yes", "--set", "devices.stage.home_deg=12.5")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "is at 12.5000 deg" in result.stdout


def test_a_stage_without_a_reference_refuses() -> None:
    result = run("--yes")
    assert result.exit_code == 3
    assert "it has no home switch" in result.stderr and "Nothing has moved" in result.stderr


@pytest.mark.parametrize("answer", ["n\n", "\n", ""])
def test_nothing_turns_before_somebody_says_so(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    def moved(self: PM16CStage) -> None:
        raise AssertionError("it turned")

    monkeypatch.setattr(PM16CStage, "start_home", moved)
    result = run(answer=answer)
    assert result.exit_code == 130
    assert "May it turn?" in result.stderr
    assert "Nothing has moved, because the search was not confirmed" in result.stderr


def test_an_interrupted_search_stops_the_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[str] = []

    def interrupted(self: ZaberStage, timeout: float) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(ZaberStage, "wait", interrupted)
    monkeypatch.setattr(ZaberStage, "stop", lambda self: stopped.append(self.name))
    result = run("--yes", "--set", f"devices.stage={{kind: zaber, port: 'sim://zaber', {FIGURES}}}")
    assert (result.exit_code, stopped) == (130, ["stage"])
