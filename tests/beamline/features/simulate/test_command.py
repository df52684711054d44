"""`beamline simulate`: files, labels, ground truth, and the resources it needs."""

from __future__ import annotations

import json
import math
import re
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.installed import shipped_scenes
from beamline.features.simulate import command as module
from beamline.features.simulate import write
from beamline.features.simulate.write import write_scan
from beamline.projections.corrections.width import Width
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.scenes.scene_file import open_scene
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.devices.clock import VirtualClock
from simulators.effects.catalogue import CATALOGUE
from simulators.frame.shot import CannotExposeError
from simulators.scenes.expose import Scan, expose
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.simulate.read_labels import read_labels

SCENE = """
phantom:
  kind: solids
  solids:
    - {kind: ellipsoid, semi_axes: [0.1, 0.08, 0.12], attenuation: 4.0, centre: [0.05, 0.02, 0.03]}
    - {kind: cylinder, radius: 0.05, height: 0.2, attenuation: 2.0, centre: [-0.15, 0.0, 0.0]}
beam: {photons_per_s: 1.0e+5}
axis_offset_px: 1.5
detector: {shape: [32, 40], pixel_size_um: 12.0, exposure_s: 0.02}
scan: {views: 12, darks: 2, flats: 2}
effects: [photon_noise, read_noise, offset]
"""

HUGE = ("--frames", "1000000", "--set", "detector.shape=[2304,4096]", "--set", "effects=[]")
BAND = "{kind: black_band, width: 0.1, penumbra: 0.01}"
FRINGES = "{kind: phase_fringes, delta_beta: 3000, distance: 1, energy: 20}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(SCENE, encoding="utf-8")
    return tmp_path


def test_a_simulated_scan_is_a_scan(folder: Path) -> None:
    result = beamline("simulate", "scene.yaml", "--out", "scan.h5", "--frames", "6", "--seed", "4")
    assert result.exit_code == 0, result.output
    assert "10 frames" in result.stdout
    assert "no anomaly" in result.stdout
    assert Path("scan.png").read_bytes().startswith(b"\x89PNG")
    assert read_labels(Path("scan.labels.json")) == ()
    with open_scan("scan.h5") as source:
        kinds = [FrameKind.DARK] * 2 + [FrameKind.FLAT] * 2 + [FrameKind.PROJECTION] * 6
        assert source.table.kinds.tolist() == kinds
        np.testing.assert_allclose(np.degrees(source.table.angles[4:]), np.arange(6) * 30.0)
        assert source.axis_col == 19.5 + 1.5
        assert source.pixel_size_mm == pytest.approx(0.012)
        frames = source.read(slice(None)).astype(float)
    assert frames[:2].mean() == pytest.approx(200, abs=1)
    assert frames[2:4].mean() == pytest.approx(200 + 2000 / 0.107, rel=0.01)
    assert beamline("validate", "scan.h5").exit_code == 0
    again = beamline("simulate", "scene.yaml", "--out", "again.h5", "--frames", "6", "--seed", "4")
    assert again.exit_code == 0
    with open_scan("again.h5") as source:
        np.testing.assert_array_equal(source.read(slice(None)), frames)


def test_truth_stands_on_the_grid_of_the_reconstruction(folder: Path) -> None:
    result = beamline("simulate", "scene.yaml", "--truth", "truth.h5", "--truth-bin", "2")
    assert result.exit_code == 0, result.output
    grid = Grid.matching(Geometry.parallel([0.0], (32, 40), pixel_pitch=0.012, axis_col=21.0).binned(2))
    with h5py.File("truth.h5") as file:
        data, labels = file["entry/data/data"][...], file["entry/data/labels"][...]
        assert file["entry/data/labels"].attrs["names"].tolist() == ["air", "ellipsoid", "cylinder"]
        for name, centres in zip(("z", "y", "x"), grid.coordinates(), strict=True):
            np.testing.assert_allclose(file[f"entry/data/{name}"], centres)
    assert data.shape == labels.shape == grid.shape
    # What the voxels hold is what the solids hold: 4/3 π a b c and π r² h.
    masses = 4 / 3 * np.pi * 0.1 * 0.08 * 0.12 * 4.0, np.pi * 0.05**2 * 0.2 * 2.0
    assert data.sum(dtype=float) * grid.voxel_size**3 == pytest.approx(sum(masses), rel=0.01)
    assert (labels == 1).sum() * grid.voxel_size**3 == pytest.approx(masses[0] / 4.0, rel=0.03)


def test_explain_says_what_runs_and_what_does_not(folder: Path) -> None:
    result = beamline("simulate", "scene.yaml", "--explain")
    assert result.exit_code == 0, result.output
    head, tail = result.stdout.split("Effects that the scene does not use")
    lines = [line.split()[0] for line in head.splitlines() if line]
    steps = ["line_integrals", "beer_lambert", "photon_noise", "read_noise", "offset", "digitise"]
    assert [line for line in lines if line in steps] == steps
    assert "rolling_shutter" in tail
    assert "photon_noise" not in tail
    said = json.loads(beamline("simulate", "scene.yaml", "--explain", "--json").stdout.splitlines()[0])
    assert said["event"] == "explain"
    assert [step["name"] for step in said["steps"]] == steps
    assert {name for name, _ in said["unused"]} == set(CATALOGUE) - set(steps)


