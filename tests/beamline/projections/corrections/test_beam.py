"""The option for the beam spectrum: a tube with filters, or a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beamline.projections.corrections.beam_hardening.hardening import in_beam
from recon.prep.matter import mass_attenuation


def test_a_tube_and_a_table_are_read(tmp_path: Path) -> None:
    harder, softer = (
        np.average(seen, weights=light) for seen, light in map(in_beam, ("Al", "Al"), ("60kV,Cu=1", "60kV"))
    )
    assert harder < softer
    table = tmp_path / "beam.txt"
    table.write_text("20 3\n25 0\n30 1\n")
    attenuation, weights = in_beam("Al", str(table))
    np.testing.assert_array_equal(attenuation, mass_attenuation("Al", [20.0, 30.0]))
    np.testing.assert_array_equal(weights, [3.0, 1.0])


@pytest.mark.parametrize("wrong", ["20 -3", "20", "20 0", "no numbers"])
def test_a_wrong_table_is_refused(tmp_path: Path, wrong: str) -> None:
    table = tmp_path / "beam.txt"
    table.write_text(wrong)
    with pytest.raises(ValueError, match=r"must have two columns|neither a tube such as"):
        in_beam("Al", str(table))
