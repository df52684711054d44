"""`beamline xafs`: scenes, tables, radiographs and series, and errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import Result

from beamline.core.errors import DataError
from splatline_spectral.measured import open_measured
from splatline_spectral.results import nearest_edges
from tests.beamline.cli.small_scan import beamline


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
    with h5py.File("mu.h5", "w") as file:
        file["energy"], file["mu"] = energies[::-1], mu[::-1]
    return tmp_path


def xafs(*arguments: object) -> Result:
    return beamline("xafs", *arguments)


def test_the_shipped_scene_has_its_white_line_at_8348_5_ev(folder: Path) -> None:
    result = xafs("edge_scan", "--from", "8.32", "--to", "8.38", "--json")
    assert result.exit_code == 0, result.output
    done = json.loads(result.stdout.splitlines()[-1])
    (state,) = done["states"]
    assert (done["event"], state["n_energies"], state["unit"]) == ("done", 61, "1/mm")
    assert abs(state["white_line_kev"] - 8.3485) < 0.0005
    assert state["edge_kev"] == pytest.approx(8.3435, abs=0.001)
    assert abs(state["best_kev"] - 8.3485) < 0.0025  # half the white line's width
    assert len(Path("edge_scan_xafs.csv").read_text(encoding="utf-8").splitlines()) == 62
    assert Path("edge_scan_xafs.png").read_bytes().startswith(b"\x89PNG")


def test_where_there_is_no_edge_it_says_so(folder: Path) -> None:
    result = xafs("edge_scan", "--from", "8.25", "--to", "8.29", "--step", "0.002", "-o", "far.png")
    assert result.exit_code == 6, result.output
    assert "the absorption curve is as smooth as a curve without an edge" in result.stdout
    assert Path("far.png").exists() and Path("far.csv").exists()


@pytest.mark.parametrize("words", [("mu.csv", "--unit", "eV"), ("mu.h5",)])
def test_a_curve_as_text_or_hdf5(folder: Path, words: tuple[str, ...]) -> None:
    result = xafs(*words)
    assert result.exit_code == 0, result.output
    assert "white line  8.348" in result.stdout and "in tables   Ni K 8.3328 keV" in result.stdout
    assert "highest absorption" in result.stdout


def test_measured_radiographs_and_several_regions(folder: Path) -> None:
    words = ("scan.h5", "--region", "5:15,5:15", "--region", "5:10,5:15", "--around", "0:20,16:24", "--from", "8.31")
    result = xafs(*words)
    assert result.exit_code == 0, result.output
    assert result.stdout.count("white line  8.348") == 2 and "highest contrast-to-noise" in result.stdout
    assert "eV from the first" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["edge_scan"], "in keV, such as --from 8.30 --to 8.42"),
        (["edge_scan", "--from", "8.3", "--to", "8.305"], "there are 6 energies, but there must be 9 to 5000"),
        (
            ["edge_scan", "--from", "8.3", "--to", "8.4", "--material", "Cu"],
            "choose one of the materials electrolyte, NMC811",
        ),
        (["mu.csv"], "unit of the file with --unit"),
        (["mu.h5", "--from", "8.395"], "an edge needs 9 energies, but only"),
        (["none.h5"], "none.h5"),
        (["scan.h5", "--region", "5:15,5:50"], "is outside of frames of 20 x 24"),
        (["scan.h5", "--region", "5"], "expected ROW:END,COL:END"),
        (["scan.h5", "--region", "5:15,5:15", "--around", "5:15,5:15"], "no pixel outside of --region"),
        (["edge_scan", "--states", "0,2"], "numbers from 0 to 1"),
        (["mu.h5", "-o", "mu.txt"], "expected the name of a .png file"),
    ],
)
def test_what_is_refused_leaves_nothing(folder: Path, arguments: list[str], said: str) -> None:
    result = xafs(*arguments)
    assert result.exit_code in (2, 5) and said in result.stderr, result.output
    assert {path.name for path in folder.iterdir()} == {"mu.csv", "mu.h5", "scan.h5"}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"energy": [8.3, 8.4]}, "must have the dataset energy"),
        ({"energy": [8.3, 8.3], "mu": [1.0, 2.0]}, "more than once"),
        ({"energy": [8.3, 8.4], "mu": [1.0, np.nan]}, "finite absorption"),
        ({"energy": [8.3, 8.4], "frames": np.ones((3, 4, 4))}, r"expected \[energy, row, col\] with 2"),
        ({"energy": [8.3, 8.4], "frames": np.ones((2, 4, 4))}, "flats must have"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, content: dict[str, Any], said: str) -> None:
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        for name, values in content.items():
            file[name] = values
    with pytest.raises(DataError, match=said), open_measured(tmp_path / "bad.h5", (0, 99), None, None, None):
        pass


def test_the_nearest_edges_are_named() -> None:
    assert nearest_edges(8.3455) == "Ni K 8.3328 keV, 12.7 eV below; Er L3 8.3579 keV, 12.4 eV above"
    assert nearest_edges(8.3455, [27]).startswith("Co K 7.7089 keV")
