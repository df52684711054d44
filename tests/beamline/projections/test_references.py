"""If flats or darks at the end are bad, the good ones are used; a scan without good ones ends with an error."""

from __future__ import annotations

import re

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.files.validate import source_findings
from beamline.projections.corrections.air import Air
from beamline.projections.preparation import Preparation
from beamline.projections.selection import Selection
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.light import references_usable
from drivers.base.frame import FrameKind
from tests.beamline.array_source import ArraySource
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import BEAM, DARK, TwoCylinders
from tests.slow_cases import others_slow

SCAN = TwoCylinders()
SELECTION = Selection(axis_col=SCAN.axis_col, steps=(Air("none"),))
ACCEPT = SELECTION.with_steps(Preparation(references="accept"))
FULL = 65535.0


def source(
    start: tuple[float, float] = (DARK, DARK + BEAM),
    end: tuple[float, float] = (DARK, DARK + BEAM),
    exposure: float = np.nan,
) -> ArraySource:
    """Three darks and three flats of these levels before the views and after them, with photon noise."""
    rng = np.random.default_rng(7)

    def references(levels: tuple[float, float]) -> list[np.ndarray]:
        return [rng.normal(level, 0.01 * level, (3, *SCAN.shape)).clip(0, FULL) for level in levels]

    views = DARK + BEAM * np.exp(-SCAN.line_integrals())
    blocks = [*references(start), views, *references(end)]
    keys = [kind for kind, block in zip((2, 1, 0, 2, 1), blocks, strict=True) for _ in block]
    angles = np.full(len(keys), np.nan)
    angles[np.array(keys) == FrameKind.PROJECTION] = SCAN.angles
    return ArraySource(np.concatenate(blocks).round().astype(np.uint16), keys, angles, np.full(len(keys), exposure))


@pytest.mark.parametrize(
    ("end", "said"),
    others_slow(
        [
            ((DARK, DARK + 2), "Flats in frames 54-56: these flats show no beam"),
            (
                (DARK, DARK + 0.02 * BEAM),
                "Flats in frames 54-56: the beam was lost: these flats have 98% less intensity than the flats",
            ),
            ((DARK, FULL + 3000), "Flats in frames 54-56: 100.00% of the pixels are saturated"),
            ((DARK + 0.9 * BEAM, DARK + BEAM), "Darks in frames 51-53: these darks were exposed to the beam"),
        ]
    ),
)
def test_a_bad_group_at_the_end_is_left_out(end: tuple[float, float], said: str) -> None:
    prepared, (line,) = prepare(source(end=end), SELECTION)
    # A mean of three flats with noise of 1 % is right to 0.6 %; a bad group would be off by far more.
    np.testing.assert_allclose(prepared.seen.data, SCAN.line_integrals(), atol=0.03)
    assert line.startswith(said) and line.endswith(f"The other {said.split()[0].lower()} are used instead.")
    spoilt, told = prepare(source(end=end), ACCEPT)
    assert np.abs(spoilt.seen.data - SCAN.line_integrals()).max() > 0.1
    assert told[0].startswith("--references accept: ")


@pytest.mark.parametrize(
    ("levels", "said"),
    others_slow(
        [
            ((DARK, FULL + 2000), "Flats in frames 3-5, 54-56: .* of the pixels are saturated"),
            ((DARK, DARK + 2), "Flats in frames 3-5: these flats show no beam"),
            ((DARK + 0.9 * BEAM, DARK + BEAM), "Darks in frames 0-2: these darks were exposed to the beam"),
        ]
    ),
)
def test_a_scan_without_a_good_group_is_refused_and_an_option_overrides(levels: tuple[float, float], said: str) -> None:
    scan = source(levels, levels)
    with pytest.raises(DataError, match=f"reconstructed. {said}.*--references accept"):
        prepare(scan, SELECTION)
    errors = [f for f in source_findings(ScanEvidence(scan)) if f.severity == "error"]
    n = 1 if "54" in said else 2  # the figures of two groups differ but where all of the pixels are at their end
    rules = [finding.rule for finding in errors if finding.rule != "light"]  # which tells of darks above the views, too
    assert rules == ["bad-references"] * n
    found, told = prepare(scan, ACCEPT)
    assert found.geometry.n_views == SCAN.angles.size
    assert len([line for line in told if line.startswith("--references accept")]) == n


def test_flats_darker_than_the_views_are_refused_where_the_exposures_are_known() -> None:
    """Flats with 2 % of the light, and nothing wrong with them beside one another: alone, or beside the views."""
    dim = (DARK, DARK + 0.02 * BEAM)
    with pytest.raises(DataError, match=r"Flats in frames 3-5, 54-56:.*.limit 50%"):
        prepare(source(dim, dim, 0.05), SELECTION)
    found, warnings = prepare(source(dim, dim), SELECTION)
    assert found.geometry.n_views == 45
    assert any(
        re.search(r"times as bright as the flats.*Check whether flats and projections had the same exposure time", each)
        for each in warnings
    )
    fine = source(exposure=0.05)
    found, warnings = prepare(fine, SELECTION)
    assert (found.geometry.n_views, warnings) == (45, [])
    fine.table.exposures[np.array(fine.table.kinds) == FrameKind.FLAT] /= 10  # ten times the light a second: no fault
    assert list(references_usable(ScanEvidence(fine))) == []
