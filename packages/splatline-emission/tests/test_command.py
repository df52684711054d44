"""`beamline emission`: simulated counts follow their distribution, their file, the reconstructed activity."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.volumes.files import opened_volume
from recon import Geometry, Grid
from recon.voxels.projector import Projector
from splatline_emission import read_counts
from splatline_emission.counts import RODS, WATER, Scanner, activity, chords, counts_of
from tests.beamline.cli.small_scan import beamline, succeeds

VIEWS = Geometry.parallel(np.linspace(0, np.pi, 12, endpoint=False), (4, 64))


def test_chords_are_line_integrals_of_the_truth() -> None:
    """Of voxels, whose interpolation errs by some 2 % of a rod."""
    grid = Grid.matching(VIEWS)
    expected = Projector(VIEWS, grid).plain.forward(activity(grid))
    lines = chords(VIEWS, "activity")
    assert np.abs(lines - expected).max() < 0.05 * lines.max()
    assert np.abs(lines - expected).mean() < 0.004 * lines.max()
    assert chords(VIEWS, "mu").max() == pytest.approx(2 * RODS[0].radius * WATER, rel=0.3)


@pytest.mark.parametrize("scanner", [Scanner(2e5), Scanner(2e5, scatter=0, randoms=0, spread=0)])
def test_counts_have_the_mean_that_is_stated(scanner: Scanner) -> None:
    counts, sets, scale = counts_of(VIEWS, scanner, seed=1)
    survival = sets["normalisation"] * np.exp(-sets["attenuation"])
    mean = survival * scale * chords(VIEWS, "activity") + sets["randoms"] + sets["scatter"]
    assert (counts - mean).sum() / np.sqrt(mean.sum()) == pytest.approx(0, abs=4)
    some = mean > 5
    assert np.mean((counts - mean)[some] ** 2 / mean[some]) == pytest.approx(1, abs=0.1)
    assert (survival * scale * chords(VIEWS, "activity")).sum() == pytest.approx(scanner.trues, rel=1e-4)


@pytest.mark.parametrize("method", ["osem", "mlem", "fista-tv"])
def test_activity_comes_back_from_its_counts(tmp_path: Path, method: str) -> None:
    words = (
        "-o",
        str(tmp_path / "pet.h5"),
        "--truth",
        str(tmp_path / "truth.h5"),
        "--shape",
        "2",
        "64",
        "--trues",
        "2e6",
    )
    succeeds("emission", "simulate", *words, "--views", "60")
    succeeds("emission", "recon", str(tmp_path / "pet.h5"), "-o", str(tmp_path / "out.h5"), "-m", method)
    with opened_volume(tmp_path / "out.h5") as made, opened_volume(tmp_path / "truth.h5") as truth:
        assert made.unit == truth.unit == "counts/mm" and made.volume.grid == truth.volume.grid
        found, known = np.asarray(made.volume.data), np.asarray(truth.volume.data)
    assert np.sqrt(np.mean((found - known) ** 2)) < 0.25 * np.sqrt(np.mean(known**2))


def test_what_is_no_emission_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pet.h5"
    with h5py.File(path, "w") as file:
        file["emission/counts"] = np.zeros((3, 2, 8))
    with pytest.raises(DataError, match="no dataset /emission/angles"):
        read_counts(path)
    with h5py.File(path, "r+") as file:
        file["emission/angles"], file["emission/pixel_size"] = np.arange(3.0), 1.0
    with pytest.raises(DataError, match="all counts are zero"):
        read_counts(path)
    ended = beamline("emission", "recon", path, "-o", tmp_path / "out.h5")
    assert ended.exit_code == 5 and not (tmp_path / "out.h5").exists()
    ended = beamline("emission", "recon", tmp_path / "none.h5", "-o", tmp_path / "out.h5")
    assert ended.exit_code == 5 and "none.h5" in ended.stderr
