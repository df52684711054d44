"""`beamline structure`: files, numbers, explanations of intervals, two states, errors."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from can_of_balls import BALLS, MATRIX, can
from scipy import ndimage

from splatline_structure import command, measuring, pictures, volumes
from tests.beamline.cli.small_scan import beamline, left

VOXEL_UM = ("--voxel-um", "10")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "can.npy", can())
    return tmp_path


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest."""
    monkeypatch.setattr(pictures, "pictures_of", lambda *_: [])
    monkeypatch.setattr(pictures, "curves_of", lambda *_: b"")


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.usefixtures("real_pictures")
def test_a_volume_gets_a_folder_of_numbers_particles_labels_and_a_page(here: Path) -> None:
    result = beamline("structure", "can.npy", *VOXEL_UM, "--quick", "--side", "16", "--json")
    assert result.exit_code == 0, result.output
    files = {"report.html", "numbers.csv", "structure.json", "particles.csv", "materials.h5", "particles.h5"}
    assert left(here) == {"can.npy", "can_structure"} and left(here / "can_structure") == files
    done = json.loads(result.stdout.splitlines()[-1])
    facts = json.loads((here / "can_structure/structure.json").read_text(encoding="utf-8"))
    assert done["event"] == "done" and facts["particles"] == done["particles"] == len(BALLS) - 1
    rows = {row["number"]: row for row in _rows(here / "can_structure/numbers.csv")}
    size = rows["size_50"]
    assert float(size["low"]) < float(size["value"]) < float(size["high"]) and size["unit"] == "µm"
    assert size["decides"] == "more whole particles (a larger field of view) would narrow the interval"  # of six balls
    assert rows["fraction_2"]["decides"] in (
        "the threshold sets the width of the interval; more projections would not help",
        "the voxel size sets the width of the interval; more projections would not help",
    )
    assert facts["numbers"]["fraction_2"]["value"] == pytest.approx(float(rows["fraction_2"]["value"]), rel=1e-3)
    particles = _rows(here / "can_structure/particles.csv")
    volumes = [float(row["volume_um3"]) for row in particles]
    assert volumes == sorted(volumes, reverse=True)
    assert {row["contacts"] for row in particles} == {"0", "1"}
    with h5py.File(here / "can_structure/particles.h5") as file:
        labels = file["entry/data/labels"][:]
        assert np.unique(labels).tolist() == list(range(len(BALLS)))
        assert labels.dtype.kind == "i"
        for row in particles:
            place = [
                int(np.abs(1e3 * file[f"entry/data/{axis}"][:] - float(row[f"{axis}_um"])).argmin()) for axis in "zyx"
            ]
            assert labels[tuple(place)] == int(row["label"])
            assert np.count_nonzero(labels == int(row["label"])) == round(float(row["volume_um3"]) / 1000)
    page = (here / "can_structure/report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png") == 4 and "Numbers" in page


@pytest.mark.usefixtures("undrawn")
def test_halves_of_the_views_are_part_of_the_interval(here: Path) -> None:
    rng = np.random.default_rng(1)
    for name in ("a.npy", "b.npy"):
        noise = ndimage.gaussian_filter(rng.normal(size=can().shape), 1) * 1.5
        np.save(here / name, (ndimage.gaussian_filter(can(), 0.7) + noise).astype(np.float32))
    common = ("structure", "can.npy", *VOXEL_UM, "--side", "0")
    assert beamline(*common, "--quick", "-o", "quick").exit_code == 0
    result = beamline(*common, "--parts", "a.npy", "b.npy", "-o", "parts")
    assert result.exit_code == 0, result.output
    quick, parts = ({row["number"]: row for row in _rows(here / name / "numbers.csv")} for name in ("quick", "parts"))
    assert quick["surface"]["views"] == "" and float(parts["surface"]["views"]) > 0
    assert quick["surface"]["value"] == parts["surface"]["value"]
    width = {
        name: float(row["surface"]["high"]) - float(row["surface"]["low"]) for name, row in (("q", quick), ("p", parts))
    }
    assert width["p"] > width["q"]


@pytest.mark.usefixtures("undrawn")
def test_two_states_are_told_apart_or_not(here: Path) -> None:
    grown = np.maximum(can(), np.roll(can(), 3, axis=0))
    np.save(here / "grown.npy", grown.astype(np.float32))
    common = (*VOXEL_UM, "--quick", "--side", "0", "--compare")
    result = beamline("structure", "can.npy", "grown.npy", *common, "-o", "c")
    assert result.exit_code == 0, result.output
    rows = {row["number"]: row for row in _rows(here / "c/numbers.csv")}
    assert float(rows["fraction_2"]["low"]) > 0
    same = beamline("structure", "can.npy", "can.npy", *common, "-o", "d")
    assert same.exit_code == 0
    assert {row["decides"] for row in _rows(here / "d/numbers.csv") if row["value"] == "not determined"} >= {
        "the change is smaller than its uncertainty"
    }
    assert len(json.loads((here / "d/structure.json").read_text(encoding="utf-8"))["states"]) == 2


