"""What a trade-off compares: views keep their times or energies through the split into used and held out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.energies.scans import EnergyScans, read_spectra
from beamline.features.trials.launch import TrialData
from beamline.features.trials.runner import ComparedScan
from beamline.features.trials.table import TrialTable
from beamline.features.trials.tradeoff import SeveralVolumes, TradeoffOptions, planned_tradeoff
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from simulators.samples.materials.palette import known
from tests.beamline.features.materials.test_command import ENERGIES, scans, spectra  # noqa: F401 - scans is a fixture
from tests.beamline.scans import TwoCylinders, write_exchange

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(4, 40))


def asked(path: Path, axis_col: float) -> ComparedScan:
    return ComparedScan(SourceOptions(path), Selection(axis_col=axis_col), path.parent / "out")


def planned(scan: ComparedScan, several: SeveralVolumes, warn: Callable[[str], None]) -> tuple[TrialData, TrialTable]:
    data, planned = planned_tradeoff(TradeoffOptions(scan, ("fbp",), several), warn)
    return data, planned.table


def test_views_in_time_keep_their_times(tmp_path: Path) -> None:
    """The file states no times: views follow each other evenly, which a warning says."""
    path, said = write_exchange(tmp_path / "scan.h5", SCAN), list[str]()
    data, table = planned(asked(path, SCAN.axis_col), SeveralVolumes(volumes=2), said.append)
    assert data.prepared.held_out is not None and data.truth is None and data.shown_held_out is not None
    angles = np.concatenate((data.geometry.angles, data.prepared.held_out[1].angles))
    shown = np.concatenate((data.shown, data.shown_held_out))
    np.testing.assert_allclose(np.degrees(angles) / 6, shown)  # a view each 6 degrees and second
    assert data.geometry.n_views == 27 and shown.size == 30
    assert any("states no time" in warning for warning in said)
    assert "over 29 s" in table.scan["views used"]
    assert [outcome.trial.group for outcome in table.outcomes] == ["method", "parts", "parts", *["one fit"] * 3]


def at_energies(files: list[Path], table: Path) -> EnergyScans:
    return EnergyScans(tuple(map(SourceOptions, files)), read_spectra(table))


def test_views_of_energies_keep_their_energies(scans: list[Path], tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("xraylib")
    several = SeveralVolumes(scans=at_energies(scans, spectra(tmp_path)), states=("fresh", "charged"))
    data, table = planned(asked(scans[0], 31.5), several, lambda said: None)
    prepared, unseen = data.prepared, data.shown_held_out
    assert prepared.held_out is not None and prepared.energies is not None and unseen is not None
    assert data.geometry.n_views == 84 and prepared.held_out[1].n_views == 12
    assert np.bincount(np.concatenate((data.shown, unseen)).astype(int)).tolist() == [24] * 4
    oxide = known("NMC811")
    assert oxide is not None and prepared.energies.cross_sections.shape == (len(ENERGIES), 2)
    assert table.scan["materials"] == "fresh, charged"
    brightest = [max(float(image.max()) for image in prepared.projections.data[data.shown == e]) for e in range(4)]
    assert np.argmin(brightest) == 0  # below the edge
    assert [outcome.trial.method for outcome in table.outcomes] == ["fbp", "materials", "materials"]
    assert isinstance(prepared.held_out[1], Geometry)


def test_a_folder_that_exists_is_refused_before_scans_are_read(tmp_path: Path) -> None:
    pytest.importorskip("xraylib")
    (tmp_path / "out").mkdir()
    several = SeveralVolumes(scans=at_energies([tmp_path / "none.h5"], spectra(tmp_path)))
    with pytest.raises(Exception, match="never overwritten"):
        planned(asked(tmp_path / "none.h5", 1.0), several, print)


def test_states_that_are_no_materials_are_refused(scans: list[Path], tmp_path: Path) -> None:  # noqa: F811
    several = SeveralVolumes(scans=at_energies(scans, spectra(tmp_path)), states=("fresh", "full"))
    with pytest.raises(ConfigError, match="materials fresh, charged"):
        planned(asked(scans[0], 31.5), several, print)
