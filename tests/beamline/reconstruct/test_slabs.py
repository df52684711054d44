"""Slabs within a memory limit: the same volume, within the limit, and no other files are left."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.memory import recon_memory_of
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.plan import prepare_within
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.writers.recon_file import read_reconstruction
from recon.voxels.direct import Fbp
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.reconstruct.growing_scan import ScanClock
from tests.beamline.scans import TwoCylinders, write_exchange

LONG = (pytest.mark.slow, pytest.mark.long)


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
        ("2M", ["--bin", "2"]),
        pytest.param("3M", ["--rows", "33:181"], marks=pytest.mark.slow),
        pytest.param("3M", ["--air", "none"], marks=LONG),
    ],
)
def test_the_volume_is_the_same_to_the_bit_in_as_many_slabs_as_its_dry_run_says(
    tmp_path: Path, memory: str, more: list[str]
) -> None:
    given = ("recon", "scan.h5", "-m", "fbp", "--no-report", *more, "--memory", memory, "-o", "parts.h5")
    planned = json.loads(beamline(*given, "--dry-run", "--json").stdout.splitlines()[-1])
    result = beamline(*given)
    assert result.exit_code == 0, result.output
    assert "Temporary files" in result.stderr and "slices" in result.stderr
    parts = read_reconstruction(Path("parts.h5"))
    assert planned["slabs"] == int(parts.parameters["slabs"]) > 1
    np.testing.assert_array_equal(parts.volume.data, volume(*more, "--memory", "1G", "-o", "whole.h5"))
    whole = read_reconstruction(Path("whole.h5"))
    assert "slabs" not in whole.parameters and parts.metrics.keys() == whole.metrics.keys()
    assert parts.metrics["residual"] == pytest.approx(whole.metrics["residual"], rel=1e-6)
    assert parts.parameters["replaced_fraction"] == pytest.approx(whole.parameters["replaced_fraction"])
    assert left(tmp_path) == {"scan.h5", "whole.h5", "parts.h5"}


@pytest.mark.slow
def test_weights_of_pixels_that_measured_nothing_are_in_the_plan(tmp_path: Path) -> None:
    """They are known when views are read; a volume that no longer fits is then made in slabs."""
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 3.0)), shape=(96, 48), axis_col=23.7)
    counts = scan.counts()
    write_exchange(tmp_path / "whole.h5", scan, {"data": counts})
    counts[::2, :, :5] = 0
    write_exchange(tmp_path / "scan.h5", scan, {"data": counts})
    views, slabs = counts.size * 4, {}
    for name in ("whole.h5", "scan.h5"):
        options = ReconOptions(
            SourceOptions(tmp_path / name), OutputPaths(tmp_path / "v.h5", None), Selection(axis_col=23.7), Fbp()
        )
        with open_scan(tmp_path / name) as source:
            selected = select(source, options.selection)
            needs = recon_memory_of(selected, options)
            limited = replace(options, memory=needs.at_once + views)
            _, plan = prepare_within(selected, limited, lambda _: None, ScanClock(), lambda _: None)
        slabs[name] = len(plan.slabs), plan.needs.weights
    assert slabs["whole.h5"] == (0, 0) and slabs["scan.h5"][0] > 1 and slabs["scan.h5"][1] == 2 * views


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "memory", "views", "shape"),
    [
        (("fbp",), 40, 60, (400, 256)),
        pytest.param(("os-sirt-tv", "--iterations", "2"), 44, 30, (320, 96), marks=LONG),
        pytest.param(("cgls", "--iterations", "2"), 56, 30, (200, 256), marks=LONG),
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
    assert result.exit_code == 0 and "Temporary files" in result.stderr, result.output
    assert peak < 1e6 * memory


@pytest.mark.slow
@pytest.mark.usefixtures("tall")
@pytest.mark.parametrize(
    ("method", "more", "memory", "near"),
    [
        pytest.param("sirt", ["--iterations", "2"], "20M", 1e-6, marks=LONG),
        ("fista-tv", ["--iterations", "3", "--tv-weight", "0.002"], "24M", 2e-3),
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
        assert "Use --memory 3M if the computer has this much memory, or --bin 2" in result.stderr
    result = beamline("recon", "scan.h5", "-m", "os-sirt-tv", "--memory", "3M", "-o", "out.h5")
    assert result.exit_code == 5 and "os-sirt-tv of the smallest slab" in result.stderr and "-m fbp" in result.stderr
    result = beamline("recon", "scan.h5", "-m", "r2", "--checkpoint", "fit.h5", "--memory", "3M", "-o", "out.h5")
    assert result.exit_code == 2 and "needs the whole scan in memory" in result.stderr
    for words in ((), ("--dry-run",)):  # before anything is learnt, which takes minutes
        result = beamline("recon", "scan.h5", "-m", "fbp", "--calibrate", "axis,tilt", "--memory", "3M", *words)
        assert result.exit_code == 2 and "--calibrate with roll or tilt needs the whole scan in" in result.stderr
    assert left(tmp_path) == {"scan.h5"}


@pytest.mark.usefixtures("tall")
def test_a_dry_run_says_what_the_run_takes_and_writes_nothing(tmp_path: Path) -> None:
    few = ("recon", "scan.h5", "-m", "sirt", "--iterations", "2", "--memory", "16M", "--dry-run")
    said = beamline(*few)
    assert said.exit_code == 0, said.output
    assert "200 x 48 x 48 voxels with sirt, from 60 projections" in said.stdout and "about" in said.stdout
    data = json.loads(beamline(*few, "--json").stdout.splitlines()[-1])
    assert data["slabs"] > 1 and data["memory"] <= 16_000_000 < data["at_once"]
    assert data["output"] == 4 * 200 * 48**2 and data["scratch"] == 4 * 60 * 200 * 48 + 2 * data["output"]
    assert data["seconds"] > 0
    assert left(tmp_path) == {"scan.h5"}
