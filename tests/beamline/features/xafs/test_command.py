"""`beamline xafs`: the shipped scene's white line, measured files, exit codes, and nothing half written."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.features.xafs import command as xafs
from beamline.features.xafs.series import Series, run_series


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


def _beamline(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["xafs", *arguments])


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

    monkeypatch.setattr("beamline.features.xafs.series.run_series", interrupted)
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
        (["nowhere.h5"], 5, "nowhere.h5 is not there"),
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
