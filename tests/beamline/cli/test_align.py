"""`beamline align`: what is printed, and its exit code."""

import json
from pathlib import Path

import pytest

from beamline.config.load import config_folder
from tests.beamline.cli.small_scan import beamline, succeeds

DEMO = (str(config_folder() / "demo.yaml"), "--set", "simulation.clock=virtual")


def test_axis_tilt_and_detail_with_their_corrections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = succeeds("align", *DEMO)
    assert [line.split()[0] for line in result.stdout.splitlines()] == ["axis", "tilt", "detail"]
    assert "right of the middle; move the axis 0.01" in result.stdout
    assert list(tmp_path.iterdir()) == []  # nothing is written


def test_json_and_views_that_show_no_axis() -> None:
    done = json.loads(beamline("align", *DEMO, "--json").stdout.splitlines()[-1])
    assert done["event"] == "done" and done["offset"] == pytest.approx(2.6, abs=0.1)
    empty = beamline("align", *DEMO, "--set", "devices.camera.roi=[0, 0, 40, 40]")
    assert empty.exit_code == 6 and "The two projections do not match: the axis is perhaps near column" in empty.stderr


@pytest.mark.parametrize(("angle", "told"), [("400", "at 400° and 220°, but the stage can only go from -5° to 365°")])
def test_an_angle_that_the_stage_does_not_reach_is_refused_before_anything_moves(angle: str, told: str) -> None:
    result = beamline("align", *DEMO, "--angle", angle)
    assert result.exit_code == 2 and told in result.stderr
    assert "frames" not in result.stderr
