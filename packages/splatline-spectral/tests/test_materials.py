"""`beamline materials`: charged and fresh grains from simulated scans around an edge; no half-written output."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.volumes.files import opened_volume
from recon.features.joint import spectral
from simulators.samples.materials.materials import known
from splatline_spectral.materials import read_spectra
from tests.beamline.cli.small_scan import beamline

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
detector: {shape: [4, 64], pixel_size_um: 2.2, exposure_s: 0.05}
scan: {views: 24, darks: 2, flats: 8}
effects: [photon_noise]
"""


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("series")
    (folder / "scene.yaml").write_text(SCENE)
    made = []
    for seed, energy in enumerate(ENERGIES):
        made.append(folder / f"scan{seed}.h5")
        done = beamline(
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


@pytest.fixture(scope="module", autouse=True)
def weights_given() -> Iterator[None]:
    """Those that trials find, which take most of the time; tests/recon/features/joint/test_spectral.py has them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(spectral, "weights_by_views", lambda views, *_: np.full(views.cross_sections.shape[1], 4e-4))
        yield


@pytest.fixture(scope="module")
def made(scans: list[Path]) -> Path:
    """The folder of the volumes of all scans: out_charged.h5 and out_fresh.h5."""
    folder = scans[0].with_name("made")
    folder.mkdir()
    done = beamline("materials", *scans, "--spectra", spectra(folder), "-o", folder / "out.h5", "--axis", "31.5")
    assert done.exit_code == 0, done.output
    return folder


def test_each_grain_is_in_the_volume_of_its_material(scans: list[Path], made: Path) -> None:
    share = {}
    for material in GRAINS:
        with opened_volume(made / f"out_{material}.h5") as record:
            volume = record.volume
            y, x = (np.mgrid[:64, :64] - 31.5) * PITCH
            share[material] = {
                name: float(np.median(np.asarray(volume.data)[2][np.hypot(x - at[0], y - at[1]) < 0.006]))
                for name, at in GRAINS.items()
            }
            assert (record.length_unit, record.unit) == ("mm", "")  # a share has no unit
            assert record.raw_file == str(scans[0].resolve())
            assert record.parameters["scans"] == ", ".join(str(path.resolve()) for path in scans)
    for name, other in (("charged", "fresh"), ("fresh", "charged")):
        assert share[name][name] == pytest.approx(1, abs=0.15)
        assert share[other][name] < 0.15
    again = beamline("materials", *scans, "--spectra", spectra(made), "-o", made / "out.h5")
    assert "exists" in again.output


def test_states_of_one_material_keep_their_sum(scans: list[Path], made: Path, tmp_path: Path) -> None:
    words = "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5", "--states", "fresh,charged"
    done = beamline("materials", *scans, *words)
    assert done.exit_code == 0, done.output
    found = {}
    for name, folder in (("plain", made), ("smooth", tmp_path)):
        for material in GRAINS:
            with opened_volume(folder / f"out_{material}.h5") as record:
                found[name, material] = np.asarray(record.volume.data)
    plain, smooth = (sum(found[name, material] for material in GRAINS) for name in ("plain", "smooth"))
    np.testing.assert_allclose(plain, smooth, atol=1e-5)
    inside = smooth > 0.9
    share = {name: found[name, "charged"][inside] / smooth[inside] for name in ("plain", "smooth")}
    assert (
        np.abs(share["smooth"] - np.round(share["smooth"])).mean()
        < 0.5 * np.abs(share["plain"] - np.round(share["plain"])).mean()
    )
    refused = beamline(
        "materials", *scans, "--spectra", spectra(tmp_path), "-o", tmp_path / "no.h5", "--states", "fresh,other"
    )
    assert refused.exit_code == 2 and "expected two of fresh, charged" in refused.output
    assert not list(tmp_path.glob("no*"))


def test_what_does_not_fit_leaves_nothing(scans: list[Path], tmp_path: Path) -> None:
    (tmp_path / "narrow").mkdir()
    narrow = spectra(tmp_path / "narrow", (8.34, 8.36))
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("kev,fresh\n8.3,1\n")
    for words, said in (
        ([*scans, "--spectra", narrow], "expected 8.34 to 8.36 keV"),
        ([scans[0], "--spectra", spectra(tmp_path)], "cannot separate 2 materials"),
        ([*scans, "--spectra", wrong], "begins with 'kev,fresh'"),
        ([*scans, "--spectra", tmp_path / "absent.csv"], "cannot be read as a table of spectra"),
    ):
        done = beamline("materials", *words, "-o", tmp_path / "out.h5", "--axis", "31.5")
        assert done.exit_code in (2, 5) and said in done.output, done.output
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("energy_kev,a,A\n8.3,1,2\n8.4,2,1\n", "Each NAME may occur only once"),
        ('energy_kev,"a\nb"\n8.3,1\n8.4,2\n', "parts of file names"),
        ("energy_kev,a,b\n8.3,1,2\n8.4,1\n", "cannot be read as a table of spectra"),
        ("energy_kev,a\n8.3,1\n8.3,2\n", "energies must differ"),
        ("\n", "cannot be read as a table of spectra"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path: Path, table: str, said: str) -> None:
    (tmp_path / "table.csv").write_text(table, newline="")
    with pytest.raises(DataError, match=said):
        read_spectra(tmp_path / "table.csv")


def test_a_line_of_blanks_in_the_table_is_no_line(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("\ufeffenergy_kev,a\r\n8.4,2\r\n  \r\n8.3,1\r\n\r\n", encoding="utf-8")
    assert list(read_spectra(tmp_path / "table.csv").at(8.35, tmp_path)) == pytest.approx([1.5])


@pytest.mark.parametrize("larger", [1.04, 1.2])
def test_scans_of_other_pixels_do_not_fit(scans: list[Path], tmp_path: Path, larger: float) -> None:
    other = tmp_path / "larger.h5"
    words = "--set", f"beam.energy_kev={ENERGIES[2]}", "--seed", "2", "-o", other
    pixels = f"detector.pixel_size_um={2.2 * larger}"
    assert beamline("simulate", scans[0].with_name("scene.yaml"), *words, "--set", pixels).exit_code == 0
    words = "--spectra", spectra(tmp_path), "--axis", "31.5", *(["--register"] * (larger > 1.1))
    done = beamline("materials", *scans[:2], other, *words, "-o", tmp_path / "out.h5")
    assert done.exit_code == 2 and "Scan 3 does not fit scan 1" in done.output, done.output
    assert not list(tmp_path.glob("out*"))


@pytest.mark.slow
def test_a_sample_that_moved_between_the_scans_is_registered(scans: list[Path], tmp_path: Path) -> None:
    """By two pixels along x and one along y in the third scan."""
    text = SCENE
    for x, y in GRAINS.values():
        text = text.replace(f"centre: [{x}, {y}, 0.0]", f"centre: [{x + 2 * PITCH}, {y - PITCH}, 0.0]")
    (tmp_path / "scene.yaml").write_text(text)
    words = "--set", f"beam.energy_kev={ENERGIES[2]}", "--seed", "2", "-o", tmp_path / "moved.h5"
    assert beamline("simulate", tmp_path / "scene.yaml", *words).exit_code == 0
    words = "--spectra", spectra(tmp_path), "--axis", "31.5", "--register"
    done = beamline("materials", *scans[:2], tmp_path / "moved.h5", scans[3], *words, "-o", tmp_path / "out.h5")
    assert done.exit_code == 0, done.output
    with opened_volume(tmp_path / "out_charged.h5") as record:
        found = np.asarray(record.parameters["displacements"])[:, :3] / PITCH
    assert found[:, :2] == pytest.approx(np.array([[0, 0], [0, 0], [2, -1], [0, 0]]), abs=0.15)
    assert f"{1e3 * found[2, 0] * PITCH:+.2f}, " in done.stdout and "µm along x, y, z" in done.stdout
