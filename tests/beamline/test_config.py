"""Configuration: precedence, round trip, and faults that say file, line, key, what was found and what is legal."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pydantic import BaseModel, ValidationError

from beamline import config
from beamline.config_devices import DcamOrca, SimulatedOrca
from beamline.config_models import Config
from beamline.config_stages import PiGcsStageConfig, ZaberStageConfig
from beamline.errors import ConfigError
from beamline.plan import Mode, Place

CONFIGS = ("simulated", "instrument", "demo")
GOOD = """\
sample: {name: test}
scan:
  angles: {scheme: fixed, views: 12}
  exposure_s: 0.01
  period_s: 5e-2
devices:
  stage: {kind: pm16c, port: "sim://pm16c", counts_per_turn: 3600, max_speed_deg_s: 30, acceleration_deg_s2: 60}
  camera: {kind: simulated_orca, roi: [0, 0, 8, 8]}
  shutter: {kind: simulated}
  sample_mover: {kind: simulated}
optics: {pixel_size_um: 5}
simulation: {}
"""


def write(folder: Path, text: str = GOOD, name: str = "my.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def load(path: Path, *overrides: str, **environment: str) -> Config:
    return config.load(path, overrides, environment)


def faults(folder: Path, text: str, *overrides: str, **environment: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(write(folder, text), *overrides, **environment)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(str(folder / "my.yaml"), "my.yaml")


@pytest.mark.parametrize("name", CONFIGS)
def test_shipped_configurations_are_valid(name: str) -> None:
    loaded = config.load(config.config_folder() / f"{name}.yaml", environment={})
    assert config.plan_of(loaded).angles.size == loaded.scan.angles.views  # type: ignore[union-attr]
    assert loaded.simulated == (name != "instrument")


def test_templates_are_complete_and_differ_only_in_devices() -> None:
    """Every key there is stands in the template, so that an operator never has to guess one."""
    simulated, instrument = (
        yaml.safe_load((config.config_folder() / f"{name}.yaml").read_text("utf-8"))
        for name in ("simulated", "instrument")
    )
    for name, template in (("simulated", simulated), ("instrument", instrument)):
        resolved = yaml.safe_load(config.resolved_yaml(config.load(config.config_folder() / f"{name}.yaml", (), {})))
        if name == "instrument":
            assert resolved.pop("simulation") is None
        assert _keys(template) == _keys(resolved)
    assert "simulation" not in instrument
    assert _keys(simulated) - _keys(instrument) == {
        ("simulation",),
        *((("simulation", k)) for k in simulated["simulation"]),
    }
    only_real = DcamOrca.model_fields.keys() - SimulatedOrca.model_fields.keys()
    assert {"library", "index", "link", "trigger_active"} < only_real
    assert _keys(instrument) - _keys(simulated) == {("devices", "camera", key) for key in only_real}
    kinds = {
        name: [d[k]["kind"] for k in ("camera", "shutter", "sample_mover")]
        for name, d in (("simulated", simulated["devices"]), ("instrument", instrument["devices"]))
    }
    assert kinds == {
        "simulated": ["simulated_orca", "simulated", "simulated"],
        "instrument": ["dcam", "manual", "manual"],
    }


@pytest.mark.parametrize("name", ["simulated", "instrument"])
def test_every_alternative_in_a_template_is_one(name: str) -> None:
    """The commented devices, put in the place of the ones that stand there."""
    text = (config.config_folder() / f"{name}.yaml").read_text("utf-8")
    offered = re.findall(r"^  # (stage|shutter|beam_monitor): (\{.*?\})(?=\s|$)", text, re.MULTILINE)
    kinds = set()
    for key, flow in offered:
        tree = yaml.safe_load(text)
        mine = yaml.safe_load(flow)
        of_the_pm16c = ("channel", "first_pulse", "home_deg", "home_speed_deg_s")
        old = {"stage": of_the_pm16c}.get(key, tuple(tree["devices"][key]))
        tree["devices"][key] = {k: v for k, v in tree["devices"][key].items() if k not in old} | mine
        if mine["kind"] == "stage_output":  # which the PM16C has not
            stage = yaml.safe_load(next(flow for _, flow in offered if "zaber" in flow))
            tree["devices"]["stage"] = {
                k: v for k, v in tree["devices"]["stage"].items() if k in ZaberStageConfig.model_fields
            } | stage
        loaded = Config.model_validate(tree)
        assert getattr(loaded.devices, key).kind == mine["kind"]
        kinds.add(mine["kind"])
    assert kinds == {"pi_gcs", "zaber", "stage_output", "electrometer"} | (
        {"ring_current"} if name == "instrument" else set()
    )


def _keys(value: Any, path: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    if not isinstance(value, dict):
        return set()
    return {(*path, key) for key in value} | {k for key, child in value.items() for k in _keys(child, (*path, key))}


def test_defaults_and_numbers_as_people_write_them(tmp_path: Path) -> None:
    loaded = load(write(tmp_path))
    assert loaded.scan.period_s == 0.05  # YAML 1.1 reads 5e-2 as text
    assert loaded.scan.mode is Mode.FLY
    assert (loaded.scan.flats.count, loaded.scan.flats.at) == (10, Place.START)
    assert loaded.devices.camera.roi == (0, 0, 8, 8)
    with pytest.raises(ValidationError):
        loaded.scan.period_s = 1.0  # type: ignore[misc]


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


def test_the_process_environment_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BEAMLINE_SAMPLE__NAME", "from-outside")
    assert config.load(write(tmp_path)).sample.name == "from-outside"


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
    period = schema["$defs"]["Scan"]["properties"]["period_s"]
    assert period["exclusiveMinimum"] == 0
    assert "fly scan" in period["description"]


FAULTS = {
    "unknown key": (
        ("exposure_s: 0.01", "exposure_s: 0.01\n  setle_s: 1"),
        "my.yaml:5: scan.setle_s is not a known key (did you mean settle_s?); legal keys there: mode, angles",
    ),
    "key of another scheme": (
        ("views: 12", "views: 12, seed: 1"),
        "my.yaml:3: scan.angles.seed is not a known key; legal keys there: scheme, views, start_deg, span_deg",
    ),
    "missing": (("exposure_s: 0.01", "settle_s: 0"), "my.yaml:2: scan.exposure_s is missing; expected a number > 0"),
    "choice": (
        ("sample: {name: test}", "sample: {name: test}\nrecon: {method: r3}"),
        "my.yaml:2: recon.method is 'r3'; expected r2 | fbp",
    ),
    "scheme": (
        ("scheme: fixed", "scheme: goldn"),
        "my.yaml:3: scan.angles.scheme is 'goldn' (did you mean golden?); "
        "expected fixed | sector | random | interlaced | golden | file",
    ),
    "no scheme": (("scheme: fixed, ", ""), "my.yaml:3: scan.angles.scheme is missing; expected fixed | sector"),
    "range": (("exposure_s: 0.01", "exposure_s: -1"), "my.yaml:4: scan.exposure_s is -1; expected a number > 0"),
    "infinite": (("exposure_s: 0.01", "exposure_s: .inf"), "my.yaml:4: scan.exposure_s is .inf; expected a number > 0"),
    "not a number": (("exposure_s: 0.01", "exposure_s: short"), "scan.exposure_s is 'short'; expected a number > 0"),
    "truth": (("views: 12", "views: yes"), "my.yaml:3: scan.angles: views is true (YAML reads yes, no, on and off"),
    "fraction": (("views: 12", "views: 12.5"), "scan.angles.views is 12.5; expected a whole number > 0"),
    "views without end": (
        ("views: 12", "views: 1000000000"),
        "my.yaml:3: scan.angles.views is 1000000000; expected a whole number > 0 and <= 1000000",
    ),
    "list": (
        ("[0, 0, 8, 8]", "[0, 0, 8]"),
        "my.yaml:8: devices.camera.roi is [0, 0, 8]; expected a list of 4: row0, col0",
    ),
    "list item": (
        ("[0, 0, 8, 8]", "[0, 0, 8, x]"),
        "my.yaml:8: devices.camera.roi.3 is 'x'; expected a whole number >= 1",
    ),
    "name": (("name: test", "name: a/b"), "sample.name is 'a/b'; expected text of letters, digits and _"),
    "scalar for a group": (
        ("{pixel_size_um: 5}", "5"),
        "my.yaml:11: optics is 5; expected a group of keys: pixel_size_um",
    ),
    "limits": (
        ("counts_per_turn", "low_deg: 3, high_deg: 2, counts_per_turn"),
        "my.yaml:7: devices.stage: low_deg 3.0 must lie below high_deg 2.0",
    ),
    "mixed": (
        ('"sim://pm16c"', "COM3"),
        "my.yaml:1: the configuration: simulated devices cannot see real ones: camera, "
        "shutter, sample_mover simulated, stage real",
    ),
    "stage of no kind": (
        ("kind: pm16c", "kind: pm16"),
        "my.yaml:7: devices.stage.kind is 'pm16' (did you mean pm16c?); expected pm16c | pi_gcs | zaber",
    ),
    "key of another stage": (
        ("counts_per_turn", "axis: 1, counts_per_turn"),
        "my.yaml:7: devices.stage.axis is not a known key; legal keys there: kind, port",
    ),
    "counterpart of another stage": (
        ("kind: pm16c", "kind: zaber"),
        "my.yaml:7: devices.stage: port sim://pm16c is not the simulated counterpart of zaber, sim://zaber",
    ),
    "an output that the PM16C has not": (
        ("shutter: {kind: simulated}", "shutter: {kind: stage_output, output: 2}"),
        "my.yaml:6: devices: the PM16C has no digital output for a shutter; set shutter.kind: manual",
    ),
    "an electrometer that sees no simulated beam": (
        ("  shutter:", "  beam_monitor: {kind: electrometer, port: COM4}\n  shutter:"),
        "simulated devices cannot see real ones: stage, camera, shutter, sample_mover simulated, beam_monitor real",
    ),
    "a pattern that finds nothing": (
        ("  shutter:", "  beam_monitor: {kind: ring_current, url: 'http://ring/', pattern: mA}\n  shutter:"),
        "my.yaml:9: devices.beam_monitor.pattern: the pattern 'mA' has no group (...) around the number",
    ),
    "no page": (
        ("  shutter:", "  beam_monitor: {kind: ring_current, url: ring, pattern: (.)}\n  shutter:"),
        "my.yaml:9: devices.beam_monitor.url: 'ring' is no address of a page: http://host/...",
    ),
    "no simulation": (("simulation: {}\n", ""), "simulated devices need a simulation section"),
    "twice": (
        ("  exposure_s: 0.01\n", "  exposure_s: 0.01\n  exposure_s: 0.02\n"),
        "my.yaml:5: scan.exposure_s is said twice (also in line 4)",
    ),
    "no YAML": (("exposure_s: 0.01", "exposure_s: [0.01"), "my.yaml:5: this is not YAML"),
    "number as key": (("sample: {name: test}", "sample: {name: test, 1: 2}"), "my.yaml:1: sample"),
}


@pytest.mark.parametrize(("change", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_faults_say_where_what_and_what_is_legal(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    assert change[0] in GOOD
    text = faults(tmp_path, GOOD.replace(*change))
    assert message in text
    assert "pydantic" not in text.lower()
    assert "\n" not in text  # one fault, one sentence


def test_all_faults_are_said_at_once(tmp_path: Path) -> None:
    text = faults(tmp_path, GOOD.replace("0.01", "0").replace("views: 12", "views: 0").replace("name: test", "nam: x"))
    assert text.startswith("my.yaml has 4 faults, nothing was started:\n  my.yaml:1: sample.name is missing")
    assert len(text.splitlines()) == 5


@pytest.mark.parametrize("text", ["", "# nothing\n", "- a\n- b\n", "just words", "a: !!python/object:os.system {}"])
def test_files_that_are_no_configuration(tmp_path: Path, text: str) -> None:
    assert "my.yaml" in faults(tmp_path, text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no file .*absent\.yaml"):
        load(tmp_path / "absent.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"sample: {name: \xe9}")
    with pytest.raises(ConfigError, match="UTF-8"):
        load(tmp_path / "latin.yaml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path)


def test_faults_of_overrides_name_the_override(tmp_path: Path) -> None:
    text = faults(tmp_path, GOOD, "scan.perid_s=1")
    assert text.startswith("--set scan.perid_s=1: scan.perid_s is not a known key (did you mean period_s?)")
    text = faults(tmp_path, GOOD, BEAMLINE_SCAN__ANGLES__VIEWS="many")
    assert text.startswith("BEAMLINE_SCAN__ANGLES__VIEWS: scan.angles.views is 'many'; expected a whole number > 0")
    assert "expected section.key=value" in faults(tmp_path, GOOD, "scan.period_s")
    assert "--set scan.period_s=[: the value is not YAML" in faults(tmp_path, GOOD, "scan.period_s=[")


def test_plan_of_every_scheme(tmp_path: Path) -> None:
    (tmp_path / "angles.txt").write_text("0\n45\n# no more\n", encoding="utf-8")
    path = write(tmp_path)
    for angles, first, last, n in (
        ("{scheme: fixed, views: 4, start_deg: 10, span_deg: -360}", 10, -260, 4),
        ("{scheme: sector, views: 3, first_deg: 30, last_deg: 150}", 30, 150, 3),
        ("{scheme: interlaced, views: 8, passes: 2}", 0, 157.5, 8),
        ("{scheme: golden, views: 2}", 0, 180 * (math.sqrt(5) - 1) / 2, 2),
    ):
        plan = config.plan_of(load(path, f"scan.angles={angles}"))
        assert plan.angles.size == n
        np.testing.assert_allclose(np.rad2deg(plan.angles[[0, -1]]), [first, last])
    seeded = [
        config.plan_of(load(path, f"scan.angles={{scheme: random, views: 9, seed: {s}}}")).angles for s in (1, 1, 2)
    ]
    np.testing.assert_array_equal(seeded[0], seeded[1])
    assert not np.array_equal(seeded[0], seeded[2])
    # An angle file is found beside the configuration file, wherever the command runs.
    beside = write(tmp_path, GOOD.replace("{scheme: fixed, views: 12}", "{scheme: file, path: angles.txt}"), "b.yaml")
    np.testing.assert_allclose(config.plan_of(load(beside)).angles, [0, math.pi / 4])


def test_plan_of_carries_exposures_and_places(tmp_path: Path) -> None:
    plan = config.plan_of(load(write(tmp_path), "scan.flats={count: 3, at: both, exposure_s: 0.2}", "scan.mode=step"))
    assert (plan.flats.count, plan.flats.at, plan.flats.exposure) == (3, Place.BOTH, 0.2)
    assert plan.darks.exposure == plan.exposure == 0.01
    assert (plan.mode, plan.scheme) == (Mode.STEP, "fixed")


def test_angles_that_cannot_be_had(tmp_path: Path) -> None:
    path = write(tmp_path)
    with pytest.raises(ConfigError, match=r"scan\.angles: 12 views cannot be taken in 5 equal passes"):
        config.plan_of(load(path, "scan.angles={scheme: interlaced, views: 12, passes: 5}"))
    with pytest.raises(ConfigError, match=r"absent\.txt"):
        config.plan_of(load(path, "scan.angles={scheme: file, path: absent.txt}"))
    (tmp_path / "bad.txt").write_text("0\nx\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"bad\.txt: line 2 holds 'x'"):
        config.plan_of(load(path, f"scan.angles={{scheme: file, path: '{tmp_path.as_posix()}/bad.txt'}}"))


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
    with pytest.raises(
        ConfigError, match=r"--set .*: simulation\.scene: there is no file absent\.yaml; .*scenes/a\.yaml"
    ):
        load(path, "simulation.scene=absent.yaml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[0, 0, 8, 8]", "[0, 0, 8, 9]", r"my\.yaml:\d+: devices\.camera: roi .* steps of 4"),
        (
            "simulation: {}",
            "simulation: {scene: no.yaml}",
            r"my\.yaml:\d+: simulation\.scene: there is no file no\.yaml",
        ),
        (
            "simulation: {}",
            "simulation: {}\nrecon: {axis: 8.5}",
            r"my\.yaml:\d+: recon\.axis 8\.5 .* columns 0 \.\.\. 7",
        ),
        ("simulation: {}", "simulation: &a {scene: {x: *a}}", "holds itself"),
        ("simulation: {}", "simulation: " + 3000 * "[", "nested beyond reason"),
    ],
)
def test_what_no_type_can_say_has_its_line_too(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError, match=said):
        load(write(tmp_path, GOOD.replace(old, new)))
    with pytest.raises(ConfigError, match=r"--set .*: scan\.angles\.path: there is no file .*no\.txt"):
        load(write(tmp_path), "scan.angles={scheme: file, path: no.txt}")


def test_a_folder_is_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read: Is a directory|denied"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("stage", "taken"),
    [("{kind: pi_gcs, port: 'sim://pi_gcs', trigger_line: 3", 3), ("{kind: zaber, port: 'sim://zaber', output: 3", 3)],
)
def test_a_shutter_does_not_share_the_trigger_output(tmp_path: Path, stage: str, taken: int) -> None:
    text = GOOD.replace('{kind: pm16c, port: "sim://pm16c"', stage)
    assert text != GOOD
    with_shutter = "devices.shutter={kind: stage_output, output: %d}"
    assert load(write(tmp_path, text), with_shutter % (taken + 1)).devices.shutter.kind == "stage_output"
    assert f"shutter.output {taken} is the output" in faults(tmp_path, text, with_shutter % taken)


@pytest.mark.parametrize("option", ["trigger_mode=start", "trigger_active=sync_readout", "trigger_times=2"])
def test_what_breaks_one_frame_a_pulse_is_not_for_fly_scans(option: str) -> None:
    path = config.config_folder() / "instrument.yaml"
    key = option.split("=")[0]
    with pytest.raises(ConfigError, match=rf"devices\.camera\.{key} .* one frame a pulse"):
        load(path, f"devices.camera.{option}")
    load(path, f"devices.camera.{option}", "scan.mode=step")


def test_a_level_trigger_exposes_for_the_length_of_the_pulse() -> None:
    path, level = config.config_folder() / "instrument.yaml", "devices.camera.trigger_active=level"
    with pytest.raises(ConfigError, match=r"set devices\.stage\.pulse_width_s \(None\) to scan\.exposure_s \(0\.05\)"):
        load(path, level)
    with pytest.raises(ConfigError, match=r"pulse_width_s \(0\.001\)"):
        load(path, level, "devices.stage.pulse_width_s=0.001")
    load(path, level, "devices.stage.pulse_width_s=0.05")


@pytest.mark.parametrize(("model", "kind"), [(PiGcsStageConfig, "pi_gcs"), (ZaberStageConfig, "zaber")])
@pytest.mark.parametrize("name", ["simulated", "instrument"])
def test_a_template_names_every_key_of_the_other_stages(name: str, model: type[BaseModel], kind: str) -> None:
    """With its default, so that the comment cannot drift from the model."""
    text = (config.config_folder() / f"{name}.yaml").read_text("utf-8")
    comment = text[text.index(f"# stage: {{kind: {kind}") :]
    comment = comment[: re.search(r"\n  # (?!  )|\n   ", comment).start()]  # type: ignore[union-attr]
    here = dict(re.findall(r"(\w+): ([^\s,}]+)", comment))
    below = yaml.safe_load(text)["devices"]["stage"]
    for key, field in model.model_fields.items():
        if key in ("kind", "port"):
            continue
        assert key in here or key in below, key
        if key in here:
            assert yaml.safe_load(here[key]) == field.default, key
    assert here.keys() - {"stage", "kind", "port"} <= model.model_fields.keys()


def test_what_a_controller_cannot_is_refused_at_once(tmp_path: Path) -> None:
    for stage, message in (
        ("{kind: pm16c, port: 'sim://pm16c', active_high: false", "the PM16C's trigger output has one polarity"),
        ("{kind: pi_gcs, port: 'sim://pi_gcs', pulse_width_s: 1.0e-3", "the firmware of a pi_gcs controller fixes it"),
        ("{kind: zaber, port: 'sim://zaber', pulse_width_s: 1.5e-3", "it is whole milliseconds"),
        (
            "{kind: zaber, port: 'sim://zaber', pulse_width_s: 1.0e-3, toggle: true",
            "a toggled output has no pulse width",
        ),
        ("{kind: zaber, port: 'sim://zaber', starter: 2", "two different triggers"),
    ):
        assert message in faults(tmp_path, GOOD.replace('{kind: pm16c, port: "sim://pm16c"', stage))
