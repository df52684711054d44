"""The scripts in docs/examples run unchanged, with the simulated instrument on a virtual clock."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from beamline.config.load import config_folder
from tests.beamline.api.test_tutorials import TUTORIALS

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"

Example = Callable[..., str]


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Example:
    """Run a script as `python SCRIPT my.yaml ...` does; what it printed."""

    def run(name: str, *words: str) -> str:
        settings = yaml.safe_load((config_folder() / "simulated.yaml").read_text())
        settings["scan"] |= {
            "angles": {"scheme": "fixed", "views": 45, "start_deg": 0, "span_deg": 180},
            "period_s": 1.0,
            "darks": {"count": 3, "at": "start"},
            "flats": {"count": 3, "at": "start"},
        }
        settings["devices"]["camera"]["roi"] = [1148, 2000, 8, 96]
        settings["recon"]["live"] = False
        settings["simulation"]["clock"] = "virtual"
        (tmp_path / "my.yaml").write_text(yaml.safe_dump(settings))
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, "my.yaml", *words])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_there_is_a_test_of_each_example() -> None:
    here = {"day_of_samples.py", "energy_series.py", "inspect_and_rescan.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == here | {f"{name}.py" for name in TUTORIALS}


@pytest.mark.slow
def test_a_day_of_samples(example: Example, tmp_path: Path) -> None:
    lines = example("day_of_samples.py", "cathode-1", "cathode-2").splitlines()
    assert [line.split()[:3] for line in lines] == [["cathode-1", "complete", "51"], ["cathode-2", "complete", "51"]]
    assert len(list((tmp_path / "runs").iterdir())) == 2


@pytest.mark.slow
def test_an_energy_series(example: Example, tmp_path: Path) -> None:
    lines = example("energy_series.py", "24.9", "25.1").splitlines()
    assert [line.split()[0] for line in lines] == ["24.9", "25.1"]
    assert all(" 1/mm " in line for line in lines)
    assert len(list((tmp_path / "runs").glob("*/fbp.h5"))) == 2


def test_scan_inspect_rescan(example: Example, tmp_path: Path) -> None:
    out = example("inspect_and_rescan.py", "cathode-3")
    assert out.startswith("runs/") and "51 frames, volume None" in out
    # Both may begin in one second, which is all that their names tell of the order.
    assert {run.name.partition("_")[2] for run in (tmp_path / "runs").iterdir()} == {"cathode-3_look-1", "cathode-3"}
