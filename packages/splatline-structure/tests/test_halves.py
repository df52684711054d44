"""Volumes from each half of the projections of a scan, and numbers against the number of projections."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench_coverage import RULES, box_of
from grain_scenes import Scene

import recon
from beamline import api
from beamline.core.errors import DataError
from splatline_structure import pictures, volumes
from splatline_structure.intervals import measured_structure
from splatline_structure.study import numbers_of_views
from splatline_structure.volumes import box_in, parts_of, read_volume
from tests.beamline.cli.small_scan import beamline, left

SCENE = Scene(5, views=64, size=14, columns=48, rows=16, photons=1e5)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scan of grains, a column 2 µm wide, in the working folder; nothing is drawn."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pictures, "pictures_of", lambda *_: [])
    monkeypatch.setattr(pictures, "curves_of", lambda *_: b"")
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["exchange/data"] = SCENE.views_of(SCENE.phantom())
        file["exchange/data"].attrs["units"] = "line_integrals"
        file["exchange/theta"] = np.degrees(SCENE.geometry.angles)
        file["exchange/theta"].attrs["units"] = "deg"
        file.attrs["pixel_size_mm"] = 0.002
    return tmp_path


@pytest.mark.slow
def test_halves_of_the_volumes_own_scan_are_made(here: Path) -> None:
    assert beamline("recon", "scan.h5", "-m", "fbp", "--no-report", "-o", "v.h5").exit_code == 0
    result = beamline("structure", "v.h5", "--side", "24", "--json")
    assert result.exit_code == 0, result.output
    done = json.loads(result.stdout.splitlines()[-1])
    truth = float((SCENE.truth(SCENE.phantom())[:, 13:35, 13:35] > 0.95 * 2 / (0.9 * 48)).mean())
    fraction = done["numbers"]["fraction_2"]
    assert done["parts"] == 2 and fraction["views"] > 0
    assert fraction["value"] == pytest.approx(truth, abs=0.1)
    assert fraction["low"] < fraction["value"] + fraction["moves"] < fraction["high"]
    assert {"v.h5", "scan.h5", "v_structure"} == left(here)


@pytest.mark.slow
def test_halves_of_some_slices_are_those_of_their_rows(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By FBP, which takes each row for itself, they have the bits of whole halves; only rows near them are read."""
    assert beamline("recon", "scan.h5", "-m", "fbp", "--no-report", "-o", "v.h5").exit_code == 0
    monkeypatch.setattr(volumes, "_BESIDE", 2)
    shapes, reconstruct = [], recon.reconstruct
    monkeypatch.setattr(
        volumes.recon, "reconstruct", lambda views, **by: shapes.append(views.data.shape) or reconstruct(views, **by)
    )
    whole, middle = (read_volume(Path("v.h5"), None, None, part, 10**9, "square") for part in (None, (3, 12)))
    scan = Path("scan.h5")
    all_, some = (parts_of(part, scan, 2, pytest.fail, lambda *_: None) for part in (whole, middle))
    assert [shape[1] for shape in shapes] == [16, 16, 13, 13]
    for one, other in zip(all_, some, strict=True):
        np.testing.assert_array_equal(one[3:12], other)


@pytest.mark.slow
def test_halves_of_a_scan_without_pixel_size_are_in_the_volumes_unit(here: Path) -> None:
    """They were 1/mm beside a volume in 1/px, and thresholds lay off by 27 gaps of levels."""
    with h5py.File("scan.h5", "r+") as file:
        del file.attrs["pixel_size_mm"]
    assert beamline("recon", "scan.h5", "-m", "fbp", "--no-report", "-o", "v.h5").exit_code == 0
    result = beamline("structure", "v.h5", "--voxel-um", "2", "--side", "0", "--json")
    assert json.loads(result.stdout.splitlines()[-1])["thresholds_off"] < 0.1


@pytest.mark.slow
def test_thirty_views_of_a_thousand_photons_across_256_columns_determine_nothing() -> None:
    scene = Scene(1, columns=256, rows=8, views=30, photons=1e3)
    data, views, box = scene.views_of(scene.phantom()), np.arange(scene.views), box_of(scene)
    of_views = [
        recon.reconstruct(data[part], scene.geometry.select(part), scene.method, grid=scene.grid).volume.data[box]
        for part in (views, views[::2], views[1::2])
    ]
    intervals = measured_structure(of_views[0], of_views[1:], 2, (1, 1, 1), replace(RULES, side=0)).intervals
    assert all("more projections or photons" in each.why_not for each in intervals.values())