@pytest.mark.usefixtures("undrawn")
def test_of_two_states_both_boxes_are_given(here: Path) -> None:
    np.save(here / "short.npy", can()[12:28])
    common = ("structure", "can.npy", "short.npy", *VOXEL_UM, "--quick", "--side", "0", "--compare")
    result = beamline(*common, "-o", "c")
    assert result.exit_code == 0, result.output
    rows = _rows(here / "c/numbers.csv")
    slices = [[box.split(",")[0] for box in row["box"].split(" and ")] for row in rows]
    assert slices == [["0:40", "0:16"]] * len(rows)


@pytest.mark.parametrize("options", [("--compare",), ()])
def test_several_volumes_of_which_memory_does_not_hold_one_are_refused_before_any_is_measured(
    here: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...]
) -> None:
    """Else other slices of the one would be compared with those of the other."""
    np.save(here / "short.npy", can()[12:28])
    before = left(here)
    monkeypatch.setattr(measuring, "measured", None)
    result = beamline("structure", "short.npy", "can.npy", *VOXEL_UM, *options, "--memory", "13.3M")
    assert result.exit_code == 5
    assert (
        "can.npy: not enough memory. 40 slices of 72 x 72 voxels need 22.2 MB, and 13.3 MB are allowed for each of "
        "several volumes. Free memory, give more --memory, fewer --slices, or measure a part" in result.stderr
    )
    result = beamline("structure", "can.npy", "can.npy", *VOXEL_UM, *options, "--memory", "13.3M", "--crop", "none")
    assert "fewer --slices, --crop square, or" in result.stderr and left(here) == before


