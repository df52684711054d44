"""`beamline xafs`: one curve, several states, and maps of charge."""

from __future__ import annotations

import csv
import json
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import Result

from beamline.core.quantities import VoxelKind
from beamline.features.xafs import command as xafs
from beamline.features.xafs.series import Series, run_series
from beamline.storage.volumes.files import opened_volume, write_volume
from beamline.storage.writers.recon_file import ReconRecord
from recon.base.volume import Grid, Volume
from simulators.samples.materials.materials import known
from tests.beamline.cli.small_scan import beamline
from tests.beamline.features.materials.test_command import ENERGIES, GRAINS, PITCH, SCENE, spectra


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    energies = np.arange(8.30, 8.40, 0.001)
    away = (energies - 8.3437) * 1e3
    mu = 1 + np.arctan(away / 0.7) / np.pi + 0.6 / (1 + ((away - 5) / 2.5) ** 2)
    lines = "\n".join(f"{1e3 * e:.1f},{m:.6f}" for e, m in zip(energies, mu, strict=True))
    Path("mu.csv").write_text(f"energy_eV,mu\n{lines}\n", encoding="utf-8")
    rng = np.random.default_rng(0)
    depth = np.full((energies.size, 20, 24), 0.1)
    depth[:, 5:15, 5:15] += 0.4 * mu[:, None, None]
    with h5py.File("scan.h5", "w") as file:
        file["energy"], file["flats"], file["darks"] = energies, np.full((20, 24), 5100.0), np.full((20, 24), 100.0)
        file["frames"] = 100 + rng.poisson(5000 * np.exp(-depth))
    return tmp_path


def _beamline(*arguments: object) -> Result:
    return beamline("xafs", *arguments)


def _left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {"mu.csv", "scan.h5"}


def test_the_shipped_scene_has_its_white_line_at_8348_5_ev(folder: Path) -> None:
    result = _beamline("edge_scan", "--from", "8.32", "--to", "8.38", "--step", "0.001", "--json")
    assert result.exit_code == 0, result.output
    events = [json.loads(line) for line in result.stdout.splitlines()]
    done = events[-1]
    assert (done["event"], done["edge_seen"], done["n_energies"], done["stopped"]) == ("done", True, 61, False)
    assert abs(done["white_line_kev"] - 8.3485) < 0.0005
    assert done["edge_kev"] == pytest.approx(8.3435, abs=0.001)
    assert abs(done["best_kev"] - 8.3485) < 0.0025  # half the white line's width
    assert done["unit"] == "1/mm"
    assert {event["event"] for event in events} == {"progress", "done"}
    assert _left(folder) == {"edge_scan_xafs.png", "edge_scan_xafs.csv"}
    assert len(Path("edge_scan_xafs.csv").read_text(encoding="utf-8").splitlines()) == 62


def test_where_there_is_no_edge_it_says_so(folder: Path) -> None:
    result = _beamline("edge_scan", "--from", "8.25", "--to", "8.29", "--step", "0.002", "-o", "far.png")
    assert result.exit_code == 6, result.output
    assert "no edge     the curve is as smooth as one without an edge" in result.stdout
    assert "beamline: No absorption edge was found" in result.stderr
    assert _left(folder) == {"far.png", "far.csv"}


def test_a_table_in_ev(folder: Path) -> None:
    result = _beamline("mu.csv", "--unit", "eV")
    assert result.exit_code == 0, result.output
    assert "white line  8.348" in result.stdout
    assert "edge        8.343" in result.stdout or "edge        8.344" in result.stdout
    assert "highest absorption" in result.stdout
    assert _left(folder) == {"mu_xafs.png", "mu_xafs.csv"}


def test_measured_radiographs(folder: Path) -> None:
    result = _beamline("scan.h5", "--region", "5:15,5:15", "--around", "0:20,16:24", "--from", "8.31")
    assert result.exit_code == 0, result.output
    assert "white line  8.348" in result.stdout and "highest contrast-to-noise" in result.stdout
    assert "90 energies" in result.stdout or "89 energies" in result.stdout
    assert "frames: 9" in result.stderr or "frames: 8" in result.stderr


