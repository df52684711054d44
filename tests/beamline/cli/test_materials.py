"""`beamline materials`: charged and fresh grains from simulated scans around an edge; no half output."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.core.errors import ConfigError
from beamline.core.signals import StopOnSignal
from beamline.projections.selection import Selection
from beamline.projections.steps.width import Width
from beamline.reconstruct.energy_series import read_spectra, reconstruct_materials
from beamline.storage.readers.open import SourceOptions
from beamline.storage.volumes.files import opened_volume
from drivers.base.clock import SystemClock
from simulators.light.palette import known

pytest.importorskip("xraylib")
ENERGIES = (8.320, 8.345, 8.3485, 8.352)
PITCH = 2.2e-3  # mm
GRAINS = {"charged": (-0.03, 0.0), "fresh": (0.025, 0.01)}
SCENE = """
phantom:
  kind: solids
  materials:
    charged: {formula: LiNi0.8Mn0.1Co0.1O2, density: 4.784, state_of_charge: 1.0}
    fresh: {formula: LiNi0.8Mn0.1Co0.1O2, density: 4.784, state_of_charge: 0.0}
  solids:
    - {kind: ellipsoid, semi_axes: [0.012, 0.012, 0.03], material: charged, centre: [-0.03, 0.0, 0.0]}
    - {kind: ellipsoid, semi_axes: [0.012, 0.012, 0.03], material: fresh, centre: [0.025, 0.01, 0.0]}
beam: {photons_per_s: 1.0e+5, energy_kev: 8.3485}
detector: {shape: [6, 64], pixel_size_um: 2.2, exposure_s: 0.05}
scan: {views: 24, darks: 2, flats: 8}
effects: [photon_noise]
"""


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("series")
    (folder / "scene.yaml").write_text(SCENE)
    made = []
    for seed, energy in enumerate(ENERGIES):
        made.append(folder / f"scan{seed}.h5")
        done = run(
            "simulate", folder / "scene.yaml", "--set", f"beam.energy_kev={energy}", "--seed", str(seed), "-o", made[-1]
        )
        assert done.exit_code == 0, done.output
    return made


def spectra(folder: Path, energies: tuple[float, ...] = ENERGIES) -> Path:
    oxide = known("NMC811")
    assert oxide is not None
    columns = [replace(oxide, state_of_charge=state).attenuation(energies) for state in (0.0, 1.0)]
    lines = ["energy_kev,fresh,charged"] + [",".join(map(str, line)) for line in zip(energies, *columns, strict=True)]
    path = folder / "spectra.csv"
    path.write_text("\n".join(lines))
    return path


def test_each_grain_is_in_the_volume_of_its_material(scans: list[Path], tmp_path: Path) -> None:
    words = "materials", *scans, "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5"
    done = run(*words, "--json")
    assert done.exit_code == 0, done.output
    assert "trials of weights" in done.output
    share = {}
    for material in GRAINS:
        with opened_volume(tmp_path / f"out_{material}.h5") as record:
            volume = record.volume
            y, x = (np.mgrid[:64, :64] - 31.5) * PITCH
            share[material] = {
                name: float(np.median(np.asarray(volume.data)[3][np.hypot(x - at[0], y - at[1]) < 0.006]))
                for name, at in GRAINS.items()
            }
            assert record.length_unit == "mm"
    for name, other in (("charged", "fresh"), ("fresh", "charged")):
        assert share[name][name] == pytest.approx(1, abs=0.15)
        assert share[other][name] < 0.15
    again = run(*words)
    assert "never overwritten" in again.output


def test_what_does_not_fit_leaves_nothing(scans: list[Path], tmp_path: Path) -> None:
    (tmp_path / "narrow").mkdir()
    narrow = spectra(tmp_path / "narrow", (8.34, 8.36))
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("kev,fresh\n8.3,1\n")
    for words, said in (
        ([*scans, "--spectra", narrow], "from 8.34 to 8.36 keV"),
        ([scans[0], "--spectra", spectra(tmp_path)], "do not tell 2 materials apart"),
        ([*scans, "--spectra", wrong], "no table of spectra"),
        ([*scans, "--spectra", tmp_path / "absent.csv"], "no table of spectra"),
    ):
        done = run("materials", *words, "-o", tmp_path / "out.h5", "--axis", "31.5")
        assert done.exit_code != 0
        assert said in done.output
    assert not list(tmp_path.glob("out*"))


def test_scans_whose_exposures_turn_by_unlike_arcs_do_not_mix(scans: list[Path], tmp_path: Path) -> None:
    unlike = [
        (SourceOptions(path), Selection(axis_col=31.5, steps=(Width(arc=arc),)))
        for path, arc in zip(scans, ("0.5", "0.502", "1", "1"), strict=True)
    ]
    with pytest.raises(ConfigError, match=r"turns 0.5° and 0° a row in an exposure of scan 1, and 1° .* of scan 3"):
        reconstruct_materials(
            unlike, read_spectra(spectra(tmp_path)), tmp_path / "out.h5", lambda event: None, SystemClock(),
            lambda stage: lambda done, of: None, StopOnSignal(ready=False),
        )  # fmt: skip
    assert not list(tmp_path.glob("out*"))
