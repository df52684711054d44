"""`beamline structure --states`: the files of a reference and its states, the folder, and what is refused."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from bench_states import errors_of
from state_scenes import PITCH
from test_particle_states import SCENE, VIEWS, reference, seen, truth

import recon
from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import write_volume
from recon.features.reference.particle_fit import ParticleEstimate
from recon.features.reference.particle_states import (
    STEPS,
    ParticleFit,
    ReferenceParticles,
    fit_state,
    numbers_of,
)
from splatline_structure import state_pictures, states
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.test_cone_files import INFO, _write

STATES = ("state_a.h5", "state_b.h5")


def written(path: Path, lines: np.ndarray, angles: np.ndarray, **attributes: Any) -> Path:
    with h5py.File(path, "w") as file:
        file["exchange/data"] = lines
        file["exchange/data"].attrs["units"] = "line_integrals"
        file["exchange/theta"] = np.degrees(angles)
        file["exchange/theta"].attrs["units"] = "deg"
        file.attrs.update({"pixel_size_mm": PITCH, **attributes})
    return path


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A reference and two states in the working folder; nothing is drawn."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(state_pictures, "pictures_of", lambda *_: [])
    np.save("volume.npy", truth())
    write_volume(Path("good.h5"), bare_record(Path("volume.npy"), truth(), (PITCH,) * 3))
    lines, geometry = seen(truth())
    for name in STATES:
        written(tmp_path / name, lines, geometry.angles)
    return tmp_path


def fitted(gain: float = 0.96, scale: float = 1.01) -> Callable[..., ParticleFit]:
    """A fit that takes no time: all particles alike, but the first is gone and the second has lost mass."""

    def fit(reference: Any, lines: Any, geometry: Any, weights: Any, tell: Callable[[], None]) -> ParticleFit:
        n = len(reference.bodies)
        gains = np.full(n, gain)
        gains[:2] = 0.01, 0.8 * gain
        centres = np.array([body.centre for body in reference.bodies])
        for _ in range(STEPS):
            tell()
        noise = np.full((n, 6), 0.005)
        return ParticleFit(
            ParticleEstimate(gains, np.full(n, scale), centres, np.eye(3)), noise, np.ones(n), np.full((n, 3), 0.5)
        )

    return fit


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_folder_has_a_row_for_each_particle_and_state(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(states, "fit_state", fitted())
    result = beamline("structure", "--states", "good.h5", *STATES, "--charge", "0.5,1", "-o", "out", "--json")
    assert result.exit_code == 0, result.output
    assert left(here / "out") == {"report.html", "particles.csv", "states.json", "particles.h5"}
    table = rows(here / "out/particles.csv")
    n = len(table) // 2
    assert [row["state"] for row in table] == [STATES[0]] * n + [STATES[1]] * n
    assert {row["at"] for row in table[:n]} == {"0.5"}
    gone, cracked, usual = table[:3]
    assert gone["verdict"] == "gone" and gone["volume_change_percent"] == "" and gone["shift_z_um"] == ""
    assert cracked["verdict"] == "cracked" and usual["verdict"] == "as before"
    assert float(usual["volume_change_percent"]) == pytest.approx(100 * (1.01**3 - 1), rel=1e-3)
    assert (
        float(usual["volume_change_low"]) < float(usual["volume_change_percent"]) < float(usual["volume_change_high"])
    )
    half = 1.2816 * 0.005
    assert float(usual["volume_change_high"]) == pytest.approx(100 * ((1.01 + half) ** 3 - 1), rel=1e-3)
    assert float(usual["shift_y_um"]) == pytest.approx(0.5e3 * PITCH, rel=1e-3)
    assert float(usual["grey_change_percent"]) == pytest.approx(-4, abs=0.3)  # of the contrast; electrolyte is 1.4 %
    with h5py.File(here / "out/particles.h5") as file:
        labels = file["entry/data/labels"][:]
        z, y, x = (int(np.abs(1e3 * file[f"entry/data/{a}"][:] - float(usual[f"{a}_um"])).argmin()) for a in "zyx")
    assert labels[z, y, x] == int(usual["particle"])
    done = json.loads(result.stdout.splitlines()[-1])
    assert [state["at"] for state in done["states"]] == [0.5, 1] and done["across"] == "state of charge"
    assert done["states"][0]["gone"] == done["states"][0]["cracked"] == 1
    assert "state of charge" in (here / "out/states.json").read_text(encoding="utf-8")


def test_progress_counts_the_steps_of_all_states(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(states, "fit_state", fitted())
    result = beamline("structure", "--states", "good.h5", *STATES, "-o", "out")
    assert result.exit_code == 0, result.output
    assert f"steps of the fit: {2 * STEPS}/{2 * STEPS}" in result.stderr
    assert "state_a.h5: projections 45, particles as before" in result.stdout


@pytest.mark.usefixtures("real_pictures")
def test_pictures_are_drawn(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    monkeypatch.chdir(here)
    monkeypatch.setattr(states, "fit_state", fitted())
    result = beamline("structure", "--states", "good.h5", *STATES, "-o", "out")
    assert result.exit_code == 0, result.output
    assert (here / "out/report.html").read_text(encoding="utf-8").count("data:image/png") == 3


def test_a_state_of_another_sample_is_told_and_alone_it_is_refused(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fits = iter([fitted(), fitted(gain=0.2), fitted(gain=0.2), fitted(gain=0.2)])
    monkeypatch.setattr(states, "fit_state", lambda *given: next(fits)(*given))
    result = beamline("structure", "--states", "good.h5", *STATES, "-o", "out")
    assert result.exit_code == 0 and "state_b.h5 shows another sample than good.h5" in result.stderr
    assert {row["verdict"] for row in rows(here / "out/particles.csv") if row["state"] == "state_b.h5"} == {"not seen"}
    result = beamline("structure", "--states", "good.h5", *STATES, "-o", "none")
    assert result.exit_code == 5 and "No scan of a state shows the sample of the reference good.h5" in result.stderr
    assert not (here / "none").exists()


def test_after_ctrl_c_nothing_is_left(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*given: Any) -> ParticleFit:
        raise KeyboardInterrupt

    monkeypatch.setattr(states, "fit_state", stopped)
    before = left(here)
    assert beamline("structure", "--states", "good.h5", *STATES, "-o", "out").exit_code == 130
    assert left(here) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("good.h5",), "--states needs the volume of the reference and the scan of at least one state"),
        (("good.h5", *STATES, "--compare"), "--compare needs two volumes, got 3"),
        (("good.h5", "state_a.h5", "--compare"), "--states cannot be combined with --compare"),
        (("good.h5", *STATES, "--slices", "0", "4"), "--states cannot be combined with --slices"),
        (("good.h5", *STATES, "--quick"), "--states cannot be combined with --quick"),
        (("good.h5", *STATES, "--charge", "1"), "--charge has 1 values, but there are 2 states"),
        (("good.h5", *STATES, "--charge", "a,b"), "expected numbers such as 0.2,0.5,1"),
        (("good.h5", *STATES, "--particles", "3"), "There is no material 3"),
        (("good.h5", *STATES, "--particles", "1"), "--particles 1 is the least dense material"),
        (("good.h5", *STATES, "--memory", "1M"), "good.h5: not enough memory. 32 x 96 x 96 voxels need"),
        (("good.h5", *STATES, "--memory", "70M"), "state_a.h5: not enough memory"),
        (("good.h5", "none.h5"), "none.h5"),
        (("good.h5", "good.h5"), "good.h5"),
        (("volume.npy", *STATES), "does not state the voxel size"),
        (("state_b.h5", *STATES), "state_b.h5"),
        (("good.h5", "state_a.h5", "cone.h5"), "`--states` needs parallel-beam scans"),
        (("good.h5", "coarse.h5"), "the pixels are 1.3 µm wide"),
        (("holes.h5", *STATES), "1 of 294912 voxels of holes.h5 are not finite"),
        (("flat.h5", *STATES), "flat.h5 cannot be the reference"),
    ],
)
def test_wrong_input_is_refused_and_nothing_is_left(here: Path, arguments: tuple[str, ...], words: str) -> None:
    lines, geometry = seen(truth())
    written(here / "coarse.h5", lines[:4], geometry.angles[:4], pixel_size_mm=2 * PITCH)
    _write(here / "cone.h5", INFO, 4)
    for name, volume in (("holes", np.where(np.arange(truth().size).reshape(truth().shape) == 7, np.nan, truth())),
                         ("flat", np.ones_like(truth()))):  # fmt: skip
        (here / f"{name}.h5").write_bytes((here / "good.h5").read_bytes())
        with h5py.File(here / f"{name}.h5", "r+") as file:
            file["entry/data/data"][...] = volume
    before = left(here)
    result = beamline("structure", "--states", *arguments, "-o", "out")
    assert result.exit_code != 0 and words in " ".join(result.output.split()), result.output
    assert left(here) == before


def test_charge_needs_states(here: Path) -> None:
    assert "--charge needs --states" in beamline("structure", "good.h5", "--charge", "1").output


@pytest.mark.slow
def test_files_of_a_reference_and_a_state_give_the_numbers_of_the_library(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command finds the particles in the volume and the rotation axis in the projections; the numbers are right."""
    calls = list[tuple[ReferenceParticles, recon.Geometry, ParticleFit]]()

    def fit(given: ReferenceParticles, data: np.ndarray, views: recon.Geometry, *others: Any) -> ParticleFit:
        np.testing.assert_array_equal(data, lines)
        calls.append((given, views, fit_state(given, data, views, *others)))
        return calls[-1][2]

    monkeypatch.setattr(states, "fit_state", fit)
    geometry, lines = SCENE.geometry(VIEWS), SCENE.lines(6, VIEWS)
    written(here / "charged.h5", lines, geometry.angles)
    result = beamline("structure", "--states", "good.h5", "charged.h5", "-o", "out")
    assert result.exit_code == 0, result.output
    ((own, views, fitted_),) = calls
    assert len(own.bodies) == len(reference().bodies)
    assert abs(views.axis_col - geometry.axis_col) < 0.1 and views.pixel_pitch == geometry.pixel_pitch
    numbers = numbers_of(own, fitted_)
    found = errors_of(SCENE, own, numbers, 6)
    assert found.usual.sum() > 8 and abs(found.grey[found.usual].mean()) < 0.6 and found.grey[found.usual].std() < 1.5
    whole = [row for row in rows(here / "out/particles.csv") if row["cut"] == "0"]
    kept = np.flatnonzero(~own.cut)
    assert [row["verdict"] for row in whole] == [numbers.verdict[k] for k in kept]
    for column, of_library in (("volume_change_percent", numbers.growth), ("grey_change_percent", numbers.grey_change)):
        np.testing.assert_allclose([float(row[column]) for row in whole], 100 * of_library[kept, 0], atol=0.01)