@pytest.mark.parametrize(("energies", "left"), [(20, {"edge_scan_xafs.png", "edge_scan_xafs.csv"}), (3, set())])
def test_ctrl_c_is_exit_code_4_with_the_energies_so_far(
    folder: Path, monkeypatch: pytest.MonkeyPatch, energies: int, left: set[str]
) -> None:
    def interrupted(series, sink, clock, stopped):  # type: ignore[no-untyped-def]
        def frames():  # type: ignore[no-untyped-def]
            for k, frame in enumerate(series.frames, start=1):
                if k == energies:
                    signal.raise_signal(signal.SIGINT)
                yield frame

        return run_series(Series(series.title, series.n, frames(), series.regions), sink, clock, stopped)

    monkeypatch.setattr("beamline.features.xafs.curves.run_series", interrupted)
    result = _beamline("edge_scan", "--from", "8.335", "--to", "8.365")
    assert result.exit_code == 4, result.output
    assert f"Stopped after {energies} energies" in result.stderr
    assert _left(folder) == left


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["edge_scan"], 2, "--from 8.30 --to 8.42, in keV"),
        (["edge_scan", "--from", "8.3", "--to", "8.305"], 2, "are 6 energies; it must be 9 to 5000"),
        (["edge_scan", "--from", "8.4", "--to", "8.3"], 2, "are 0 energies"),
        (["edge_scan", "--from", "8", "--to", "9", "--step", "1e-9"], 2, "it must be 9 to 5000"),
        (["edge_scan", "--from", "nan", "--to", "9"], 2, "not a finite number"),
        (["edge_scan", "--from", "8.3", "--to", "8.4", "--region", "0:1,0:1"], 2, "--region is for measured files"),
        (["mu.csv", "--material", "Cu"], 2, "--material is for scenes"),
        (["mu.csv"], 5, "give --unit eV"),
        (["mu.csv", "--unit", "eV", "--from", "8.395"], 5, "too few for an edge, which takes 9"),
        (["scan.h5", "--from", "9"], 5, "0 energies between --from and --to are too few for an edge, which takes 9"),
        (["scan.h5", "--from", "8.35", "--to", "8.34"], 5, "0 energies between"),
        (["scan.h5", "--region", "5:4,0:1"], 2, "is not ROW:END,COL:END"),
        (["scan.h5", "--region", "0:99,0:1"], 2, "is not in frames of 20 x 24 pixels"),
        (["plain", "--from", "8.3", "--to", "8.4"], 2, "has a material"),
        (["nowhere", "--from", "8.3", "--to", "8.4"], 2, "scene 'nowhere' is unknown"),
        (["nowhere.h5"], 5, "nowhere.h5 does not exist"),
        (["mu.csv", "--unit", "eV", "-o", "it.jpg"], 2, "give a .png file"),
        (["mu.csv", "--unit", "eV", "-o", "no/it.png"], 5, "does not exist"),
    ],
)
def test_bad_input_leaves_nothing(folder: Path, arguments: list[str], code: int, said: str) -> None:
    result = _beamline(*arguments)
    assert result.exit_code == code, result.output
    assert said in " ".join(result.stderr.split())
    assert result.stdout == ""
    assert _left(folder) == set()


def test_nothing_is_overwritten(folder: Path) -> None:
    Path("mu_xafs.csv").write_text("mine", encoding="utf-8")
    result = _beamline("mu.csv", "--unit", "eV")
    assert result.exit_code == 5
    assert "mu_xafs.csv exists and results are never overwritten" in result.stderr
    assert Path("mu_xafs.csv").read_text(encoding="utf-8") == "mine"
    told = _beamline("mu.csv", "--unit", "eV", "--json")
    assert (told.exit_code, json.loads(told.stdout)["event"]) == (5, "failed")


def test_frames_without_light_are_not_compared(folder: Path) -> None:
    with h5py.File("scan.h5", "a") as file:
        file["frames"][70:] = 100  # the dark level
    result = _beamline("scan.h5", "--json")
    done = json.loads(result.stdout.splitlines()[-1])
    assert (done["n_energies"], done["n_left_out"]) == (70, 30)
    with h5py.File("scan.h5", "a") as file:
        file["frames"][:] = 100
    result = _beamline("scan.h5", "-o", "dark.png")
    assert result.exit_code == 5
    assert "0 energies are too few" in result.stderr and "too dark, too bright for the sensor" in result.stderr
    assert not Path("dark.png").exists()


