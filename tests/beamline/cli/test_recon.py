"""`beamline recon`: options, output on the terminal, and files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers.recon_file import read_reconstruction
from tests.beamline.cli.small_scan import SCAN, beamline, left, succeeds
from tests.beamline.scans import write_exchange
from tests.recon.prep.ring_score import ring_score
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")


def test_defaults_and_results(folder: Path) -> None:
    result = succeeds("recon", "scan.h5", "-m", "fbp")
    assert left(folder) == {"scan.h5", "scan_fbp.h5", "scan_fbp.html"}
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines()[:4])
    lines["report"], seconds = lines["report"].split(maxsplit=1)
    assert re.fullmatch(r"\(\d+\.\d s\)", seconds)
    assert lines == {
        "output": "scan_fbp.h5",
        "report": "scan_fbp.html",
        "volume": "2 x 40 x 40 in 1/mm",
        **_axis(lines),
    }
    assert "Residual of the" in result.stdout
    assert "fbp starts: 30 projections" in result.stderr
    assert "fbp starts: 30 projections" not in result.stdout


@pytest.mark.parametrize(("more", "chosen"), others_slow([((), "fbp"), (("-m", "r2"), "preview: 125 steps")]))
def test_a_quality_takes_the_method_that_is_taken_without_it(folder: Path, more: tuple[str, ...], chosen: str) -> None:
    """Auto, whose message names --quality best: that took a fit of 1500 steps."""
    result = succeeds("recon", "scan.h5", "--quality", "preview", "--no-report", *more)
    assert chosen in result.stdout and ("r2" in result.stdout) == bool(more), result.stdout


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """The volume of a file of ours."""
    folder = tmp_path_factory.mktemp("reference")
    scan, out = write_exchange(folder / "scan.h5", SCAN), folder / "reference.h5"
    succeeds("recon", str(scan), "-m", "fbp", "-o", str(out), "--no-report")
    with opened_volume(out) as record:
        return np.array(record.volume.data[:])


@pytest.mark.parametrize("name", others_slow(["v.tif", "v", "v.h5", "v.npy", "v.nrrd"]))
def test_the_suffix_of_the_output_is_its_format(folder: Path, reference: np.ndarray, name: str) -> None:
    succeeds("recon", "scan.h5", "-m", "fbp", "-o", name)
    assert left(folder) == {"scan.h5", name, "v.html"}
    with opened_volume(folder / name) as read:
        np.testing.assert_array_equal(read.volume.data[:], reference)
    refused = beamline("recon", name, "-m", "fbp", "-o", "again.h5")
    assert refused.exit_code == 5 and left(folder) == {"scan.h5", name, "v.html"}
    assert "volume that this program wrote" in refused.stderr or name not in ("v.tif", "v")
    said = beamline("info", name)
    assert said.exit_code == 0 and "2 x 40 x 40" in said.stdout
    succeeds("validate", name)


def _axis(lines: dict[str, str]) -> dict[str, str]:
    assert float(lines["axis"].removeprefix("column ")) == pytest.approx(SCAN.axis_col, abs=0.25)
    return {"axis": lines["axis"]}


def test_json_is_one_event_a_line_and_done_is_the_last(folder: Path) -> None:
    options = ("--steps", "10", "--gaussians", "100", "--seed", "2", "--no-report", "-o", "out.h5", "--json")
    result = succeeds("recon", "scan.h5", *options, "--views", "fixed:10", "--axis", "20.7", "--bin", "2")
    events = [json.loads(line) for line in result.stdout.splitlines()]
    events = [event for event in events if event.get("stage") != "phase"]
    assert events[0]["event"] == "recon_started"
    done = events[-1]
    assert done["event"] == "done"
    assert (done["output"], done["report"], done["axis_col"]) == ("out.h5", None, 20.7)
    assert done["shape"] == [1, 20, 20]
    assert {"seconds", "residual", "residual_held_out"} <= set(done)
    assert left(folder) == {"scan.h5", "out.h5"}
    parameters = read_reconstruction(folder / "out.h5").parameters
    assert (parameters["steps"], parameters["seed"], parameters["views"]) == (10, 2, "fixed:10")


@pytest.mark.slow
def test_more_gaussians_than_there_is_room_for_are_told(folder: Path) -> None:
    result = succeeds("recon", "scan.h5", "--steps", "2", "--gaussians", "99999999", "--no-report")
    start = int(read_reconstruction(folder / "scan_r2.h5").parameters["gaussians_at_start"])
    assert f"Warning: The fit started with {start} Gaussians instead of 99999999" in result.stderr
    few = ("--gaussians", "50", "--finish", "0", "-o", "few.h5")
    result = beamline("recon", "scan.h5", "--steps", "2", *few, "--no-report")
    assert result.exit_code == 0 and "The fit started" not in result.stderr
    # Two steps of fifty Gaussians, not finished on voxels, do not explain the views, and that is said.
    assert "may hide cracks, pores or edges" in result.stderr


@pytest.mark.slow
def test_a_measured_scan_from_hdf5_and_from_its_tiffs(folder: Path, shared_data: Path) -> None:
    options = ("-m", "fbp", "--bin", "2", "--no-report")
    scan = shared_data / "diamond_24737_parallel_91x135x160.h5"
    tiffs = shared_data / "diamond_24737_tiff_series.zip"
    succeeds("recon", str(scan), *options, "-o", "a.h5")
    succeeds("recon", str(tiffs), *options, "--angle-rows", "10:101", "-o", "b.h5")
    a, b = (read_reconstruction(folder / name) for name in ("a.h5", "b.h5"))
    assert a.parameters["axis_col"] == pytest.approx(85.75, abs=0.5)
    assert b.parameters["axis_col"] == pytest.approx(85.75, abs=0.5)
    spread = float(a.volume.data.std())
    assert float(np.sqrt(np.mean((a.volume.data - b.volume.data) ** 2))) < 0.05 * spread


@pytest.mark.parametrize(("limit", "code"), others_slow([("1e-6", 6), ("1.0", 0)]))
def test_a_quality_limit_that_fails_is_told_and_leaves_the_results(folder: Path, limit: str, code: int) -> None:
    result = beamline("recon", "scan.h5", "-m", "fbp", "--views", "fixed:15", "--max-residual", limit, "--json")
    assert result.exit_code == code, result.output
    assert left(folder) == {"scan.h5", "scan_fbp.h5", "scan_fbp.html"}
    assert json.loads(result.stdout.splitlines()[-1])["event"] == "done"
    assert ("held-out projections" in result.stderr) is (code == 6)


@pytest.mark.slow
def test_a_budget_says_what_it_chose(folder: Path) -> None:
    result = succeeds("recon", "scan.h5", "--axis", "20.7", "--budget", "1s", "--no-report")
    lines = dict(line.split(maxsplit=1) for line in result.stdout.splitlines() if line.startswith("chosen"))
    parameters = read_reconstruction(folder / "scan_auto.h5").parameters
    assert parameters["budget"] == 1 and "; 1 s for fbp" in lines["chosen"]


@pytest.mark.slow
def test_rings_are_removed_recorded_and_told(folder: Path, shared_data: Path) -> None:
    scan, options = str(shared_data / "diamond_24737_parallel_91x135x160.h5"), ("--axis", "85.75", "--rows", "60:64")
    scores, middle = {}, 79.5
    for rings in ("none", "auto"):
        result = succeeds("recon", scan, "-m", "fbp", "--rings", rings, *options, "--no-report", "-o", f"{rings}.h5")
        record = read_reconstruction(folder / f"{rings}.h5")
        scores[rings] = ring_score(record.volume.data[0], (middle, middle))
        assert record.parameters["rings"] == rings
        assert ("To remove the rings, use --rings auto" in result.stderr) == (rings == "none")
    assert "Rings: removed by sort. The height of the stripes fell from" in result.stderr
    assert str(record.parameters["rings_removed"]) in result.stderr
    assert scores["auto"] < 0.5 * scores["none"], scores


@pytest.mark.slow
def test_phase_is_retrieved_recorded_and_told(folder: Path) -> None:
    way = ("--phase", "paganin:Al", "--energy-kev", "20", "--pixel-size-um", "1", "--no-report")
    result = succeeds("recon", "scan.h5", "-m", "fbp", *way, "--distance-mm", "20")
    said = str(read_reconstruction(folder / "scan_fbp.h5").parameters["phase"])
    assert (
        said in result.stderr
        and said.startswith("Phase retrieval with Paganin's filter over 5.4")
        and "delta/beta 295.8" in said
    )
    assert left(folder) == {"scan.h5", "scan_fbp.h5"}


@pytest.mark.slow
def test_a_tilt_and_a_lens_are_corrected_recorded_and_told(folder: Path) -> None:
    lens = "xcenter = 20.0\nycenter = 0.5\nfactor0 = 1.0\nfactor1 = 1e-5\n"
    (folder / "lens.txt").write_text(lens, encoding="utf-8")
    options = ("-m", "fbp", "--tilt", "-0.5", "--distortion", "lens.txt")
    succeeds("recon", "scan.h5", *options, "--dry-run")
    succeeds("recon", "scan.h5", *options, "--write-config", "recipe.yaml")
    result = succeeds("recon", "scan.h5", "--config", "recipe.yaml")
    found = read_reconstruction(folder / "scan_fbp.h5").parameters
    assert (found["tilt_deg"], found["distortion_col"], found["distortion_factors"]) == (-0.5, 20.0, "(1.0, 1e-05)")
    assert "The projections are rotated by -0.5 degrees." in result.stderr
    assert "The projections are rotated by -0.5 degrees." in (folder / "scan_fbp.html").read_text(encoding="utf-8")
    assert left(folder) == {"scan.h5", "scan_fbp.h5", "scan_fbp.html", "lens.txt", "recipe.yaml"}
