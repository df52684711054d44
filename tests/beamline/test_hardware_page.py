"""docs/hardware.md names commands, keys and values; each of them must exist."""

import itertools
import re
import shlex
from pathlib import Path

import pytest
from pydantic import BaseModel

from beamline.cli.main import main
from beamline.config.beam import StageOutputShutter
from beamline.config.devices import DcamOrca
from beamline.config.load import config_folder, load
from beamline.config.stages import STAGE_SECTIONS
from beamline.scan.dry_run import dry_run

TEXT = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text(encoding="utf-8")
DEVICES: dict[str, tuple[type[BaseModel], ...]] = {
    "stage": tuple(STAGE_SECTIONS.values()),
    "camera": (DcamOrca,),
    "shutter": (StageOutputShutter,),
}


@pytest.mark.parametrize("command", sorted(set(re.findall(r"`beamline (\w+)", TEXT))))
def test_commands(command: str) -> None:
    assert main.get_command(None, command) is not None  # type: ignore[arg-type]


@pytest.mark.parametrize("command", re.findall(r"`beamline scan my\.yaml ([^`]*--set[^`]*)`", TEXT))
def test_a_scan_that_the_page_asks_for_breaks_no_limit_of_the_template(command: str) -> None:
    words = shlex.split(command)
    overrides = [value for option, value in itertools.pairwise(words) if option == "--set"]
    assert overrides
    assert dry_run(load(config_folder() / "instrument.yaml", overrides, {})).timeline.violations == ()


@pytest.mark.parametrize(("device", "key"), sorted(set(re.findall(r"devices\.(stage|camera)\.(\w+)", TEXT))))
def test_keys_with_their_path(device: str, key: str) -> None:
    assert any(key in model.model_fields for model in DEVICES[device])


def test_every_setting_from_memory_is_on_the_page() -> None:
    """What can only be found out at the instrument is a key, and the key is explained here."""
    for key in (
        "first_pulse",
        "firmware_pulse_s",
        "active_high",
        "speed_unit",
        "chained",
        "fires_when_enabled",
        "toggle",
    ):
        assert f"`{key}" in TEXT, key
        assert any(key in model.model_fields for model in DEVICES["stage"]), key