@pytest.mark.usefixtures("undrawn")
def test_several_volumes_are_measured_in_the_memory_that_is_free_at_the_beginning(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter([10**9])
    monkeypatch.setattr("beamline.core.machine.free_memory", lambda: next(free))
    result = beamline("structure", "can.npy", "can.npy", *VOXEL_UM, "--quick", "--side", "0")
    assert result.exit_code == 0, result.output


def test_without_contrast_in_the_middle_these_slices_are_named(here: Path) -> None:
    volume = can()
    volume[10:30] = np.random.default_rng(0).normal(1, 0.1, volume[10:30].shape)
    np.save(here / "can.npy", volume)
    common = ("structure", "can.npy", *VOXEL_UM, "--quick", "--crop", "none", "--memory", "16M")
    result = beamline(*common)
    words = "expected at most 1.5 times; only slices 14:26 fit into the memory and were measured: give more --memory"
    assert result.exit_code == 5 and words in result.stderr
    assert "views" not in result.stderr and "--materials" not in result.stderr
    assert "--slices, or give fewer --materials. Nothing" in beamline(*common, "--materials", "3").stderr


def test_halves_are_cut_to_the_slices_that_are_measured_or_hold_these_alone(here: Path) -> None:
    np.save(here / "middle.npy", can()[11:28])
    read = volumes.read_volume(Path("can.npy"), None, (10, 10, 10), (11, 28), 10**9, "square")
    halves = measuring.halves_in(Path("can.npy"), read, None, quick=False, parts=(Path("can.npy"), Path("middle.npy")))
    for half in halves:
        np.testing.assert_array_equal(half, can()[11:28])


@pytest.mark.usefixtures("undrawn")
def test_labels_are_a_tiff_of_bytes(here: Path) -> None:
    assert beamline("structure", "can.npy", *VOXEL_UM, "--quick", "--side", "0", "--labels", "tif").exit_code == 0
    labels = tifffile.imread(here / "can_structure/particles.tif")
    assert labels.dtype == np.uint8 and labels.max() == len(BALLS) - 1
    assert np.unique(tifffile.imread(here / "can_structure/materials.tif")).tolist() == [1, 2]


@pytest.mark.usefixtures("undrawn")
def test_few_photons_determine_nothing(here: Path) -> None:
    rng = np.random.default_rng(0)
    blobs = ndimage.gaussian_filter(rng.normal(size=(24, 40, 40)), 3) > 0
    np.save(here / "noisy.npy", (blobs + rng.normal(0, 0.33, blobs.shape)).astype(np.float32))
    result = beamline("structure", "noisy.npy", *VOXEL_UM, "--quick", "--side", "0", "--crop", "none")
    assert result.exit_code == 0, result.output
    assert "not determined" in result.stdout and "could be of either material" in result.stdout


@pytest.mark.usefixtures("undrawn")
def test_of_a_volume_larger_than_the_memory_the_middle_is_looked_at_and_all_for_fractions(here: Path) -> None:
    volume = can()
    volume[30:] = np.minimum(volume[30:], MATRIX + 0.1)  # the upper slices hold less than the middle
    np.save(here / "can.npy", volume)
    np.save(here / "half.npy", volume[::-1])
    common = ("structure", "can.npy", *VOXEL_UM, "--side", "0", "--parts", "half.npy", "half.npy")
    result = beamline(*common, "--memory", "13.3M", "-o", "part")
    assert result.exit_code == 0, result.output
    words = (
        "Only 17 of 40 slices fit into 13.3 MB of memory, so the numbers are measured in the middle, in the slices "
        "11:28"
    )
    assert words in result.stderr and words in result.stdout
    assert words in (here / "part/report.html").read_text(encoding="utf-8")
    rows = {row["number"]: row for row in _rows(here / "part/numbers.csv")}
    assert {row["box"].split(",")[0] for name, row in rows.items() if name.endswith("_all")} == {"0:40"}
    assert {row["box"].split(",")[0] for name, row in rows.items() if not name.endswith("_all")} == {"11:28"}
    facts = json.loads((here / "part/structure.json").read_text(encoding="utf-8"))
    y, x = (slice(*map(int, part.split(":"))) for part in facts["box"].split(",")[1:])
    dense = volume[:, y, x] > np.mean(facts["levels"])
    numbers = facts["numbers"]
    assert words in facts["limit"] and facts["box"][:6] == "11:28," and facts["box_of_all"][:5] == "0:40,"
    assert numbers["fraction_2"]["value"] == pytest.approx(dense[11:28].mean())
    assert numbers["fraction_2_all"]["value"] == pytest.approx(dense.mean())
    for name in ("fraction_1", "fraction_2", "surface"):
        one, each = numbers[f"{name}_all"], numbers[name]
        assert one["high"] - one["low"] == pytest.approx(each["high"] - each["low"])
    with h5py.File(here / "part/particles.h5") as file:
        assert file["entry/data/labels"].shape[0] == 17
        assert file["entry/data/z"][0] == pytest.approx(0.01 * (11 - 39 / 2))


@pytest.mark.slow
def test_memory_stays_within_what_was_given(tmp_path: Path) -> None:
    """In a process of its own, beyond what it takes with a small volume."""
    lines = """
import sys
import numpy as np
from scipy import ndimage
from click.testing import CliRunner
from beamline.cli.main import main
from beamline.core.machine import peak_memory
rng, peaks = np.random.default_rng(0), []
for n, memory in ((16, "1G"), (120, "30M")):
    small = ndimage.gaussian_filter(rng.normal(size=(n, 48, 48)), 3)
    np.save("v.npy", (small > 0).astype(np.float32) + rng.normal(0, 0.05, small.shape).astype(np.float32))
    np.save("h.npy", np.load("v.npy"))
    del small
    words = "structure", "v.npy", "--voxel-um", "1", "--crop", "none", "--side", "0", "--memory", memory, "-o", f"o{n}"
    result = CliRunner().invoke(main, [*words, "--parts", "h.npy", "h.npy"])
    assert result.exit_code == 0, result.output
    peaks.append(peak_memory())
assert "Only 78 of 120 slices fit into 30 MB" in result.output
print(peaks[1] - peaks[0])
"""
    ran = subprocess.run([sys.executable, "-c", lines], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert 0 < int(ran.stdout) < 30e6


REFUSED = [
    (("even.npy", *VOXEL_UM), 5, "even.npy cannot be measured"),
    (
        ("noise.npy", *VOXEL_UM),
        5,
        "near the rarer grey level; expected at most 1.5 times; reconstruct from more projections. Nothing",
    ),
    (("can.npy",), 5, "does not state the voxel size. Nothing was written"),
    (("can.npy", "--voxel-um", "nan"), 2, "expected the edge of a voxel in µm"),
    (("can.npy", "--voxel-um", "3:2:1"), 2, "pixels of a slice must be squares"),
    (("labels.npy", *VOXEL_UM, "--materials", "2"), 5, "so they are labels and not grey values"),
    (("big.npz", *VOXEL_UM, "--memory", "10K"), 5, "The unpacked volume has 830 kB, and 10 kB are allowed"),
    (("holes.npy", *VOXEL_UM), 5, "holes.npy are not finite"),
    (("small.npy", *VOXEL_UM), 5, "expected 8 or more along each side"),
    (("can.npy", *VOXEL_UM, "--slices", "3", "99"), 5, "has slices 0 to 40"),
    (("can.npy", *VOXEL_UM, "--memory", "4M"), 5, "8 slices of 72 x 72 voxels need 9.75 MB, and 4 MB are allowed"),
    (("can.npy", *VOXEL_UM, "--memory", "some"), 2, "'some' is not a size"),
    (("can.npy", *VOXEL_UM, "--memory", "0.0001K"), 5, "and 0 B are allowed"),
    (("can.npy", *VOXEL_UM, "--memory", "4M"), 5, "(`recon --roi`, then --parts or --quick)"),
    (("can.npy", *VOXEL_UM, "--scan", "nosuch.h5"), 2, "'nosuch.h5' does not exist"),
    (("can.npy", *VOXEL_UM, "--particles", "3"), 2, "There is no material 3"),
    (("can.npy", *VOXEL_UM, "--compare"), 2, "--compare needs two volumes"),
    (("can.npy", "can.npy", *VOXEL_UM, "--parts", "can.npy", "can.npy"), 2, "--parts needs exactly one volume"),
    (
        ("can.npy", *VOXEL_UM, "--parts", "small.npy", "small.npy"),
        5,
        "half of the projections has the shape (4, 12, 12), not (40, 72, 72): give --parts with volumes of the "
        "same shape as the volume itself, or",
    ),
]


@pytest.mark.parametrize(("arguments", "code", "words"), REFUSED)
def test_what_has_no_numbers_is_refused_and_nothing_is_written(
    here: Path, arguments: tuple[str, ...], code: int, words: str
) -> None:
    np.save(here / "labels.npy", np.arange(4000).reshape(10, 20, 20) % 3)
    np.savez_compressed(here / "big.npz", volume=np.zeros((40, 72, 72), np.float32))
    np.save(here / "even.npy", np.ones((10, 12, 12), np.float32))
    np.save(here / "noise.npy", np.random.default_rng(0).normal(1, 0.1, (20, 30, 30)).astype(np.float32))
    np.save(here / "holes.npy", np.where(can() > 1, np.nan, can()))
    np.save(here / "small.npy", np.ones((4, 12, 12), np.float32))
    before = left(here)
    result = beamline("structure", *arguments)
    assert result.exit_code == code and words in result.stderr + str(result.exception), result.output
    assert left(here) == before


@pytest.mark.usefixtures("undrawn")
def test_a_particle_larger_than_the_field_and_no_path_are_words(here: Path) -> None:
    z = np.indices((30, 30, 30))[0]
    volume = np.where(np.abs(z - 15) < 6, 1.0, 0.0) + np.random.default_rng(0).normal(0, 0.02, (30, 30, 30))
    np.save(here / "plate.npy", volume.astype(np.float32))
    result = beamline("structure", "plate.npy", *VOXEL_UM, "--quick", "--crop", "none", "--side", "20")
    assert result.exit_code == 0, result.output
    assert (
        "no particle is completely in the measured box" in result.stdout
        and "nothing connects the two faces within the material" in result.stdout
    )


@pytest.mark.usefixtures("undrawn")
def test_labels_edges_and_options_are_said_back(here: Path) -> None:
    np.savez(here / "three.npz", labels=np.floor(can() * 0.9).clip(0, 1).astype(np.uint8), voxel_mm=0.01, slice_mm=0.03)
    words = ("structure", "three.npz", "--voxel-um", "10", "--quick", "--crop", "none", "--side", "1", "-o", "o")
    result = beamline(*words)
    assert result.exit_code == 0, result.output
    assert "states voxels with edges (z, y, x) of 30 x 10 x 10 µm" in result.stderr and "used: 10 x 10" in result.stderr
    assert "read as labels and not as grey values: 0 is material 1, 1 is material 2." in result.stderr
    settings = json.loads((here / "o/structure.json").read_text(encoding="utf-8"))
    assert " ".join(words) in json.dumps(settings)


def test_the_former_name_says_what_to_use(here: Path) -> None:
    result = beamline("segment", "can.npy")
    assert result.exit_code == 2
    assert (
        "no command 'segment', which was removed: use `beamline structure VOLUME` instead (pip install "
        "splatline-structure)." in result.stderr
    )


def test_a_scan_that_is_not_there_is_a_warning(here: Path, undrawn: None) -> None:
    result = beamline("structure", "can.npy", *VOXEL_UM, "--side", "0")
    assert result.exit_code == 0 and "because the scan of the volume (" in result.stderr
    assert command.structure.name == "structure"
