"""`beamline recon --volumes N`: a fading cylinder, from the scan to volumes in time and the commands that read them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import recon
from beamline import api
from beamline.page.tiles import TileRegion
from beamline.page.volume import ShownVolume
from beamline.projections.selection import Selection
from beamline.storage.volumes.files import opened_volume
from recon.base.greys import material_window
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import BEAM, DARK, TwoCylinders, frames_of, write_flagged

VIEWS, SPAN = 36, 3.5  # s from the first view to the last
SCAN = TwoCylinders(np.radians(np.arange(VIEWS) * 111.246), (2, 40), axis_col=19.5)
ASKED = "--volumes", "2", "--no-moves", "--set", "sweeps=30"
FADED = 0.5  # of the attenuation of all, at the last view


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All of it loses half of its attenuation, evenly in time; the file's clock is of 2027."""
    lines = SCAN.line_integrals() * (1 - FADED * np.arange(VIEWS) / (VIEWS - 1))[:, None, None]
    counts = np.round(DARK + BEAM * np.exp(-lines)).astype(np.uint16)
    frames = frames_of(SCAN)
    views = [replace(frame, counts=image) for frame, image in zip(frames[4:], counts, strict=True)]
    return write_flagged(tmp_path_factory.mktemp("fading") / "scan.h5", frames[:4] + views, {})


