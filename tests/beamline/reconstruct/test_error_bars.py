"""`recon --uncertainty`: a second volume in the file, also in slabs and for a box; left out if the run is stopped."""

from __future__ import annotations

import contextlib
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.storage.writers.recon_file import read_reconstruction
from recon.voxels import iterative
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange

FBP = ("recon", "scan.h5", "--uncertainty", "--no-report", "-m", "fbp")
FISTA = (*FBP[:-1], "fista-tv", "--iterations", "5", "--tv-weight", "0.002")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A noisy scan of 64 rows, scan.h5, and its volumes with error bars, fista-tv.h5 and fbp.h5."""
    folder = tmp_path_factory.mktemp("made")
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 4.0)), shape=(64, 32), axis_col=15.7)
    counts = 100 + np.random.default_rng(20261120).poisson((scan.counts().astype(float) - 100) / 10) * 10
    write_exchange(folder / "scan.h5", scan, {"data": counts.astype(np.uint16)})
    with contextlib.chdir(folder):
        for options, name in ((FISTA, "fista-tv.h5"), (FBP, "fbp.h5")):
            result = beamline(*options, "-o", name)
            assert result.exit_code == 0, result.output
    return folder


def deviation(*options: str) -> np.ndarray:
    """Of the volume that these options give."""
    output = Path("out.h5")
    result = beamline(*options, "-o", str(output))
    assert result.exit_code == 0, result.output
    found = read_reconstruction(output).deviation
    output.unlink()
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("options", "name"), [(FBP, "fbp.h5"), (FISTA, "fista-tv.h5")], ids=["fbp", "fista-tv"])
def test_the_file_holds_a_second_volume_with_its_unit(
    made: Path, folder: Path, options: tuple[str, ...], name: str
) -> None:
    alone = tuple(option for option in options if option != "--uncertainty")
    assert beamline(*alone, "-o", "without.h5").exit_code == 0
    with h5py.File(made / name) as file, h5py.File("without.h5") as other:
        data, errors = file["entry/data/data"], file["entry/data/data_errors"]
        assert errors.shape == data.shape and errors.attrs["units"] == data.attrs["units"] == "1/mm"
        assert np.isfinite(errors).all() and np.median(errors) > 0
        np.testing.assert_array_equal(data, other["entry/data/data"])
        assert "data_errors" not in other["entry/data"]
    assert float(read_reconstruction(made / name).parameters["error_bars_spread"]) > 0
    assert beamline("validate", str(made / name)).exit_code == 0


@pytest.mark.slow
def test_about_two_of_three_voxels_of_the_truth_are_within(made: Path) -> None:
    record = read_reconstruction(made / "fista-tv.h5")
    truth = TwoCylinders(shape=(64, 32), axis_col=15.7).truth(record.volume.grid)
    matter = truth > 0
    assert record.deviation is not None
    within = np.abs(record.volume.data - truth)[matter] <= record.deviation[matter]
    assert 0.5 < within.mean() < 0.9


@pytest.mark.slow
def test_in_slabs_it_is_the_same(made: Path, folder: Path) -> None:
    whole, slabs = read_reconstruction(made / "fbp.h5").deviation, deviation(*FBP, "--memory", "4.1M")
    assert whole is not None
    assert np.abs(slabs - whole).mean() < 0.1 * whole.mean()
    assert left(folder) == {"scan.h5"}


@pytest.mark.slow
def test_of_a_box_it_is_the_box(made: Path, folder: Path) -> None:
    whole, box = read_reconstruction(made / "fista-tv.h5").deviation, deviation(*FISTA, "--roi", "20:30,4:20,6:22")
    assert whole is not None
    assert box.shape == (10, 16, 16)
    assert np.abs(box - whole[20:30, 4:20, 6:22]).mean() < 0.05 * whole.mean()


@pytest.mark.slow
def test_ctrl_c_keeps_the_volume_and_leaves_it_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solve: Any = iterative.solve_views

    def interrupted(*arguments: Any, **named: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return solve(*arguments, **named)

    monkeypatch.setattr("recon.error_bars.solve_views", interrupted)
    result = beamline(*FISTA, "-o", "out.h5")
    assert result.exit_code == 0, result.output
    assert "No error bars were computed: their computation was stopped." in result.stderr
    record = read_reconstruction(Path("out.h5"))
    assert record.deviation is None and record.volume.data.any() and "ended_early" not in record.parameters