def test_interrupted_the_file_holds_what_was_made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, made = expose, list[int]()

    def stopping(*arguments: object) -> object:
        made.append(1)
        if len(made) == 8:  # the first one showed that the scene can be exposed
            signal.raise_signal(signal.SIGINT)
        return real(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(write, "expose", stopping)
    result = beamline("simulate", "scene.yaml", "--out", "scan.h5")
    assert result.exit_code == 4
    assert "Stopping after this frame. Press Ctrl-C again to stop at once." in result.stderr
    assert "Stopped after 7 of 16 frames. scan.h5 has these frames and is readable." in result.stderr
    with open_scan("scan.h5") as source:
        assert len(source.table) == 7
        assert source.attributes["status"] == "stopped"
    assert json.loads(Path("scan.labels.json").read_text(encoding="utf-8"))["frames"] == 7


@pytest.mark.parametrize(
    ("ends", "code"), [(KeyboardInterrupt(), 130), (CannotExposeError("too bright"), 2), (OSError(28, "full"), 5)]
)
def test_ended_at_once_the_labels_tell_of_the_frames_that_are_there(
    folder: Path, monkeypatch: pytest.MonkeyPatch, ends: BaseException, code: int
) -> None:
    real, made = expose, list[int]()

    def ending(*arguments: object) -> object:
        made.append(1)
        if len(made) == 8:  # the first one showed that the scene can be exposed
            raise ends
        return real(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(write, "expose", ending)
    result = beamline("simulate", "scene.yaml", "--out", "scan.h5", "--json", "--set", f"effects=[{BAND}]")
    assert result.exit_code == code
    events = [json.loads(line)["event"] for line in result.stdout.splitlines()]
    assert (events[-1], events.count("failed"), "done" in events) == ("failed", 1, False)
    with open_scan("scan.h5") as source:
        assert (len(source.table), source.attributes["status"]) == (6, "failed")
    (run,) = read_labels(Path("scan.labels.json"))
    assert (run.kind, run.first, run.last) == ("black_band", 2, 5)


def test_a_scan_too_large_for_its_disk_or_memory_is_not_begun(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = left(folder)
    for arguments, code, words in (
        (("--out", "scan.h5", *HUGE), 5, r"scan.h5 needs 23\.4 TB for 1000004 frames, but its disk has .* free"),
        (
            ("--truth", "t.h5", "--truth-bin", "1"),
            2,
            r"larger --truth-bin: with 1, the ground truth needs 819 kB of memory, and 300 kB is",
        ),
    ):
        monkeypatch.setattr(module, "free_memory", lambda: 300_000)
        result = beamline("simulate", "scene.yaml", *arguments)
        assert result.exit_code == code
        assert re.search(words, result.stderr), result.stderr
        assert left(folder) == before
    assert beamline("simulate", "scene.yaml", "--truth", "t.h5", "--truth-bin", "2").exit_code == 0


def test_the_energy_of_the_beam_is_in_the_file(folder: Path) -> None:
    wanted = ("--frames", "1", "--set", "beam.energy_kev=20.5")
    assert beamline("simulate", "scene.yaml", "--out", "s.h5", *wanted).exit_code == 0
    with open_scan("s.h5") as source:
        assert source.energy_kev == 20.5


def test_a_coarser_truth_tells_the_bin_that_it_is_for(folder: Path) -> None:
    made = beamline("simulate", "scene.yaml", "--out", "s.h5", "--truth", "t.h5", "--truth-bin", "4")
    assert "voxels of 0.048 mm, as in volumes of `beamline recon --bin 4`" in made.stdout
    shape = "--truth has the shape (8, 10, 10), but the volume has (16, 20, 20) [z, y, x] with --bin 2. Give --bin 4."
    refused = beamline("recon", "s.h5", "-m", "fbp", "--axis", "21", "--bin", "2", "--truth", "t.h5", "-o", "r.h5")
    assert (refused.exit_code, shape in refused.stderr) == (2, True), refused.stderr


@pytest.mark.parametrize("name", [*shipped_scenes()])
def test_every_shipped_scene_can_be_simulated(folder: Path, name: str) -> None:
    result = beamline("simulate", name, "--frames", "1", "--picture", "p.png")
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("effects", [["motion_blur", "rolling_shutter"], []])
def test_a_simulated_file_says_what_its_frames_show(tmp_path: Path, effects: list[str]) -> None:
    sizes = ["detector.shape=[4, 16]", "scan.views=6", "scan.darks=1", "scan.flats=1", "phantom.n_particles=5"]
    scene = open_scene("fast_fly", [*sizes, f"effects={effects}"])
    scan = Scan.of(scene.scene)
    write_scan(scene, scan, tmp_path / "scan.h5", lambda _: None, VirtualClock(), lambda: False)
    with open_scan(tmp_path / "scan.h5") as source:
        selected = select(source, Selection())
        geometry = selected.selection.geometry(7.5, source.table.angles[2:])
        seen, done = Width(arc="auto").rays(selected, geometry)
        assert source.row_period == pytest.approx(scan.frame(0).shot.row_period if effects else 0)
    moved = math.radians(180) / 6 / scan.period * 0.012
    assert seen.width.arc == pytest.approx(moved if effects else 0)
    assert (done.sentence != "") == bool(effects)
