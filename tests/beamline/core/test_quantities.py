"""A value of a mistaken unit is told of with what may be meant, by check and recon; those of instruments are not."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.config import load as config
from beamline.core.quantities import doubt, doubt_span
from beamline.projections import prepare
from beamline.projections.selection import Selection
from tests.beamline.array_source import ArraySource

MISTAKEN = [
    ("energy_kev", 25000.0, "2 orders of magnitude", "25 keV (25000 eV)"),
    ("pixel_size_um", 0.0046, "2 orders of magnitude", "4.6 um (0.0046 mm)"),
    ("pixel_size_um", 0.03, "1 order of magnitude", "30 um (0.03 mm)"),
    ("distance_mm", 100000.0, "1 order of magnitude", "100 mm (100000 um)"),
]


@pytest.mark.parametrize(("name", "value", "orders", "meant"), MISTAKEN)
def test_a_mistaken_unit(name: str, value: float, orders: str, meant: str) -> None:
    said = doubt(name, value)
    assert orders in said and f"did you mean {meant}" in said


@pytest.mark.parametrize(
    ("name", "value"), [("energy_kev", 0.28), ("energy_kev", 450.0), ("pixel_size_um", 0.1), ("pixel_size_um", 200.0),
                        ("distance_mm", 0.0), ("distance_mm", 12000.0), ("exposure_s", 1e-5), ("energy_kev", None)]
)  # fmt: skip
def test_values_of_instruments(name: str, value: float | None) -> None:
    assert doubt(name, value) == ""


def test_a_span_in_radians() -> None:
    assert "did you mean 180?" in doubt_span(3.14159)
    assert "did you mean -360?" in doubt_span(-6.2832)
    assert doubt_span(180.0) == doubt_span(3.0) == doubt_span(None) == ""


@pytest.mark.parametrize(
    ("key", "value", "meant"),
    [("optics.pixel_size_um", "0.0046", "4.6 um"), ("scan.angles.span_deg", "3.14159", "180?")],
)
def test_check_warns(key: str, value: str, meant: str) -> None:
    said = CliRunner().invoke(main, ["check", str(config.config_folder() / "demo.yaml"), "--set", f"{key}={value}"])
    assert "Warning: " in said.stderr and f"did you mean {meant}" in said.stderr


def test_a_reconstruction_warns() -> None:
    scan = ArraySource(np.ones((12, 8, 8), np.float32), [0] * 12, np.linspace(0, np.pi, 12, endpoint=False))
    scan.quantity = "line_integrals"

    told: list[str] = []
    prepare._warn_of_units(scan, replace(Selection(), pixel_size_mm=3e-5), told.append)  # type: ignore[arg-type]
    (sentence,) = told
    assert "30 um (0.03 mm)" in sentence
