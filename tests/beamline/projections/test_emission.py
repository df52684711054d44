"""Emission from a scene to a volume by the commands: the same counts and the same bits as by the functions."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result

import recon
from beamline.cli.main import main
from beamline.core.errors import DataError
from beamline.projections.prepare import Spill, prepare_projections
from beamline.projections.selection import Selection
from beamline.storage.readers.open import open_scan
from simulators.scenes.emission import events, load_emission

SCENE = "emission: {radius: 24}\nscanner: {trues: 2.0e+5}\nlines: {views: 24, shape: [3, 32], pitch: 2.0}\n"


def _beamline(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


@pytest.fixture(scope="module")
def pet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of counts; its truth lies beside it."""
    folder = tmp_path_factory.mktemp("pet")
    (folder / "pet.yaml").write_text(SCENE, encoding="utf-8")
    made = _beamline("simulate", str(folder / "pet.yaml"), "-o", str(folder / "pet.h5"), "--truth",
                     str(folder / "truth.h5"), "--seed", "5")  # fmt: skip
    assert made.exit_code == 0, made.output
    return folder / "pet.h5"


def test_the_file_has_what_the_scene_made(pet: Path) -> None:
    scene = load_emission(
        {"emission": {"radius": 24}, "scanner": {"trues": 2e5}, "lines": {"views": 24, "shape": [3, 32], "pitch": 2}}
    )
    made = events(scene.emission, scene.lines.detector, scene.lines.angles, scene.scanner, 5)
    with open_scan(pet) as source:
        assert source.emission is not None and source.quantity == "line_integrals" and source.pixel_size_mm == 2
        np.testing.assert_allclose(source.angles, scene.lines.angles)
        found = source.emission(np.array([2, 7]), slice(1, 3))
        for values, expected in zip(found, (made.counts, made.survival, made.background), strict=True):
            np.testing.assert_allclose(values, expected[[2, 7], 1:3], rtol=1e-6)
        lines = source.read([2], slice(1, 3))
        np.testing.assert_allclose(
            lines[0], ((made.counts - made.background) / made.survival)[2, 1:3], rtol=1e-4, atol=1e-3
        )


def test_recon_reads_it_and_gives_what_the_function_gives(pet: Path, tmp_path: Path) -> None:
    out, truth = tmp_path / "osem.h5", str(pet.with_name("truth.h5"))
    done = _beamline("recon", str(pet), "-m", "osem", "--iterations", "3", "--truth", truth, "-o", str(out))
    assert done.exit_code == 0, done.output
    assert "Contrast recovery of hot regions" in done.output and "Noise of the body" in done.output
    with open_scan(pet) as source:
        assert source.emission is not None
        counted = source.emission(np.arange(24), slice(0, 3))
        geometry = recon.Geometry.parallel(source.angles, (3, 32), pixel_pitch=2.0)
    expected = recon.mlem(recon.Emission(counted.counts, geometry, counted.survival, counted.background),
                          recon.Grid.matching(geometry), 3, 10)  # fmt: skip
    with h5py.File(out) as file:
        np.testing.assert_array_equal(file["entry/data/data"][()], expected.data)


def test_other_methods_take_its_weighted_lines(pet: Path, tmp_path: Path) -> None:
    out = tmp_path / "cgls.h5"
    assert _beamline("recon", str(pet), "-m", "cgls", "--iterations", "4", "-o", str(out)).exit_code == 0
    with h5py.File(pet) as file, h5py.File(out) as made:
        sets = {name: item[()] for name, item in file["emission"].items()}
        survival = sets["normalisation"] * np.exp(-sets["attenuation"])
        geometry = recon.Geometry.parallel(np.radians(sets["angles"]), (3, 32), pixel_pitch=2.0)
        emission = recon.Emission(sets["counts"], geometry, survival, sets["randoms"] + sets["scatter"])
        expected = recon.reconstruct(emission, geometry, recon.Cgls(iterations=4)).volume.data
        np.testing.assert_allclose(made["entry/data/data"][()], expected, rtol=1e-3, atol=1e-3 * expected.max())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("--bin", "2"), "go with --bin"), (("--rings", "sort"), "go with the correction 'rings'"),
     (("--cols", "2:30"), "go with --cols"), (("--follow",), "do not grow")],
)  # fmt: skip
def test_what_counts_do_not_take_is_refused(pet: Path, tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    refused = _beamline("recon", str(pet), "-m", "r2", *arguments, "-o", str(tmp_path / "out.h5"))
    assert refused.exit_code in (2, 5) and said in refused.output, refused.output
    assert not list(tmp_path.iterdir())


def test_sets_of_another_shape_and_a_wrong_scene_are_refused(pet: Path, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "wrong.h5", "w") as file, h5py.File(pet) as right:
        right.copy("emission", file)
        del file["emission/randoms"]
        file["emission/randoms"] = np.zeros((3, 32))
    refused = _beamline("recon", str(tmp_path / "wrong.h5"))
    assert refused.exit_code == 5 and "randoms has shape (3, 32), the counts (24, 3, 32)" in refused.output
    for override, said in (
        ("emission.radius=-1", "emission.radius"),
        ("emission.radius=12", "leaves the body"),
        ("lines.pixels=3", "key 'pixels' is unknown"),
    ):
        refused = _beamline("simulate", str(pet.with_suffix(".yaml")), "-o", str(tmp_path / "x.h5"), "--set", override)
        assert refused.exit_code == 2 and said in refused.output, refused.output
    refused = _beamline("simulate", str(pet.with_suffix(".yaml")), "--explain")
    assert refused.exit_code == 2 and "takes no --explain" in refused.output


def test_counts_are_not_spilled(pet: Path) -> None:
    spill = Spill(np.zeros((24, 3, 32), np.float32), 4, lambda n, of: None)
    with open_scan(pet) as source, pytest.raises(DataError, match="have to be in memory"):
        prepare_projections(source, Selection(), print, spill)
