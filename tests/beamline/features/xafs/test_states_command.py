"""`beamline xafs` with several states in one picture, and its maps of the state of charge."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.core.voxel_kind import VoxelKind
from beamline.storage.volumes.files import opened_volume, write_volume
from beamline.storage.writers.recon_file import ReconRecord
from recon.base.volume import Grid, Volume
from simulators.samples.materials.palette import known
from tests.beamline.features.materials.test_command import ENERGIES, GRAINS, PITCH, SCENE, spectra

pytest.importorskip("xraylib")
CHARGES = (0.0, 0.5, 1.0)


def beamline(*words: Any) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def said(result: Result) -> Any:
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.slow
def test_edges_of_a_scene_move_up_with_the_charge(tmp_path: Path, real_pictures: None) -> None:
    """By 2 eV for nickel from fresh to charged, as the scene has it; the picture and the table have all states."""
    done = beamline(
        "xafs", "edge_scan", "--from", 8.32, "--to", 8.38, "--step", 0.0005, "--states", "0,0.5,1", "--json",
        "-o", tmp_path / "states.png",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    found = said(done)["states"]
    edges, tops = ([1e3 * state[key] for state in found] for key in ("edge_kev", "white_line_kev"))
    assert np.subtract(edges, edges[0]) == pytest.approx([0, 1, 2], abs=0.4)
    assert np.subtract(tops, tops[0]) == pytest.approx([0, 1, 2], abs=0.6)
    assert (tmp_path / "states.png").stat().st_size > 10_000
    rows = list(csv.DictReader((tmp_path / "states.csv").read_text().splitlines()))
    assert len(rows) == sum(state["n_energies"] for state in found)
    assert list(dict.fromkeys(row["state"] for row in rows)) == [state["what"] for state in found]


def test_files_and_regions_are_states(tmp_path: Path) -> None:
    energies = np.arange(8.30, 8.40, 0.001)
    oxide = known("NMC811")
    assert oxide is not None
    mu = [replace(oxide, state_of_charge=charge).attenuation(energies) / 100 for charge in (0.0, 1.0)]
    for name, curve in zip(("fresh", "charged"), mu, strict=True):
        np.savetxt(tmp_path / f"{name}.csv", np.c_[energies, curve], delimiter=",")
    done = beamline("xafs", tmp_path / "fresh.csv", tmp_path / "charged.csv", "-o", tmp_path / "files.png")
    assert done.exit_code == 0, done.output
    assert "+2.0" in done.stdout and "eV from the first" in done.stdout
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["energy"] = energies
        file["frames"] = np.repeat(np.stack(mu, axis=1)[:, None, :], 6, axis=2) * np.ones((1, 10, 1))
    words = ("--quantity", "line-integrals", "--region", "1:9,0:6", "--region", "1:9,6:12", "--json")
    done = beamline("xafs", tmp_path / "scan.h5", *words, "-o", tmp_path / "regions.png")
    assert done.exit_code == 0, done.output
    first, second = said(done)["states"]
    assert 1e3 * (second["edge_kev"] - first["edge_kev"]) == pytest.approx(2.0, abs=0.3)
    assert first["what"] == "scan.h5, 1:9,0:6"


def fraction(path: Path, values: np.ndarray, grid: Grid, **other: Any) -> Path:
    facts: dict[str, Any] = {"length_unit": "mm", "raw_file": "scan.h5", "title": "t", "sample": "s", "time": 0.0}
    facts |= {"kind": VoxelKind.SHARE, "parameters": {"material": path.stem}} | other
    write_volume(path, ReconRecord(volume=Volume(values.astype(np.float32), grid), **facts))
    return path


@pytest.mark.parametrize("kind", ["h5", "tif", "ome.zarr"])
def test_a_map_of_volume_fractions(tmp_path: Path, kind: str, real_pictures: None) -> None:
    grid = Grid((20, 12, 10), 0.01)
    charge = np.linspace(0, 1, 20)[:, None, None] * np.ones(grid.shape)
    filled = np.zeros(grid.shape)
    filled[:, 2:9, 3:8] = 0.9
    filled[:, 2, :] = 0.4  # less than half
    fresh = fraction(tmp_path / "fresh.h5", (1 - charge) * filled, grid)
    charged = fraction(tmp_path / "charged.h5", charge * filled, grid)
    out, drawn = tmp_path / f"map.{kind}", tmp_path / "map.png"
    done = beamline("xafs", fresh, charged, "--volume", out, "-o", drawn)
    assert done.exit_code == 0, done.output
    assert "charged in the sum of fresh, charged" in done.stdout and drawn.stat().st_size > 10_000
    with opened_volume(out) as record:
        found = np.asarray(record.volume.data[:])
        assert record.volume.grid.voxel_size == pytest.approx(0.01)
    assert (np.isfinite(found) == (filled >= 0.5)).all()
    assert found[filled >= 0.5] == pytest.approx(charge[filled >= 0.5], abs=1e-6)
    more = beamline("xafs", fresh, charged, "--volume", tmp_path / "more.h5", "--least", 0.3, "-o", tmp_path / "2.png")
    assert more.exit_code == 0
    with opened_volume(tmp_path / "more.h5") as record:
        assert (np.isfinite(np.asarray(record.volume.data[:])) == (filled >= 0.3)).all()


def test_a_map_of_volumes_of_several_energies(tmp_path: Path) -> None:
    """Filtered back-projections of two grains at four energies: one is charged, the other is not."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    volumes = []
    for seed, energy in enumerate(ENERGIES):
        scan, volume = tmp_path / f"scan{seed}.h5", tmp_path / f"fbp{seed}.h5"
        words = "--set", f"beam.energy_kev={energy}", "--set", "scan.views=90", "--seed", seed
        assert beamline("simulate", tmp_path / "scene.yaml", *words, "-o", scan).exit_code == 0
        words = "-m", "fbp", "--axis", "31.5", "--no-report"
        done = beamline("recon", scan, *words, "-o", volume)
        assert done.exit_code == 0, done.output
        volumes.append(volume)
    done = beamline(
        "xafs", *volumes, "--spectra", spectra(tmp_path), "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png",
        "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert said(done)["energies_kev"] == pytest.approx(ENERGIES) and said(done)["of"] == "charged"
    with opened_volume(tmp_path / "map.h5") as record:
        middle = np.asarray(record.volume.data[:])[3]
    y, x = (np.mgrid[:64, :64] - 31.5) * PITCH
    for name, at in GRAINS.items():
        inside = middle[np.hypot(x - at[0], y - at[1]) < 0.006]
        assert np.isfinite(inside).mean() > 0.9
        assert np.nanmedian(inside) == pytest.approx(float(name == "charged"), abs=0.15)
    assert np.isnan(middle[:8]).mean() > 0.95  # outside


def _other_grid(folder: Path) -> list[Any]:
    small, large = Grid((2, 8, 8), 0.01), Grid((2, 8, 8), 0.011)
    return [fraction(folder / f"{n}.h5", np.ones(grid.shape), grid) for n, grid in (("a", small), ("b", large))]


def _attenuation(folder: Path) -> list[Any]:
    grid = Grid((2, 8, 8), 0.01)
    return [
        fraction(
            folder / f"{n}.h5", np.ones(grid.shape), grid, kind=VoxelKind.SHARE if n == "a" else VoxelKind.ATTENUATION
        )
        for n in "ab"
    ]


def _nothing(folder: Path) -> list[Any]:
    grid = Grid((2, 8, 8), 0.01)
    return [fraction(folder / f"{n}.h5", np.zeros(grid.shape), grid) for n in "ab"]


@pytest.mark.parametrize(
    ("made", "words", "text"),
    [
        (_other_grid, (), "voxels at other places"),
        (_attenuation, (), "holds attenuation and not volume fractions"),
        (_nothing, (), "No voxel is filled to 0.5"),
        (lambda folder: _nothing(folder)[:1], (), "needs two volumes"),
        (_nothing, ("--region", "0:1,0:1"), "--region is for curves"),
        (_nothing, ("--from", "8"), "--from is for curves"),
        (lambda folder: [folder / "absent.h5", folder / "absent2.h5"], (), "absent.h5"),
    ],
)
def test_what_has_no_map_is_refused_in_one_line(
    tmp_path: Path, made: Callable[[Path], list[Any]], words: tuple[str, ...], text: str
) -> None:
    done = beamline("xafs", *made(tmp_path), "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png", *words)
    assert done.exit_code != 0 and text in done.stderr
    assert not list(tmp_path.glob("map*"))


def test_no_map_stays_where_its_picture_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [fraction(tmp_path / f"{name}.h5", np.full((4, 4, 4), 0.5), Grid((4, 4, 4), 0.01)) for name in "ab"]

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("beamline.core.files.write_whole", full)
    done = beamline("xafs", *files, "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png")
    assert done.exit_code != 0 and not list(tmp_path.glob("map*"))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("edge_scan", "--states", "0,2", "--from", "8.32", "--to", "8.38"), "no states of charge"),
        (("mu.csv", "--states", "0,1"), "--states is for scenes"),
        ((".",), "no folder of a series of scans"),
        (("mu.csv", "--least", "0.4"), "--least is for a map"),
        (("edge_scan", "--states", "0,1", "--material", "graphite", "--from", "8.32", "--to", "8.38"), "graphite"),
    ],
)
def test_what_has_no_states_is_refused(
    tmp_path: Path, words: tuple[str, ...], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = beamline("xafs", *words)
    assert done.exit_code != 0 and text in done.stderr, done.output
    assert not list(tmp_path.iterdir())