@pytest.fixture(scope="module", autouse=True)
def weight_given() -> Iterator[None]:
    """No trials of weights and factors, which take most of the time; others test them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("recon.features.joint.series.weights_by_views", lambda *_, **__: np.full(2, 0.01))
        patched.setattr("recon.features.joint.series.smooth_factors", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def series(scan: Path) -> Path:
    path = scan.with_name("series.h5")
    done = beamline("recon", str(scan), *ASKED, "--axis", "19.5", "-o", str(path))
    assert done.exit_code == 0, done.output
    assert f"{'volumes':<10}2 of 2 x 40 x 40 in 1/mm, 0 to 3.5 s" in done.output
    return path


def test_each_time_has_the_attenuation_of_its_time(series: Path) -> None:
    with h5py.File(series) as file:
        data = file["entry/data"]
        assert data.attrs["axes"].tolist() == ["time", "z", "y", "x"]
        assert data["time"][:] == pytest.approx([0, SPAN])
        assert data["time"].attrs["units"] == "s"
        sums = data["data"][:].sum((1, 2, 3))
        said = file["entry/reconstruction/parameters"]
        assert said["view_seconds"][:] == pytest.approx(0.1 * np.arange(VIEWS))
        assert said["view_angles_deg"].shape == (VIEWS,)
    assert sums[1] / sums[0] == pytest.approx(1 - FADED, abs=0.02)
    with opened_volume(series, at=0) as record:
        truth = SCAN.truth(record.volume.grid)
        assert np.corrcoef(np.ravel(record.volume.data[:]), truth.ravel())[0, 1] > 0.95


def test_one_of_the_volumes_is_exported_and_all_are_not(series: Path, tmp_path: Path) -> None:
    refused = beamline("export", str(series), "-o", str(tmp_path / "all.npy"))
    assert refused.exit_code == 5
    assert "contains 2 volumes of a time series: choose one with --at 0 to 1" in refused.output
    for at, name in ((1, "last.npy"), (1, "last.h5")):
        done = beamline("export", str(series), "--at", str(at), "-o", str(tmp_path / name))
        assert done.exit_code == 0, done.output
    with h5py.File(series) as file:
        assert np.array_equal(np.load(tmp_path / "last.npy"), file["entry/data/data"][1])
    with opened_volume(tmp_path / "last.h5") as record:  # an ordinary volume
        assert (record.series, record.parameters["time_s"]) == (None, pytest.approx(SPAN))
    both = beamline("export", str(series), "--at", "1", "--dataset", "entry/data/data", "-o", str(tmp_path / "b.npy"))
    assert (both.exit_code, (tmp_path / "b.npy").exists()) == (2, False)
    beyond = beamline("export", str(series), "--at", "2", "-o", str(tmp_path / "none.npy"))
    assert (beyond.exit_code, (tmp_path / "none.npy").exists()) == (5, False)
    assert beamline("export", str(tmp_path / "last.h5"), "--at", "0", "-o", str(tmp_path / "n.npy")).exit_code == 5


def test_a_page_shows_the_times_side_by_side(series: Path, scan: Path, tmp_path: Path) -> None:
    page = series.with_suffix(".html").read_text(encoding="utf-8")
    assert (
        "2 volumes at successive times" in page and "Slices at each time" in page and "beamline view series.h5" in page
    )
    assert "Residual of the projections used" in page and "data:image/png" in page
    done = beamline("recon", str(scan), *ASKED, "--no-report", "-o", str(tmp_path / "s.h5"))
    assert done.exit_code == 0, done.output
    assert left(tmp_path) == {"s.h5"}


def test_a_script_gets_the_volumes_that_the_command_writes(series: Path, scan: Path, tmp_path: Path) -> None:
    method, wanted = recon.TimeSeries(volumes=2, moves=False, sweeps=30), Selection(axis_col=19.5)
    held = api.reconstruct(scan, method, selection=wanted, say=None)
    assert held.output is None and held.report is None and not held.parameters["moves"] and held.units == "1/mm"
    assert held.seconds_of_volumes == pytest.approx((0, SPAN)) and held.axis_col == 19.5
    assert held.series is not None
    with h5py.File(series) as file:
        np.testing.assert_array_equal(held.series.data, file["entry/data/data"][()])
        assert held.metrics["residual"] == file["entry/reconstruction/metrics/residual"][()] > 0
    kept = api.reconstruct(scan, method, selection=wanted, output=tmp_path / "kept.h5", say=None)
    assert left(tmp_path) == {"kept.h5", "kept.html"} and kept.report == tmp_path / "kept.html"
    assert kept.series is not None
    np.testing.assert_array_equal(kept.series.data, held.series.data)
    np.testing.assert_array_equal(kept.volume.data, held.series.data[0])
    assert not kept.ended_early
    with pytest.raises(api.DataError, match="12 projections"):
        api.reconstruct(scan, replace(method, volumes=4), selection=wanted, say=None)
    part: dict[str, Any] = {"rows": (0, 1), "views": "fixed:12"}
    for output, more in (("other.tif", dict[str, Any]()), ("other.h5", part)):
        with pytest.raises((api.ConfigError, api.DataError)):
            api.reconstruct(scan, method, output=tmp_path / output, say=None, **more)
    assert left(tmp_path) == {"kept.h5", "kept.html"}


def test_the_series_is_described_and_valid(series: Path) -> None:
    facts = json.loads(beamline("info", str(series), "--json").output.splitlines()[-1])
    assert facts["times_s"] == [0.0, SPAN]
    assert beamline("validate", str(series)).exit_code == 0


def test_slices_of_any_time_have_one_window(series: Path) -> None:
    shown = ShownVolume(series)
    with h5py.File(series) as file:
        stored = file["entry/data/data"][:]
    for time in (0, 1):
        for axis in range(3):
            cut = shown.cut(axis, 1, TileRegion(0, 99, 0, 99), time).values
            assert np.array_equal(cut, stored[time].take(1, axis))
    facts = shown.facts()
    assert facts["seconds"] == pytest.approx((0, SPAN))
    assert facts["window"] == pytest.approx(material_window(stored), rel=0.05)
    assert max(shown.histogram(0)["values"]) > max(shown.histogram(1)["values"])
    shown.close()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--volumes", "3", "--follow"), 2, "--volumes cannot be combined with --follow"),
        (
            ("--volumes", "3", "-m", "fbp"),
            2,
            "--volumes works only with series; it cannot be combined with --method fbp",
        ),
        (("--volumes", "3", "--uncertainty"), 2, "error bars are computed only for a single volume"),
        (("--volumes", "3", "--roi", "0:1,0:9,0:9"), 2, "a box can be cut only from a single volume"),
        (("--volumes", "3", "-o", "series.tif"), 2, "ends in .h5"),
        (("--volumes", "1"), 2, "--volumes"),
        (("--moves",), 2, "add --volumes N"),
        (("--volumes", "4", "--no-moves"), 5, "because each volume needs at least 12 projections"),
        (
            ("--volumes", "2", "--memory", "100K"),
            2,
            "Use --bin, because a time series cannot be reconstructed in slabs",
        ),
        (
            ("--volumes", "2", "--memory", "300K"),
            2,
            "Use --rows with 1 row or fewer at a time, or --bin, because a time series",
        ),
        (
            ("--volumes", "4", "--dry-run"),
            5,
            "4 volumes from 36 projections are too many",
        ),
        (
            ("--volumes", "2", "--memory", "100K", "--dry-run"),
            2,
            "because a time series cannot be reconstructed in slabs",
        ),
    ],
)
def test_what_does_not_go_together_is_one_line(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: int, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = beamline("recon", str(scan), "--axis", "19.5", *words)
    assert (done.exit_code, said in done.output) == (code, True), done.output
    assert not left(tmp_path)


def test_a_dry_run_states_the_memory_and_writes_nothing(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = beamline("recon", str(scan), "--volumes", "2", "--dry-run")
    assert done.exit_code == 0, done.output
    assert f"{'volumes':<10}2 of 2 x 40 x 40 voxels with series, from 36 projections" in done.output
    assert "not known, because the time of series cannot be predicted" in done.output.splitlines()[-1]
    told = json.loads(beamline("recon", str(scan), "--volumes", "2", "--dry-run", "--json").stdout)
    assert told["seconds"] is None and told["time"] > 1e9  # of the event
    assert not left(tmp_path)


@pytest.mark.slow
def test_a_stop_during_the_fit_writes_the_volumes_so_far(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os
    import signal

    from recon.features.joint import energy_fit

    sweeps = energy_fit.EnergyFit.sweeps

    def interrupted(fit: energy_fit.EnergyFit, weights: np.ndarray, n: int):  # type: ignore[no-untyped-def]
        for number, residual in enumerate(sweeps(fit, weights, n)):
            every = fit.views.geometry.n_views == 36  # the fit itself, after go_on has heard of its first sweep
            if every and (n, number) == (30, 1):
                os.kill(os.getpid(), signal.SIGINT)
            yield residual

    monkeypatch.setattr(energy_fit.EnergyFit, "sweeps", interrupted)
    output = tmp_path / "out.h5"
    done = beamline("recon", str(scan), *ASKED, "--axis", "19.5", "-o", str(output))
    assert done.exit_code == 4, done.output
    with opened_volume(output, at=1) as record:
        assert record.parameters["ended_early"]


def test_the_help_names_methods_for_comparison_and_not_those_of_several_volumes() -> None:
    said = " ".join(beamline("recon", "--help").output.split())
    compared = re.findall(r"\(([^()]*) are meant for comparison", said)[0]
    assert "sirt" in compared and not {"series"} & set(compared.split(", "))
