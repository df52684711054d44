"""A value in a wrong unit is reported with a suggestion; values of real instruments are not reported."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.config import load as config
from beamline.core.quantities import RANGES, doubt, is_impossible, range_of
from beamline.scan.dry_run import doubts


def numbers_of(schema: Mapping[str, Any]) -> set[str]:
    """Dotted names of all numbers of a JSON schema."""

    def names(node: Mapping[str, Any], at: str) -> Iterator[str]:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]] if "$ref" in node else node
        inner = [*node.get("anyOf", ()), *node.get("oneOf", ()), *node.get("prefixItems", ())]
        inner += [node[key] for key in ("items", "additionalProperties") if isinstance(node.get(key), Mapping)]
        for each in inner:
            yield from names(each, at)
        for name, each in node.get("properties", {}).items():
            yield from names(each, f"{at}.{name}".lstrip("."))
        if node.get("type") in ("number", "integer"):
            yield at

    return set(names(schema, ""))


MISTAKEN = [
    ("energy_kev", 25000.0, "by a factor of 42.", "25 keV (25000 eV)"),
    ("pixel_size_um", 0.0009, "by a factor of 11.", "0.9 um (0.0009 mm)"),
    ("pixel_size_um", 0.003, "by a factor of 3.3.", "3 um (0.003 mm)"),
    ("distance_mm", 100000.0, "by a factor of 5.", "100 mm (100000 um)"),
    ("max_speed_deg_s", 4000.0, "by a factor of 1.1.", "4 degrees/s (4000 counts of 0.001 degrees/s)"),
    ("in_deg", -180000.0, "by a factor of 1.8.", "-180 degrees (-180000 counts of 0.001 degrees)"),
]


@pytest.mark.parametrize(("name", "value", "beyond", "meant"), MISTAKEN)
def test_a_mistaken_unit(name: str, value: float, beyond: str, meant: str) -> None:
    said = doubt(name, value)
    assert beyond in said and f"Did you mean {meant}" in said
    assert is_impossible(name, value) is (name in ("energy_kev", "pixel_size_um") and value != 0.003)


TYPICAL = {  # by the names of the ranges
    "pixel_size_um": 10.0, "kev": 25.0, "energy": 25.0, "energies": 25.0, "tolerance_ev": 0.5, "distance_mm": 100.0,
    "mm": 5.0, "um": 200.0, "nm": 550.0, "mm_per_deg": 1.0, "exposure_s": 1.0, "period_s": 1.0, "settle_s": 1.0,
    "timeout_s": 2.0, "warm_up_s": 60.0, "cool_s": 300.0, "trigger_delay_s": 1e-3, "pulse_width_s": 0.05,
    "firmware_pulse_s": 5e-5, "shortest_s": 1e-3, "s": 10.0, "seconds": 1800.0, "deg": 180.0, "deg_s": 10.0,
    "deg_s2": 60.0, "counts_per_turn": 360_000, "counts": 10, "views": 360, "count": 10, "mb": 1000, "baudrate": 9600,
}  # fmt: skip
NUMBERS = sorted(numbers_of(config.schema()))
WITHOUT_UNIT = re.compile(
    r"(index|roi|channel|device|axis|output|starter|repeater|trigger_line|trigger_times|usb_product|binning|.*_value"
    r"|status_open|speed_unit|pause_below|resume_above|scale|exposure_tolerance|places|axis_col|seed|state|passes|speed"
    r"|preview_bin|flush_every|frames_per_view|quality_db|dose|absorbed|aperture|light|transmission)$"
)  # counts of things, names, shares, dB, and what has the unit of another key


def test_there_are_ranges_for_all_that_has_a_unit() -> None:
    own = [name for name in NUMBERS if not name.startswith(("monitor.", "references.", "simulation."))]
    assert len(own) > 100
    without = [name for name in own if range_of(name) is None and not WITHOUT_UNIT.search(name)]
    assert without == [] and TYPICAL.keys() == RANGES.keys()


@pytest.mark.parametrize("name", [name for name in NUMBERS if range_of(name) is not None])
def test_a_thousand_times_the_typical_value_is_told(name: str) -> None:
    typical = TYPICAL[next(key for key, known in RANGES.items() if known is range_of(name))]
    assert doubt(name, typical) == "" != doubt(name, 1000 * typical)
    low, high = range_of(name).low, range_of(name).high  # type: ignore[union-attr]
    assert doubt(name, low) == doubt(name, high) == doubt(name, -high) == doubt(name, 0) == ""
    assert str(range_of(name).unit) in doubt(name, 2 * high)  # type: ignore[union-attr]


@pytest.mark.parametrize("name", sorted(path.name for path in config.config_folder().glob("*.yaml")))
def test_no_shipped_configuration_is_doubted(name: str) -> None:
    assert doubts(config.load(config.config_folder() / name, environment={})) == []


@pytest.mark.parametrize(
    ("settings", "said", "code"),
    [
        (
            ["optics.energy_kev=25000"],
            "energy_kev=25000: optics.* Did you mean 25 keV .*eV\\)\\? Nothing",
            2,
        ),
        (["optics.pixel_size_um=0.003"], "Warning: optics.pixel_size_um = 0.003 um .*Did you mean 3 um", 0),
        (["devices.stage.max_speed_deg_s=4000"], "Warning: devices.stage.max_speed_deg_s = 4000 degrees/s is", 0),
        (["scan.angles.span_deg=3.14159"], "Warning: .*Did you mean 180", 0),
        (
            ["scan.angles.span_deg=3.14159", "scan.angles.views=3600"],
            "0.873 counts .* cover 1.15 times the planned range",
            2,
        ),
        (["scan.angles={scheme: sector, views: 90, first_deg: -1.5708, last_deg: 1.5708}"], "Did you mean 180", 0),
        (["scan.angles={scheme: file, path: ANGLES}"], "Did you mean 180", 0),
        (["scan.energies=[8000, 9]", "devices.monochromator.kind=simulated"], "Did you mean 8 keV", 2),
    ],
)
def test_check_tells_a_slip(tmp_path: Path, settings: list[str], said: str, code: int) -> None:
    np.savetxt(tmp_path / "angles.txt", np.linspace(0, np.pi, 181)[:-1])
    words = [word.replace("ANGLES", str(tmp_path / "angles.txt")) for each in settings for word in ("--set", each)]
    done = CliRunner().invoke(main, ["check", str(config.config_folder() / "demo.yaml"), *words])
    assert re.search(said, done.stderr), done.stderr
    assert done.exit_code == code
