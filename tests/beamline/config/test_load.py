"""Configuration: precedence, defaults, round trip, the plan made from it, and its scenes."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from beamline.config import load as config
from beamline.config.planned import plan_of
from beamline.core.errors import ConfigError
from beamline.plan.passes import Choice
from beamline.plan.plan import Mode, Place
from tests.beamline.config_file import CONFIGS, GOOD, faults, load, write
from tests.messages import refused


@pytest.mark.parametrize("name", CONFIGS)
def test_shipped_configurations_are_valid(name: str) -> None:
    loaded = config.load(config.config_folder() / f"{name}.yaml", environment={})
    assert plan_of(loaded).angles.size == loaded.scan.angles.views  # type: ignore[union-attr]
    assert loaded.simulated == (name != "instrument")


def test_defaults_and_numbers_as_people_write_them(tmp_path: Path) -> None:
    loaded = load(write(tmp_path))
    assert loaded.scan.period_s == 0.05  # YAML 1.1 reads 5e-2 as text
    assert loaded.scan.mode is Mode.FLY
    assert (loaded.scan.flats.count, loaded.scan.flats.at) == (10, Place.START)
    assert loaded.devices.camera.roi == (0, 0, 8, 8)
    with pytest.raises(ValidationError):
        loaded.scan.period_s = 1.0


PASSES = "scan.angles={scheme: interlaced, views: 12, passes: 3}"


def test_a_decision_is_off_unless_asked_for_and_off_needs_no_quotes(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD.replace("scan:\n", "scan:\n  decide: off\n"))
    assert load(path).scan.decide == load(write(tmp_path)).scan.decide == "off"
    assert load(path, "scan.decide=off", BEAMLINE_SCAN__DECIDE="off").scan.decide == "off"
    decides = load(path, "scan.decide=do", PASSES)
    target = decides.scan.target
    assert (target.quality_db, target.seconds, target.dose, decides.scan.wait_s) == (1.0, None, None, 30.0)
    target = load(path, "scan.decide=do", PASSES, "scan.target={seconds: 600, dose: 0.5}").scan.target
    assert (target.quality_db, target.seconds, target.dose) == (None, 600.0, 0.5)
    assert config.changed(decides, config.NO_LIVE).scan.decide == "off"  # read back from text


def test_names_of_keys_in_the_last_version_are_understood_with_their_places(tmp_path: Path) -> None:
    old = GOOD.replace("scan:\n", "scan:\n  wish: {seconds: 600}\n  without_watchdog: pause\n")
    scan = load(write(tmp_path, old), "scan.wish.dose=0.5", BEAMLINE_SCAN__WITHOUT_WATCHDOG="warn").scan
    assert (scan.target.seconds, scan.target.dose, scan.on_watchdog_loss) == (600.0, 0.5, "warn")
    assert "my.yaml:3: scan.target.seconds is -1; expected" in faults(tmp_path, old.replace("600", "-1"))
    both = faults(tmp_path, old.replace("  wish", "  target: {dose: 1}\n  wish"))
    assert "my.yaml:4: scan.wish is not a known key" in both
    assert Choice("wide") is Choice.OFFSET


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            (),
            "scan.decide ask needs a scan in several passes; set scan.angles to {scheme: interlaced, passes: 8, ...}, "
            "or in a step scan",
        ),
        (("scan.pass_views=6",), "needs a scan in several passes"),  # a fly scan
        (("scan.angles={scheme: interlaced, views: 12, passes: 1}",), "needs a scan in several passes"),
        (("scan.mode=step", PASSES), "needs a scan in several passes"),
        ((PASSES, "recon.live=false"), "scan.decide ask needs a live volume; set recon.live to true"),
        (
            (PASSES, "recon.method=fbp"),
            "needs a volume that grows during the scan, which only r2 makes; set recon.method to r2",
        ),
        ((PASSES, "recon.method=auto"), "set recon.method to r2"),
    ],
)
def test_a_scan_cannot_decide_without_what_a_prediction_needs(
    tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load(write(tmp_path), "scan.decide=ask", *words)
    assert sentence in str(caught.value) and "or set scan.decide to off, so that the scan follows its plan" in str(
        caught.value
    )


def test_a_step_scan_decides_with_passes_of_some_views(tmp_path: Path) -> None:
    assert load(write(tmp_path), "scan.decide=ask", "scan.mode=step", "scan.pass_views=4").scan.pass_views == 4


def test_precedence_flags_environment_file_defaults(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert load(path).scan.settle_s == 0.1
    assert load(path, BEAMLINE_SCAN__SETTLE_S="0.5").scan.settle_s == 0.5
    both = load(path, "scan.settle_s=0.7", "recon.axis=4.5", BEAMLINE_SCAN__SETTLE_S="0.5", BEAMLINE_SCAN__PERIOD_S="1")
    assert (both.scan.settle_s, both.scan.period_s, both.recon.axis) == (0.7, 1.0, 4.5)
    whole = load(path, "scan.angles={scheme: interlaced, views: 12, passes: 3}", "scan.darks.at=none")
    assert whole.scan.angles.scheme == "interlaced"
    assert whole.scan.darks.at is Place.NONE
    # A site's own variables are left alone.
    assert load(path, BEAMLINE_NAME="bl1", HOME="/x").sample.name == "test"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("rinsed # 3 times", "rinsed # 3 times"),
        ("# 3", "# 3"),
        ("007", "007"),
        ("before: after", "before: after"),
        ("[a", "[a"),
        ("two\nlines", "two\nlines"),
        ("'quoted # text'", "quoted # text"),
        ('"a\\tb"', "a\tb"),
        ("", ""),
        ("yes", "yes"),
        ("'s own", None),
    ],
)
def test_a_key_that_takes_text_takes_it_as_it_stands(tmp_path: Path, value: str, text: str | None) -> None:
    path = write(tmp_path)
    if text is None:
        with pytest.raises(ConfigError, match="this is not YAML"):
            load(path, f"sample.description={value}")
        return
    if text:
        assert load(path, f"sample.description={value}").sample.description == text
    described = load(path, config.override_of("sample.description", text)).sample.description
    assert described == text
    assert load(path, "scan.filter=null").scan.filter is None  # a name, or nothing
    assert load(path, "scan.period_s=0.2 # s").scan.period_s == 0.2


@pytest.mark.parametrize("name", CONFIGS)
def test_resolved_reads_back_as_itself(name: str, tmp_path: Path) -> None:
    loaded = config.load(config.config_folder() / f"{name}.yaml", environment={})
    text = config.resolved_yaml(loaded)
    assert text.splitlines()[0].startswith("# splatline ")
    assert str(config.config_folder().parent) not in text  # nothing of this machine
    assert load(write(tmp_path, text)) == loaded


def test_schema_describes_a_configuration() -> None:
    schema = config.schema()
    json.dumps(schema)
    assert schema["additionalProperties"] is False
    assert {"sample", "scan", "devices", "optics"} <= set(schema["required"])
    period = schema["$defs"]["ScanSection"]["properties"]["period_s"]
    assert period["exclusiveMinimum"] == 0
    assert "fly scan" in period["description"]


def test_plan_of_every_scheme(tmp_path: Path) -> None:
    (tmp_path / "angles.txt").write_text("0\n45\n# no more\n", encoding="utf-8")
    path = write(tmp_path)
    for angles, first, last, n in (
        ("{scheme: fixed, views: 4, start_deg: 10, span_deg: -360}", 10, -260, 4),
        ("{scheme: sector, views: 3, first_deg: 30, last_deg: 150}", 30, 150, 3),
        ("{scheme: interlaced, views: 8, passes: 2}", 0, 157.5, 8),
        ("{scheme: golden, views: 2}", 0, 180 * (math.sqrt(5) - 1) / 2, 2),
    ):
        plan = plan_of(load(path, f"scan.angles={angles}"))
        assert plan.angles.size == n
        np.testing.assert_allclose(np.rad2deg(plan.angles[[0, -1]]), [first, last])
    seeded = [plan_of(load(path, f"scan.angles={{scheme: random, views: 9, seed: {s}}}")).angles for s in (1, 1, 2)]
    np.testing.assert_array_equal(seeded[0], seeded[1])
    assert not np.array_equal(seeded[0], seeded[2])
    # An angle file is found beside the configuration file, wherever the command runs.
    beside = write(tmp_path, GOOD.replace("{scheme: fixed, views: 12}", "{scheme: file, path: angles.txt}"), "b.yaml")
    np.testing.assert_allclose(plan_of(load(beside)).angles, [0, math.pi / 4])


def test_several_frames_a_view_are_of_a_step_scan_that_takes_none_again(tmp_path: Path) -> None:
    path = write(tmp_path)
    plan = plan_of(load(path, "scan.mode=step", "scan.frames_per_view=3"))
    assert (plan.n_views, plan.angles.size) == (12, 36)
    np.testing.assert_array_equal(plan.angles.reshape(12, 3).T, [plan.angles[::3]] * 3)
    with refused(ConfigError):
        load(path, "scan.frames_per_view=3")
    with refused(ConfigError):
        load(path, "scan.mode=step", "scan.frames_per_view=3", "monitor.retake=true")


def test_scenes_inline_beside_and_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / "installed"
    (installed / "scenes").mkdir(parents=True)
    write(installed / "scenes", "from: installed\n", "a.yaml")
    monkeypatch.setattr(config, "config_folder", lambda: installed)
    home = tmp_path / "home"
    home.mkdir()
    path = write(home, GOOD.replace("simulation: {}", "simulation: {scene: scenes/a.yaml}"))
    assert config.scene_mapping(load(path)) == {"from": "installed"}
    assert "scene: scenes/a.yaml" in config.resolved_yaml(load(path))  # portable: no machine's folder in it
    (home / "scenes").mkdir()
    write(home / "scenes", "from: home\n", "a.yaml")
    assert config.scene_mapping(load(path)) == {"from": "home"}
    assert config.scene_mapping(load(path, "simulation.scene={phantom: none}")) == {"phantom": "none"}
    monkeypatch.chdir(tmp_path)
    named = load(path, "simulation.scene=installed/scenes/a.yaml")  # a shipped scene, named from where one stands
    assert config.scene_mapping(named) == {"from": "installed"}
    assert named.simulation is not None
    assert named.simulation.scene == "scenes/a.yaml"
    with pytest.raises(ConfigError, match=r"--set .*simulation\.scene:.*scenes/a\.yaml"):
        load(path, "simulation.scene=absent.yaml")