@pytest.mark.slow
def test_intervals_against_views_are_wider_for_fewer_in_one_box_about_one_axis(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes, axes, reconstruct = [], [], api.reconstruct
    monkeypatch.setattr(volumes, "box_in", lambda *how: boxes.append(box_in(*how)) or boxes[0])
    monkeypatch.setattr(
        api, "reconstruct", lambda *at, **of: axes.append(of["selection"].axis_col) or reconstruct(*at, **of)
    )
    words = ("-m", "fbp", "--number", "fraction", "--number", "surface")
    result = beamline("study", "structure", "scan.h5", "--views", "16,64", *words)
    assert result.exit_code == 0, result.output
    with (here / "scan_views/numbers.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["n_views"], row["number"]) for row in rows] == [
        (views, name) for views in ("16", "64") for name in ("fraction_1", "fraction_2", "surface")
    ]
    few, all_ = rows[2], rows[5]
    assert few["value"] == "not determined" or float(few["views"]) > float(all_["views"])
    assert (here / "scan_views/report.html").is_file()
    assert len(boxes) == 1 and axes[0] is None and axes[1] == pytest.approx(23.5, abs=0.2)


@pytest.mark.slow
def test_a_scan_without_the_size_of_a_pixel_is_copied_with_one_and_studied(here: Path) -> None:
    with h5py.File("scan.h5", "a") as file:
        del file.attrs["pixel_size_mm"]
    result = beamline("study", "structure", "scan.h5", "--views", "64", "--number", "surface", "-m", "fbp")
    assert result.exit_code == 5 and "`beamline ingest scan.h5 COPY.h5 --pixel-size-um SIZE`" in result.stderr
    assert left(here) == {"scan.h5"}
    assert beamline("ingest", "scan.h5", "copy.h5", "--pixel-size-um", "2").exit_code == 0
    result = beamline("study", "structure", "copy.h5", "--views", "64", "--number", "surface", "-m", "fbp")
    assert result.exit_code == 0, result.output


def test_a_number_that_is_not_there_is_refused_before_anything_is_reconstructed(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api, "reconstruct", None)
    result = beamline("study", "structure", "scan.h5", "--views", "16,64", "--number", "fraction_3")
    words = (
        "--number fraction_3: expected a kind of numbers, such as tortuosity, or one of fraction_1, fraction_2, surf"
    )
    assert result.exit_code == 2 and words in result.stderr
    assert "tortuosity_x." in result.stderr and left(here) == {"scan.h5"}


def test_a_scan_is_refused_and_what_is_to_be_done_is_named(here: Path) -> None:
    result = beamline("structure", "scan.h5", "--voxel-um", "2")
    assert result.exit_code == 5
    assert "with `beamline recon` first: it is a scan (/exchange/data (Data Exchange))" in result.stderr
    assert left(here) == {"scan.h5"}


def test_a_volume_that_is_laid_out_as_a_scan_is_read_by_its_name(here: Path) -> None:
    with h5py.File(here / "volume.h5", "w") as file:
        file["exchange/data"] = np.zeros((9, 10, 11), np.float32)
    read = read_volume(here / "volume.h5", "exchange/data", (2, 2, 2), None, 10**9, "square")
    assert read.record.grid.shape == (9, 10, 11)
    with pytest.raises(DataError, match="If the file does contain a volume, give --dataset"):
        read_volume(here / "volume.h5", None, (2, 2, 2), None, 10**9, "square")


def test_rows_that_do_not_give_the_volumes_slices_are_refused_with_a_way_out(here: Path) -> None:
    np.save(here / "v.npy", np.random.default_rng(0).random((10, 48, 48), np.float32))
    read = read_volume(here / "v.npy", None, (2, 2, 2), None, 10**9, "square")
    read = replace(read, record=replace(read.record, parameters={"axis_col": 23.5}))
    with pytest.raises(
        ValueError,
        match=r"give --parts or --quick, because the volume and the scan do not fit together: the volume has 10 "
        r"slices, but rows 0:16 of the scan give 16 slices",
    ):
        parts_of(read, here / "scan.h5", 2, pytest.fail, lambda *_: None)


def test_halves_of_a_volume_without_an_axis_are_refused_with_a_way_out(here: Path) -> None:
    np.save(here / "v.npy", np.random.default_rng(0).random((16, 48, 48), np.float32))
    result = beamline("structure", "v.npy", "--voxel-um", "2", "--scan", "scan.h5")
    words = "v.npy cannot be measured: give --parts or --quick, because the volume does not state the rotation axis"
    assert result.exit_code == 5 and words in result.stderr
    assert left(here) == {"scan.h5", "v.npy"}


@pytest.mark.parametrize("views", ["8,64", "many", "16,", "1e3"])
def test_views_that_cannot_be_parted_are_refused(here: Path, views: str) -> None:
    result = beamline("study", "structure", "scan.h5", "--views", views)
    assert result.exit_code == 2
    assert f"'{views}': expected numbers such as 45,90,180, each 16 or more" in result.stderr
    assert left(here) == {"scan.h5"}


def test_the_same_number_of_views_counts_once() -> None:
    assert numbers_of_views("64, 16,64") == [64, 16]