def test_measured_files_need_no_tables_of_materials(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither when the command is imported nor when it runs is the simulator, and with it xraylib, asked for."""
    assert not [name for name, value in vars(xafs).items() if "simulate" in str(getattr(value, "__module__", ""))]
    monkeypatch.setitem(sys.modules, "beamline.features.xafs.energy_scan", None)  # to import it is an ImportError
    assert _beamline("mu.csv", "--unit", "eV").exit_code == 0


pytest.importorskip("xraylib")
CHARGES = (0.0, 0.5, 1.0)


def said(result: Result) -> Any:
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.slow
def test_edges_of_a_scene_move_up_with_the_charge(tmp_path: Path, real_pictures: None) -> None:
    """By 2 eV for nickel from fresh to charged, as the scene has it; the picture and the table have all states."""
    done = _beamline(
        "edge_scan", "--from", 8.32, "--to", 8.38, "--step", 0.001, "--states", "0,0.5,1", "--json",
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
    done = _beamline(tmp_path / "fresh.csv", tmp_path / "charged.csv", "-o", tmp_path / "files.png")
    assert done.exit_code == 0, done.output
    assert "+2.0" in done.stdout and "eV from the first" in done.stdout
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["energy"] = energies
        file["frames"] = np.repeat(np.stack(mu, axis=1)[:, None, :], 6, axis=2) * np.ones((1, 10, 1))
    words = ("--quantity", "line-integrals", "--region", "1:9,0:6", "--region", "1:9,6:12", "--json")
    done = _beamline(tmp_path / "scan.h5", *words, "-o", tmp_path / "regions.png")
    assert done.exit_code == 0, done.output
    first, second = said(done)["states"]
    assert 1e3 * (second["edge_kev"] - first["edge_kev"]) == pytest.approx(2.0, abs=0.3)
    assert first["what"] == "scan.h5, 1:9,0:6"


def fraction(path: Path, values: np.ndarray, grid: Grid, **other: Any) -> Path:
    facts: dict[str, Any] = {"length_unit": "mm", "raw_file": "scan.h5", "title": "t", "sample": "s", "time": 0.0}
    facts |= {"kind": VoxelKind.SHARE, "parameters": {"material": path.stem}} | other
    write_volume(path, ReconRecord(volume=Volume(values.astype(np.float32), grid), **facts))
    return path


GRID = Grid((20, 12, 10), 0.01)
CHARGE = np.linspace(0, 1, 20)[:, None, None] * np.ones(GRID.shape)
FILLED = np.zeros(GRID.shape)
FILLED[:, 2:9, 3:8] = 0.9
FILLED[:, 2, :] = 0.4  # less than half


def mapped(folder: Path, name: str, *words: object) -> tuple[str, np.ndarray[Any, Any]]:
    """What the command says of the volumes fresh and charged, and their map."""
    fresh = fraction(folder / "fresh.h5", (1 - CHARGE) * FILLED, GRID)
    charged = fraction(folder / "charged.h5", CHARGE * FILLED, GRID)
    done = _beamline(fresh, charged, "--volume", folder / name, "-o", folder / "map.png", *words)
    assert done.exit_code == 0, done.output
    with opened_volume(folder / name) as record:
        assert record.volume.grid.voxel_size == pytest.approx(0.01)
        return done.stdout, np.asarray(record.volume.data[:])


@pytest.mark.parametrize("kind", ["h5", "tif", "ome.zarr"])
def test_a_map_of_volume_fractions(tmp_path: Path, kind: str) -> None:
    said, found = mapped(tmp_path, f"map.{kind}")
    assert "charged in the sum of fresh, charged" in said
    assert (np.isfinite(found) == (FILLED >= 0.5)).all()
    assert found[FILLED >= 0.5] == pytest.approx(CHARGE[FILLED >= 0.5], abs=1e-6)


def test_a_map_of_voxels_that_are_less_full_is_drawn(tmp_path: Path, real_pictures: None) -> None:
    _, found = mapped(tmp_path, "map.h5", "--least", 0.3)
    assert (np.isfinite(found) == (FILLED >= 0.3)).all()
    assert (tmp_path / "map.png").stat().st_size > 10_000


def test_a_map_of_volumes_of_several_energies(tmp_path: Path) -> None:
    """Filtered back-projections of two grains at three energies: one is charged, the other is not."""
    (tmp_path / "scene.yaml").write_text(SCENE)
    volumes = []
    energies = (ENERGIES[0], ENERGIES[1], ENERGIES[3])
    for seed, energy in enumerate(energies):
        scan, volume = tmp_path / f"scan{seed}.h5", tmp_path / f"fbp{seed}.h5"
        words = "--set", f"beam.energy_kev={energy}", "--set", "scan.views=60", "--seed", seed
        assert beamline("simulate", tmp_path / "scene.yaml", *words, "-o", scan).exit_code == 0
        words = "-m", "fbp", "--axis", "31.5", "--no-report"
        done = beamline("recon", scan, *words, "-o", volume)
        assert done.exit_code == 0, done.output
        volumes.append(volume)
    done = _beamline(
        *volumes, "--spectra", spectra(tmp_path), "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png",
        "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert said(done)["energies_kev"] == pytest.approx(energies) and said(done)["of"] == "charged"
    with opened_volume(tmp_path / "map.h5") as record:
        middle = np.asarray(record.volume.data[:])[2]
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
    done = _beamline(*made(tmp_path), "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png", *words)
    assert done.exit_code != 0 and text in done.stderr
    assert not list(tmp_path.glob("map*"))


def test_no_map_stays_where_its_picture_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [fraction(tmp_path / f"{name}.h5", np.full((4, 4, 4), 0.5), Grid((4, 4, 4), 0.01)) for name in "ab"]

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("beamline.core.files.write_whole", full)
    done = _beamline(*files, "--volume", tmp_path / "map.h5", "-o", tmp_path / "map.png")
    assert done.exit_code != 0 and not list(tmp_path.glob("map*"))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("edge_scan", "--states", "0,2", "--from", "8.32", "--to", "8.38"), "expected numbers from 0 to 1"),
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
    done = _beamline(*words)
    assert done.exit_code != 0 and text in done.stderr, done.output
    assert not list(tmp_path.iterdir())
