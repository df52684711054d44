"""`beamline materials`: charged and fresh grains from simulated scans around an edge; no half output."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from beamline import api
from beamline.core.errors import DataError
from beamline.core.events import Sink
from beamline.energies import read_spectra
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.job import progress_events
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.reconstruct.region import Region
from beamline.storage.volumes.files import opened_volume
from drivers.base.clock import Clock, SystemClock
from recon.base.method import Progress
from recon.base.ray_width import RayWidth
from recon.features.joint import spectral
from simulators.samples.materials.materials import known
from tests.beamline.cli.small_scan import beamline

pytest.importorskip("xraylib")
TRIED = spectral.weights_by_views
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
            assert "ended_early" not in record.parameters
    for name, other in (("charged", "fresh"), ("fresh", "charged")):
        assert share[name][name] == pytest.approx(1, abs=0.15)
        assert share[other][name] < 0.15
    page = (made / "out.html").read_text(encoding="utf-8")
    assert "Slices of each material" in page and "2 materials, fresh, charged, of 4 × 64 × 64 voxels" in page
    again = beamline("materials", *scans, "--spectra", spectra(made), "-o", made / "out.h5")
    assert "never overwritten" in again.output


def test_a_script_gets_the_volumes_that_the_command_writes(scans: list[Path], made: Path, tmp_path: Path) -> None:
    source, wanted = api.energy_scans(scans, spectra(tmp_path)), api.Selection(axis_col=31.5)
    held = api.reconstruct(source, selection=wanted, say=None)
    kept = api.reconstruct(source, selection=wanted, output=tmp_path / "kept.h5", say=None)
    assert kept.series is not None and held.series is not None and held.series.names == ("fresh", "charged")
    assert (held.output, held.outputs) == (None, {}) and list(kept.outputs) == ["fresh", "charged"]
    np.testing.assert_array_equal(kept.series.data, held.series.data)
    np.testing.assert_array_equal(kept.series.data[1], held.series.data[1])
    for n, name in enumerate(held.series.names):
        with opened_volume(made / f"out_{name}.h5") as record:
            np.testing.assert_array_equal(held.series.data[n], record.volume.data[:])
            assert record.metrics == pytest.approx(held.metrics | {"seconds": record.metrics["seconds"]})
    for given, method, said in (
        (scans[0], recon.EnergySeries(), "takes scans at several energies"),
        (source, "fbp", "takes one scan"),
        (source, recon.EnergySeries(("a", "b")), "materials is of a, b"),
    ):
        with pytest.raises(api.ConfigError, match=said):
            api.reconstruct(given, method, say=None)
    target, method = OutputPaths(tmp_path / "box.h5", None), recon.EnergySeries(held.series.names)
    boxed = ReconOptions(source, target, wanted, method, region=Region((0, 1), (0, 9), (0, 9)))
    with pytest.raises(api.ConfigError, match="region: for a method of one volume"):
        reconstruct_file(boxed, lambda event: None, SystemClock())


def test_states_of_one_material_keep_their_sum(scans: list[Path], made: Path, tmp_path: Path) -> None:
    words = "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5", "--states", "fresh, charged"
    done = beamline("materials", *scans, *words)
    assert done.exit_code == 0, done.output
    found = {}
    for name, folder, states in (("plain", made, None), ("smooth", tmp_path, "fresh,charged")):
        for material in GRAINS:
            with opened_volume(folder / f"out_{material}.h5") as record:
                found[name, material] = np.asarray(record.volume.data)
                assert record.parameters.get("states") == states
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
    assert refused.exit_code == 2 and "expected two of the materials fresh, charged" in refused.output
    assert not list(tmp_path.glob("no*"))


def test_what_does_not_fit_leaves_nothing(scans: list[Path], tmp_path: Path) -> None:
    (tmp_path / "narrow").mkdir()
    narrow = spectra(tmp_path / "narrow", (8.34, 8.36))
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("kev,fresh\n8.3,1\n")
    for words, said in (
        ([*scans, "--spectra", narrow], "from 8.34 to 8.36 keV"),
        ([scans[0], "--spectra", spectra(tmp_path)], "cannot distinguish 2 materials"),
        ([*scans, "--spectra", wrong], "no table of spectra"),
        ([*scans, "--spectra", tmp_path / "absent.csv"], "no table of spectra"),
    ):
        for dry in ([], ["--dry-run"]):
            done = beamline("materials", *words, "-o", tmp_path / "out.h5", "--axis", "31.5", *dry)
            assert done.exit_code != 0
            assert said in done.output
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("energy_kev,a,A\n8.3,1,2\n8.4,2,1\n", "more than capitals"),
        ('energy_kev,"a\nb"\n8.3,1\n8.4,2\n', "parts of file names"),
        ("energy_kev,a\0b\n8.3,1\n8.4,2\n", "parts of file names"),
        ("energy_kev," + 200_000 * "a" + "\n8.3,1\n8.4,2\n", "field larger than"),
        ("energy_kev,a,b\n8.3,1,2\n8.4,1\n", "'8.4,1' are not 3 numbers"),
        ("\n", "no table of spectra"),
        ("energy_kev,a,b\n8.3,0,0\n8.4,0,0\n", "cannot distinguish 2 materials"),
    ],
)
def test_a_hostile_table_is_refused(scans: list[Path], tmp_path: Path, table: str, said: str) -> None:
    (tmp_path / "table.csv").write_text(table, newline="")
    done = beamline(
        "materials", *scans[:2], "--spectra", tmp_path / "table.csv", "-o", tmp_path / "out.h5", "--axis", "31.5"
    )
    assert done.exit_code in (2, 5), done.output
    assert said in done.output
    assert not list(tmp_path.glob("out*"))


def test_a_line_of_blanks_in_the_table_is_no_line(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("\ufeffenergy_kev,a\r\n8.4,2\r\n  \r\n8.3,1\r\n\r\n", encoding="utf-8")
    assert list(read_spectra(tmp_path / "table.csv").at(8.35)) == pytest.approx([1.5])


@pytest.mark.parametrize(("larger", "code"), [pytest.param(1.04, 0, marks=pytest.mark.slow), (1.2, 2)])
def test_a_scan_of_larger_pixels_is_interpolated_to_those_of_the_first(
    scans: list[Path], made: Path, tmp_path: Path, larger: float, code: int
) -> None:
    """Edges of the grains lie up to 0.8 pixels elsewhere in its views; the volumes are those of equal pixels."""
    other = tmp_path / "larger.h5"
    words = "--set", f"beam.energy_kev={ENERGIES[2]}", "--seed", "2", "-o", other
    pixels = f"detector.pixel_size_um={2.2 * larger}"
    assert beamline("simulate", scans[0].with_name("scene.yaml"), *words, "--set", pixels).exit_code == 0
    words = "--spectra", spectra(tmp_path), "--axis", "31.5"
    done = beamline("materials", *scans[:2], other, scans[3], *words, "-o", tmp_path / "out.h5")
    assert done.exit_code == code, done.output
    if code:
        assert "The scans do not fit together" in done.output and not list(tmp_path.glob("out*"))
        return
    volumes = []
    for folder in (tmp_path, made):
        with opened_volume(folder / "out_charged.h5") as record:
            volumes.append(np.asarray(record.volume.data[2]))
    assert np.abs(volumes[0] - volumes[1]).max() < 0.25
    assert np.sqrt(np.mean((volumes[0] - volumes[1]) ** 2)) < 0.02


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with a name are of POSIX")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(DataError, match="a regular file is expected"):
        read_spectra(tmp_path / "pipe.csv")


@pytest.mark.parametrize("name", ["", "out.tif", "out"])
def test_an_output_of_another_format_is_refused(scans: list[Path], tmp_path: Path, name: str) -> None:
    done = beamline("materials", *scans, "--spectra", spectra(tmp_path), "-o", tmp_path / name if name else "")
    assert done.exit_code == 2
    assert "ends in .h5" in done.output
    assert not list(tmp_path.glob("out*"))


def test_too_little_memory_is_said_before_a_scan_is_corrected(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beamline.energies.prepare_projections", None)
    words = "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5", "--memory", "1M"
    for more in ((), ("--dry-run",)):
        done = beamline("materials", *scans, *words, *more)
        assert done.exit_code == 2
        assert "Volumes of materials are not made in slabs: give --rows with 2 rows or fewer" in done.output
    assert not list(tmp_path.glob("out*"))


def test_ctrl_c_while_weights_are_tried_ends_with_the_volumes_so_far(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int] = []
    monkeypatch.setattr(spectral, "weights_by_views", TRIED)

    def interrupted(sink: Sink, clock: Clock, seconds: float | None) -> Callable[[Progress], None]:
        told = progress_events(sink, clock, seconds)

        def heard(progress: Progress) -> None:
            told(progress)
            if progress.unit:  # of a trial
                shown.append(progress.step)
                if progress.step == 3:
                    signal.raise_signal(signal.SIGINT)

        return heard

    monkeypatch.setattr("beamline.reconstruct.job.progress_events", interrupted)
    done = beamline("materials", *scans, "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5")
    assert done.exit_code == 4, done.output
    assert shown == [1, 2, 3]
    for material in GRAINS:
        with opened_volume(tmp_path / f"out_{material}.h5") as record:
            assert record.parameters["ended_early"]


@pytest.mark.parametrize(("arc", "code"), [(0.2, 2), (0.1001, 0)])
def test_scans_whose_sample_turned_by_other_arcs_do_not_fit(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arc: float, code: int
) -> None:
    made: list[PreparedProjections] = []

    def prepared(*args: Any, **more: Any) -> PreparedProjections:
        part = prepare_projections(*args, **more)
        made.append(replace(part, geometry=part.geometry.seen_with(RayWidth(arc=arc if made else 0.1))))
        return made[-1]

    monkeypatch.setattr("beamline.energies.prepare_projections", prepared)
    words = "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5", "--rows", "0:1"
    done = beamline("materials", *scans[:2], *words)
    assert done.exit_code == code, done.output
    assert ("Give an --exposure-arc that holds for all" in " ".join(done.output.split())) == (code == 2)


def test_a_source_within_the_field_is_refused(scans: list[Path], tmp_path: Path) -> None:
    words = "--spectra", spectra(tmp_path), "-o", tmp_path / "out.h5", "--axis", "31.5", "--cone", "0.01:0.02"
    done = beamline("materials", *scans[:2], *words)
    assert done.exit_code == 5, done.output
    assert "the box reaches" in done.output
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
