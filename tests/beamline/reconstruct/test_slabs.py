"""Slabs within a memory: the same volume, within the memory, with nothing left beside it."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from beamline.reconstruct import estimate
from beamline.reconstruct.memory import ReconMemory
from beamline.storage.writers.recon_file import read_reconstruction
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import Fbp
from recon.voxels.methods import OsSirtTv
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange, write_flagged


@pytest.fixture
def tall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> TwoCylinders:
    """A scan of 200 rows with noise, zingers, an area without light, and a beam that becomes weaker: scan.h5."""
    monkeypatch.chdir(tmp_path)
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 3.0)), shape=(200, 48), axis_col=23.7)
    fading = np.linspace(1, 0.8, scan.angles.size)[:, None, None]
    counts = 100 + rng.poisson((scan.counts().astype(float) - 100) * fading)
    counts[rng.integers(0, 60, 30), rng.integers(0, 200, 30), rng.integers(0, 48, 30)] += 20000
    flat = np.full((2, *scan.shape), 20100, np.uint16)
    flat[:, 90:95, 30:34] = 100
    write_exchange(Path("scan.h5"), scan, {"data": counts.astype(np.uint16), "data_white": flat})
    return scan


def volume(*options: str) -> np.ndarray:
    result = beamline("recon", "scan.h5", "-m", "fbp", "--no-report", *options)
    assert result.exit_code == 0, result.output
    return read_reconstruction(Path(options[-1])).volume.data


@pytest.mark.usefixtures("tall")
@pytest.mark.parametrize(
    ("memory", "more"),
    [
        ("3M", []),
        ("2M", ["--bin", "2"]),
        pytest.param("3M", ["--rows", "33:181"], marks=pytest.mark.slow),
        pytest.param("3M", ["--air", "none"], marks=pytest.mark.slow),
    ],
)
def test_the_volume_is_the_same_to_the_bit_in_as_many_slabs_as_its_dry_run_says(
    tmp_path: Path, memory: str, more: list[str]
) -> None:
    given = ("recon", "scan.h5", "-m", "fbp", "--no-report", *more, "--memory", memory, "-o", "parts.h5")
    planned = json.loads(beamline(*given, "--dry-run", "--json").stdout.splitlines()[-1])
    result = beamline(*given)
    assert result.exit_code == 0, result.output
    assert "scratch files" in result.stderr and "slices" in result.stderr
    parts = read_reconstruction(Path("parts.h5"))
    assert planned["slabs"] == parts.parameters["slabs"] > 1
    np.testing.assert_array_equal(parts.volume.data, volume(*more, "--memory", "1G", "-o", "whole.h5"))
    whole = read_reconstruction(Path("whole.h5"))
    assert "slabs" not in whole.parameters and parts.metrics.keys() == whole.metrics.keys()
    assert parts.metrics["residual"] == pytest.approx(whole.metrics["residual"], rel=1e-6)
    assert parts.parameters["replaced_fraction"] == pytest.approx(whole.parameters["replaced_fraction"])
    assert left(tmp_path) == {"scan.h5", "whole.h5", "parts.h5"}


@pytest.mark.slow
def test_flags_and_line_integrals_as_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scan = TwoCylinders(shape=(150, 40))
    write_flagged(Path("scan.h5"), frames_of(scan), {7: "warning", 9: "alarm"})
    np.testing.assert_array_equal(volume("--memory", "3M", "-o", "a.h5"), volume("--memory", "1G", "-o", "b.h5"))
    a, b = (read_reconstruction(Path(name)).parameters for name in ("a.h5", "b.h5"))
    np.testing.assert_array_equal(a["view_weights"], b["view_weights"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "memory", "views", "shape"),
    [
        (("fbp",), 40, 60, (400, 256)),
        (("os-sirt-tv", "--iterations", "2"), 44, 30, (320, 96)),
        (("cgls", "--iterations", "2"), 56, 30, (200, 256)),
    ],
)
def test_no_more_memory_is_taken_than_was_given(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: tuple[str, ...],
    memory: int,
    views: int,
    shape: tuple[int, int],
) -> None:
    """All that numpy allocates, with the figures of merit; all at once takes three times as much."""
    monkeypatch.chdir(tmp_path)
    write_exchange(Path("scan.h5"), TwoCylinders(np.pi * np.arange(views) / views, shape, axis_col=shape[1] / 2))
    options = ("recon", "scan.h5", "--no-report", "-m", *method)
    assert beamline(*options, "--rows", "0:16", "-o", "first.h5").exit_code == 0  # loads and compiles
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        result = beamline(*options, "--memory", f"{memory}M", "-o", "out.h5")
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert result.exit_code == 0 and "scratch files" in result.stderr, result.output
    assert peak < 1e6 * memory


@pytest.mark.slow
@pytest.mark.usefixtures("tall")
@pytest.mark.parametrize(
    ("method", "more", "memory", "near"),
    [
        ("sirt", ["--iterations", "4"], "20M", 1e-6),
        ("fista-tv", ["--iterations", "5", "--tv-weight", "0.002"], "24M", 2e-3),
    ],
)
def test_slabs_of_iterative_methods(tmp_path: Path, method: str, more: list[str], memory: str, near: float) -> None:
    """Rows of SIRT are independent. The weight of total variation is that of the slab with most matter."""
    for name, given in (("whole.h5", "1G"), ("parts.h5", memory)):
        result = beamline("recon", "scan.h5", "-m", method, *more, "--no-report", "--memory", given, "-o", name)
        assert result.exit_code == 0, result.output
    assert "Slab 2 of" in result.stderr and "slices" in result.stderr
    whole, parts = (read_reconstruction(Path(name)) for name in ("whole.h5", "parts.h5"))
    assert int(str(parts.parameters["slabs"])) > 1
    assert np.abs(parts.volume.data - whole.volume.data).max() < near * whole.volume.data.max()
    assert parts.metrics.keys() == whole.metrics.keys()
    assert parts.metrics["residual"] == pytest.approx(whole.metrics["residual"], rel=0.02)
    assert left(tmp_path) == {"scan.h5", "whole.h5", "parts.h5"}


@pytest.mark.usefixtures("tall")
def test_what_does_not_fit_is_refused_before_the_work(tmp_path: Path) -> None:
    for words in ((), ("--dry-run",)):
        result = beamline("recon", "scan.h5", "-m", "fbp", "--memory", "1M", "-o", "out.h5", *words)
        assert result.exit_code == 5, result.output
        assert "Give --memory 3M if there is as much, or --bin 2" in result.stderr
    result = beamline("recon", "scan.h5", "-m", "os-sirt-tv", "--memory", "3M", "-o", "out.h5")
    assert result.exit_code == 5 and "os-sirt-tv of the smallest slab" in result.stderr and "-m fbp" in result.stderr
    result = beamline("recon", "scan.h5", "--budget", "10s", "--memory", "1G")
    assert result.exit_code == 2 and "does not go with" in result.stderr
    result = beamline("recon", "scan.h5", "-m", "r2", "--checkpoint", "fit.h5", "--memory", "3M", "-o", "out.h5")
    assert result.exit_code == 2 and "needs the whole scan in memory" in result.stderr
    for words in ((), ("--dry-run",)):  # before anything is learnt, which takes minutes
        result = beamline("recon", "scan.h5", "-m", "fbp", "--calibrate", "axis,tilt", "--memory", "3M", *words)
        assert result.exit_code == 2 and "--calibrate with roll or tilt needs the whole scan in" in result.stderr
    assert left(tmp_path) == {"scan.h5"}
    result = beamline("recon", "scan.h5", "-m", "fbp", "--memory", "lots")
    assert result.exit_code == 2 and "such as 8G" in result.stderr


def test_what_is_needed_grows_with_the_scan() -> None:
    views = Geometry.parallel(np.linspace(0, np.pi, 1800, endpoint=False), (2048, 2048))
    full = ReconMemory(Fbp(), views, 2 * 1800 * 2048**2, False)
    assert full.line_integrals == 1800 * 2048**2 * 4 and full.volume == 2048**3 * 4
    assert 60e9 < full.at_once < 90e9
    assert full.least < 4e9 and full.slab(full.height(8_000_000_000)) < 8e9
    tv = ReconMemory(OsSirtTv(), views, 2 * 1800 * 2048**2, False)
    assert 64 <= tv.height(32_000_000_000) < 256 and tv.slab(tv.height(32_000_000_000)) < 32e9


@pytest.mark.usefixtures("tall")
def test_a_dry_run_says_what_the_run_takes_and_writes_nothing(tmp_path: Path) -> None:
    few = ("recon", "scan.h5", "-m", "sirt", "--iterations", "2", "--memory", "16M", "--dry-run")
    said = beamline(*few)
    assert said.exit_code == 0, said.output
    assert "200 x 48 x 48 voxels by sirt, from 60 views" in said.stdout and "about" in said.stdout
    data = json.loads(beamline(*few, "--json").stdout.splitlines()[-1])
    assert data["slabs"] > 1 and data["memory"] <= 16_000_000 < data["at_once"]
    assert data["output"] == 4 * 200 * 48**2 and data["scratch"] == 4 * 60 * 200 * 48 + data["output"]
    assert data["seconds"] > 0
    assert left(tmp_path) == {"scan.h5"}


@pytest.mark.slow
@pytest.mark.usefixtures("tall")
def test_a_dry_run_counts_moments_of_an_exposure_and_slices_that_views_step_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Views of 200 rows; the later half stands 100 rows higher."""
    Path("poses.csv").write_text("view,shift_row_px\n" + "".join(f"{n},{100 * (n >= 30)}\n" for n in range(60)))
    seen = list[tuple[Geometry, Grid]]()
    monkeypatch.setattr(estimate, "forecast", lambda method, geometry, grid, now: seen.append((geometry, grid)))
    dry = ("recon", "scan.h5", "-m", "sirt", "--dry-run", "-o", "out.h5")
    stepped = beamline(*dry, "--poses", "poses.csv")
    assert "300 x 48 x 48 voxels" in stepped.stdout and seen[-1][1].shape[0] == 300, stepped.output
    assert beamline(*dry, "--exposure-arc", "4:2").exit_code == 0
    assert seen[-1][0].width.arc == pytest.approx(np.radians(4)) and seen[-1][0].skew != 0


