"""Errors that concern several values name their line: files, regions, outputs, triggers, controllers."""

from pathlib import Path

import pytest

from beamline.config import load as config
from beamline.core.errors import ConfigError
from tests.beamline.config_file import GOOD, faults, load, write
from tests.messages import refused

pytestmark = pytest.mark.usefixtures("simulated_zaber")


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
        ("simulation: {}", "simulation: &a {scene: {x: *a}}", "contains itself"),
        ("simulation: {}", "simulation: " + 1000 * "[", "64 groups inside each other"),
    ],
)
def test_what_no_type_can_say_has_its_line_too(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in GOOD
    with pytest.raises(ConfigError, match=said):
        load(write(tmp_path, GOOD.replace(old, new)))
    with pytest.raises(ConfigError, match=r"--set .*scan\.angles\.path:.*no\.txt"):
        load(write(tmp_path), "scan.angles={scheme: file, path: no.txt}")


@pytest.mark.parametrize(
    ("stage", "taken"),
    [("{kind: pi_gcs, port: 'sim://pi_gcs', trigger_line: 3", 3), ("{kind: zaber, port: 'sim://zaber', output: 3", 3)],
)
def test_a_shutter_does_not_share_the_trigger_output(tmp_path: Path, stage: str, taken: int) -> None:
    text = GOOD.replace('{kind: pm16c, port: "sim://pm16c"', stage)
    assert text != GOOD
    with_shutter = "devices.shutter={kind: stage_output, output: %d}"
    assert load(write(tmp_path, text), with_shutter % (taken + 1)).devices.shutter.kind == "stage_output"
    assert f"shutter.output {taken} carries the trigger pulses" in faults(tmp_path, text, with_shutter % taken)


@pytest.mark.parametrize("option", ["trigger_mode=start", "trigger_active=sync_readout", "trigger_times=2"])
def test_what_breaks_one_frame_a_pulse_is_not_for_fly_scans(option: str) -> None:
    path = config.config_folder() / "instrument.yaml"
    key = option.split("=")[0]
    with pytest.raises(ConfigError, match=rf"devices\.camera\.{key} .* one frame per pulse"):
        load(path, f"devices.camera.{option}")
    load(path, f"devices.camera.{option}", "scan.mode=step")


def test_a_level_trigger_exposes_for_the_length_of_the_pulse() -> None:
    path, level = config.config_folder() / "instrument.yaml", "devices.camera.trigger_active=level"
    with refused(ConfigError):
        load(path, level)
    with refused(ConfigError):
        load(path, level, "devices.stage.pulse_width_s=0.001")
    zaber = "{kind: zaber, port: COM3, counts_per_turn: 384000, max_speed_deg_s: 30, acceleration_deg_s2: 60}"
    load(path, level, f"devices.stage={zaber}", "devices.stage.pulse_width_s=0.05")


def test_what_a_controller_cannot_is_refused_at_once(tmp_path: Path) -> None:
    for stage, message in (
        ("{kind: pm16c, port: 'sim://pm16c', active_high: false", "the PM16C's trigger output has one polarity"),
        (
            "{kind: pi_gcs, port: 'sim://pi_gcs', pulse_width_s: 1.0e-3",
            "the firmware of a pi_gcs controller fixes the pulse width",
        ),
        ("{kind: zaber, port: 'sim://zaber', pulse_width_s: 1.5e-3", "a whole number of milliseconds"),
        (
            "{kind: zaber, port: 'sim://zaber', pulse_width_s: 1.0e-3, toggle: true",
            "a toggled output has no pulse width",
        ),
        ("{kind: zaber, port: 'sim://zaber', starter: 2", "two different triggers"),
    ):
        assert message in faults(tmp_path, GOOD.replace('{kind: pm16c, port: "sim://pm16c"', stage))
