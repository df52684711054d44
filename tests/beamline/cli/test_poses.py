"""recon --poses, what its volume keeps of the poses, and their export as a table that --poses reads again."""

import csv
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from tests.beamline.projections.corrections.test_poses import (
    AXES,
    AXIS,
    COLUMNS,
    PITCH,
    SHAPE,
    SHIFTS,
    TURNS,
    N,
    every,
    posed,
    scan,
    table,
)  # fmt: skip

FEW = ["--axis", str(AXIS), "--method", "sirt", "--iterations", "4"]


def run(*words: object) -> tuple[int, str]:
    found = CliRunner().invoke(main, [str(word) for word in words])
    return found.exit_code, found.output


def read(path: Path, name: str) -> np.ndarray:
    with h5py.File(path) as file:
        return np.asarray(file[f"entry/reconstruction/parameters/{name}"][()])


@pytest.mark.slow
def test_poses_of_a_volume_come_back_as_a_table_that_gives_the_same_volume(tmp_path: Path, real_pictures: None) -> None:
    path = scan(tmp_path, posed())
    code, said = run("recon", path, "--poses", every(tmp_path), *FEW, "--bin", "2", "-o", tmp_path / "a.h5")
    assert code == 0, said
    np.testing.assert_allclose(read(tmp_path / "a.h5", "view_shifts_px"), SHIFTS / 2)
    np.testing.assert_allclose(read(tmp_path / "a.h5", "view_roll_deg"), TURNS[:, 0])
    np.testing.assert_allclose(read(tmp_path / "a.h5", "view_tilt_deg"), TURNS[:, 1])
    assert "Poses of the projections" in (tmp_path / "a.html").read_text()
    code, said = run("export", tmp_path / "a.h5", "-o", tmp_path / "a.csv", "--poses")
    axis = f"--poses {tmp_path / 'a.csv'} --axis {read(tmp_path / 'a.h5', 'axis_col'):.2f}"
    assert code == 0 and "40" in said and axis in said, said
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert len(rows) == N
    for column, name in enumerate(("col", "row")):
        np.testing.assert_allclose([float(row[f"shift_{name}_px"]) for row in rows], SHIFTS[:, column])
        np.testing.assert_allclose([float(row[f"shift_{name}_mm"]) for row in rows], SHIFTS[:, column] * PITCH)
    for poses in ("a.csv", "a.h5"):
        again = tmp_path / f"{poses}_again.h5"
        code, said = run("recon", path, "--poses", tmp_path / poses, *FEW, "--bin", "2", "--no-report", "-o", again)
        assert code == 0, said
        with h5py.File(tmp_path / "a.h5") as first, h5py.File(again) as second:
            np.testing.assert_array_equal(first["entry/data/data"], second["entry/data/data"])


def test_a_volume_without_poses_has_none_to_export(tmp_path: Path) -> None:
    assert run("recon", scan(tmp_path, posed()), *FEW, "--no-report", "-o", tmp_path / "a.h5")[0] == 0
    code, said = run("export", tmp_path / "a.h5", "-o", tmp_path / "a.csv", "--poses")
    assert code != 0 and "contains no poses" in said and not (tmp_path / "a.csv").exists()
    code, said = run("export", tmp_path / "a.h5", "-o", tmp_path / "a.csv")
    assert code == 2 and "--poses writes .csv files" in said


def test_bad_tables_are_bad_usage_and_leave_nothing(tmp_path: Path) -> None:
    path = scan(tmp_path, posed())
    (tmp_path / "poses.csv").write_text("view,shift_col_px\n0,nan\n")
    code, said = run("recon", path, "--poses", tmp_path / "poses.csv", *FEW, "-o", tmp_path / "a.h5")
    assert code == 2 and "no finite shift" in said
    short = table(tmp_path, f"view,{COLUMNS}", *(column[:-3] for column in (np.arange(N), *SHIFTS.T, *TURNS.T)))
    code, said = run("recon", path, "--poses", short, *FEW, "-o", tmp_path / "a.h5")
    assert code != 0 and "no pose for 3 of the 40 projections" in said
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.slow
def test_slabs_take_shifts_and_refuse_views_that_lean(tmp_path: Path) -> None:
    geometry = replace(posed(0 * TURNS), detector_shape=(160, SHAPE[1]), axis_row=79.5)
    path = scan(tmp_path, geometry, AXES * (1, 1, 8))
    shifts = table(tmp_path, "view,shift_col_px,shift_row_px", np.arange(N), *SHIFTS.T, name="shifts.csv")
    words = ["recon", path, "--axis", AXIS, "-m", "fbp", "--no-report", "-o"]
    for name, memory in (("whole.h5", "1G"), ("slabs.h5", "3M")):
        code, said = run(*words, tmp_path / name, "--poses", shifts, "--memory", memory)
        assert code == 0, said
    with h5py.File(tmp_path / "whole.h5") as whole, h5py.File(tmp_path / "slabs.h5") as slabs:
        np.testing.assert_array_equal(whole["entry/data/data"], slabs["entry/data/data"])
    code, said = run(*words, tmp_path / "none.h5", "--poses", every(tmp_path), "--memory", "3M")
    assert code == 2 and "--poses with roll, tilt or vectors needs the whole scan in memory" in said
    assert not (tmp_path / "none.h5").exists()
