"""The shipped templates contain every key, and every alternative in a comment is legal."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from beamline.config import load as config
from beamline.config.devices import DcamOrca, SimulatedOrca
from beamline.config.models import Config
from beamline.config.stages import STAGE_SECTIONS, STAGES
from beamline.monitor.checks import CHECKS


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
    joined = re.sub(r",\n  #  +", ", ", text)
    kind = r"^  # (stage|shutter|sample_mover|filter|monochromator|beam_monitor): (\{.*?\})(?=\s|$)"
    offered = re.findall(kind, joined, re.MULTILINE)
    kinds = set()
    for key, flow in offered:
        tree = yaml.safe_load(text)
        mine = yaml.safe_load(flow)
        of_the_pm16c = {"channel", "first_pulse", "home_deg", "home_speed_deg_s"}
        kept = STAGE_SECTIONS[mine["kind"]].model_fields.keys() - of_the_pm16c if key == "stage" else ()
        tree["devices"][key] = {k: v for k, v in tree["devices"][key].items() if k in kept} | mine
        if mine["kind"] == "stage_output":  # which the PM16C has not
            stage = yaml.safe_load(next(flow for _, flow in offered if "pi_gcs" in flow))
            kept = STAGE_SECTIONS["pi_gcs"].model_fields.keys() - of_the_pm16c
            tree["devices"]["stage"] = {k: v for k, v in tree["devices"]["stage"].items() if k in kept} | stage
        loaded = Config.model_validate(tree)
        assert getattr(loaded.devices, key).kind == mine["kind"]
        kinds.add(mine["kind"])
    assert kinds == {"pi_gcs", "epics", "stage_output", "electrometer", "stage"} | (
        {"zaber", "ring_current", "manual"} if name == "instrument" else {"simulated"}
    )


def test_the_devices_of_the_page_on_epics_are_ones() -> None:
    page = (Path(__file__).parents[3] / "docs" / "page.md").read_text("utf-8")
    (block,) = re.findall(r"(?s)```yaml\n(.*?)```", page)
    tree = yaml.safe_load((config.config_folder() / "instrument.yaml").read_text("utf-8"))
    tree["devices"] |= yaml.safe_load(block)["devices"]
    loaded = Config.model_validate(tree).devices
    assert {loaded.stage.kind, loaded.shutter.kind, loaded.filter.kind, getattr(loaded.beam_monitor, "kind", None)} == {
        "epics"
    }
    assert (loaded.sample_mover.kind, loaded.monochromator.kind) == ("stage", "epics")


def _keys(value: Any, path: tuple[str, ...] = ()) -> set[tuple[str, ...]]:
    if not isinstance(value, dict):
        return set()
    return {(*path, key) for key in value} | {k for key, child in value.items() for k in _keys(child, (*path, key))}


@pytest.mark.parametrize(
    ("name", "kind", "model"),
    [
        (name, kind, model)
        for name in ("simulated", "instrument")
        for kind, model in STAGE_SECTIONS.items()
        if kind != "pm16c" and (name == "instrument" or not STAGES[kind].Settings.stand_in)
    ],
)
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


@pytest.mark.parametrize("name", ["simulated", "instrument"])
def test_every_check_stands_in_the_template_with_its_policy_and_limits(name: str) -> None:
    monitor = yaml.safe_load((config.config_folder() / f"{name}.yaml").read_text("utf-8"))["monitor"]
    assert monitor["policy"] == {check.name: str(check.policy) for check in CHECKS}
    assert {check.name: monitor.get(check.name, {}) for check in CHECKS} == {
        check.name: asdict(check) for check in CHECKS
    }
