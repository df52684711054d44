"""`beamline segment`: labels, table and picture; what a volume file says of its voxels; refusals."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.features.particles import run as segment_run
from beamline.storage.volumes.base import bare_record
from beamline.storage.writers.recon_file import write_reconstruction
from recon.base.volume import Grid, Volume
from tests.beamline.cli.small_scan import beamline, left
from tests.recon.post.phantom import BALLS, can

VOXEL, CENTRE = 0.01, (0.5, -0.2, 0.3)  # mm
WHOLE = [ball for ball in BALLS if ball[0][2] < 55]  # the others lie outside the square in the can
MARGIN = ("--margin", "0.08")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest."""
    monkeypatch.setattr(segment_run, "picture_of", lambda *_: b"")


def _rows(path: Path) -> list[dict[str, float]]:
    with path.open(encoding="utf-8", newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


@pytest.mark.usefixtures("real_pictures")
def test_particles_of_a_reconstruction_are_in_mm_in_its_frame(here: Path) -> None:
    data = can()
    grid = Grid(data.shape, VOXEL, CENTRE)
    write_reconstruction(here / "recon.h5", replace(bare_record(here, data, (VOXEL,) * 3), volume=Volume(data, grid)))
    result = beamline("segment", "recon.h5", *MARGIN)
    assert result.exit_code == 0, result.output
    assert left(here) == {"recon.h5", "recon_particles.h5", "recon_particles.csv", "recon_particles.png"}
    assert (here / "recon_particles.png").read_bytes().startswith(b"\x89PNG")
    assert f"{len(WHOLE)}, 0 of them cut" in result.stdout
    others = len(BALLS) - len(WHOLE)
    assert f"left out    {others} bod{'y' if others == 1 else 'ies'} as bright outside the square" in result.stdout
    rows = _rows(here / "recon_particles.csv")
    assert [row["volume_mm3"] for row in rows] == sorted((row["volume_mm3"] for row in rows), reverse=True)
    first = [axis[0] for axis in grid.coordinates()]
    for centre, radius in WHOLE:
        place = np.array(first) + np.array(centre) * VOXEL
        places = np.array([[row["z_mm"], row["y_mm"], row["x_mm"]] for row in rows])
        nearest = int(np.linalg.norm(places - place, axis=1).argmin())
        row = rows[nearest]
        np.testing.assert_allclose(places[nearest], place, atol=0.3 * VOXEL)
        assert row["equivalent_diameter_mm"] == pytest.approx(2 * radius * VOXEL, rel=0.05)
        assert row["volume_mm3"] == pytest.approx(np.pi / 6 * row["equivalent_diameter_mm"] ** 3, rel=1e-4)
    with h5py.File(here / "recon_particles.h5") as file:
        labels = file["entry/data/labels"]
        (y0, y1), (x0, x1) = (
            (np.searchsorted(axis, file[f"entry/data/{name}"][[0, -1]] - VOXEL / 2))
            for name, axis in zip("yx", grid.coordinates()[1:], strict=True)
        )
        assert f"rows {y0}-{y1}, columns {x0}-{x1} of each slice" in result.stdout
        z, y, x = (file[f"entry/data/{name}"][:] for name in "zyx")
        assert labels.shape == (z.size, y.size, x.size)
        for row in rows:
            near = [int(np.abs(axis - row[f"{name}_mm"]).argmin()) for name, axis in zip("zyx", (z, y, x), strict=True)]
            assert labels[tuple(near)] == row["label"]
        assert file["entry/process/clusters"][()] >= 2


@pytest.mark.usefixtures("undrawn")
def test_error_bars_in_the_file_give_each_volume_an_interval(here: Path) -> None:
    data = can(noise=0.02)
    record = bare_record(here, data, (VOXEL,) * 3)
    rows = []
    for deviation in (None, np.full_like(data, 0.05), np.full_like(data, 0.4)):
        write_reconstruction(here / "v.h5", replace(record, deviation=deviation), replace=True)
        assert beamline("segment", "v.h5", *MARGIN, "-o", "p.h5").exit_code == 0
        rows.append(_rows(here / "p.csv"))
        for name in ("p.h5", "p.csv", "p.png"):
            (here / name).unlink()
    without, sure, unsure = rows
    assert "volume_low_mm3" not in without[0]
    for a, b, c in zip(without, sure, unsure, strict=True):
        assert a["volume_mm3"] == b["volume_mm3"] == c["volume_mm3"]
        assert c["volume_low_mm3"] < b["volume_low_mm3"] < b["volume_mm3"] < b["volume_high_mm3"] < c["volume_high_mm3"]
    true = sorted((4 / 3 * np.pi * (radius * VOXEL) ** 3 for _, radius in WHOLE), reverse=True)
    within = [
        row["volume_low_mm3"] <= volume <= row["volume_high_mm3"] for row, volume in zip(unsure, true, strict=True)
    ]
    assert sum(within) >= len(true) - 2


def test_lengths_are_voxels_where_nobody_knows_them(here: Path) -> None:
    np.save(here / "can.npy", can())
    result = beamline("segment", "can.npy", *MARGIN, "-o", "a.h5", "--json")
    assert result.exit_code == 0, result.output
    done = json.loads(result.stdout.splitlines()[-1])
    assert (done["event"], done["particles"], done["unit"]) == ("done", len(WHOLE), "px")
    assert beamline("segment", "can.npy", *MARGIN, "--voxel-um", "10", "-o", "b.h5").exit_code == 0
    px, mm = _rows(here / "a.csv"), _rows(here / "b.csv")
    for one, other in zip(px, mm, strict=True):
        assert one["volume_px3"] * 1e-6 == pytest.approx(other["volume_mm3"], rel=1e-5)


@pytest.mark.usefixtures("undrawn")
def test_pores_are_the_particles_of_the_negative(here: Path) -> None:
    np.save(here / "can.npy", can())
    np.save(here / "pores.npy", -can())
    assert beamline("segment", "can.npy", "--crop", "none", "-o", "a.h5").exit_code == 0
    assert "of the darkest of" in beamline("segment", "pores.npy", "--crop", "none", "-o", "b.h5", "--dark").stdout
    assert _rows(here / "a.csv") == _rows(here / "b.csv")
    with h5py.File(here / "b.h5") as file:
        assert file["entry/process/dark"][()]
    body = np.ones((24, 24, 24), np.float32)
    body[8:16, 8:16, 8:16] = 0
    np.save(here / "body.npy", body)
    assert "--dark pores" in beamline("segment", "body.npy", "--crop", "none").stdout


@pytest.mark.usefixtures("undrawn")
def test_touching_balls_are_one_without_a_neck(here: Path) -> None:
    np.save(here / "can.npy", can())
    result = beamline("segment", "can.npy", *MARGIN, "--neck", "0")
    assert f"{len(WHOLE) - 1}, 0 of them cut" in result.stdout, result.output


@pytest.mark.usefixtures("undrawn")
def test_the_first_line_says_whether_the_table_is_of_use(here: Path) -> None:
    """A pin of metal does not stand for the sample; a square that cuts most bodies gives way to the whole volume."""
    z, y, x = np.mgrid[:30, :80, :80] - np.array([14.5, 39.5, 39.5])[:, None, None, None]
    data = np.where(y**2 + x**2 < 30**2, np.float32(0.1), np.float32(0))
    data[(y**2 + x**2 < 5**2) & (np.abs(z) < 9)] = 4
    np.save(here / "pin.npy", data)
    result = beamline("segment", "pin.npy")
    assert result.stdout.startswith("of use      yes, 1 whole particle of the densest of")
    data[...] = 0
    for turn in np.arange(0, 2 * np.pi, np.pi / 4):  # at the sample's edge, where the square ends
        data[z**2 + (y - 26 * np.sin(turn)) ** 2 + (x - 26 * np.cos(turn)) ** 2 < 8**2] = 1
    np.save(here / "balls.npy", data)
    result = beamline("segment", "balls.npy")
    assert result.stdout.startswith("of use      yes, 8 whole particles") and "cuts most bodies" in result.stdout
    result = beamline("segment", "balls.npy", "--crop", "square", "-o", "square.h5")
    assert result.stdout.startswith("of use      no, ") and "--crop none takes the whole volume" in result.stdout