@pytest.mark.slow
def test_a_slab_of_air_is_left_to_voxels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians are placed in matter; the views of a slab without any may even be below zero on average."""
    monkeypatch.chdir(tmp_path)
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(96, 32), axis_col=15.7)
    counts = scan.counts()
    counts[:, 40:] = 20110
    write_exchange(Path("scan.h5"), scan, {"data": counts, "data_white": np.full((2, 96, 32), 20100, np.uint16)})
    options = ("recon", "scan.h5", "-m", "r2", "--steps", "10", "--gaussians", "900", "--air", "none", "--no-report")
    result = beamline(*options, "--memory", "7M", "-o", "out.h5")
    assert result.exit_code == 0 and "by fista-tv" in result.stderr, result.output
    volume = read_reconstruction(Path("out.h5")).volume.data
    assert np.abs(volume[70:]).max() < 0.02 * volume.max()


@pytest.mark.parametrize(
    ("to", "wedge"), [(120.0, "60° of rays are in no view, those at 28 to 88° from x"), (180.0, "")]
)
def test_a_report_shows_the_wedge_that_no_view_sees(
    to: float, wedge: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scan = TwoCylinders(angles=np.radians(np.arange(0, to, 4.0)), shape=(8, 48), axis_col=23.7)
    write_exchange(Path("scan.h5"), scan, {"data": scan.counts(), "data_white": np.full((2, 8, 48), 20100, np.uint16)})
    assert beamline("recon", "scan.h5", "-m", "fbp", "-o", "out.h5").exit_code == 0
    page = next(Path().glob("*.html")).read_text()
    assert ("Missing wedge" in page) == bool(wedge) and wedge in page
