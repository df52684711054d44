"""Recipes: a recipe gives the same result as the call that wrote it."""

from pathlib import Path

import numpy as np
import pytest

from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.recon_file import read_reconstruction
from tests.beamline.cli.small_scan import SCAN, beamline, left, succeeds
from tests.beamline.scans import write_exchange

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = ("-m", "sirt", "--iterations", "3", "--rows", "0:1", "--views", "fixed:10", "--axis", "20.5", "--no-report")


def _made(folder: Path, *arguments: str) -> ReconRecord:
    before = left(folder)
    succeeds(*arguments)
    (name,) = [name for name in left(folder) - before if name.endswith(".h5")]
    return read_reconstruction(folder / name)


def _same(one: ReconRecord, other: ReconRecord) -> None:
    np.testing.assert_array_equal(one.volume.data, other.volume.data)
    assert one.parameters["recipe"] == other.parameters["recipe"]


def test_a_recipe_gives_the_same_from_a_file_and_from_a_volume(folder: Path) -> None:
    first = _made(folder, "recon", "scan.h5", *OPTIONS, "-o", "v.h5")
    assert sorted(str(first.parameters["recipe"]).splitlines()) == sorted(
        ["method: sirt", "iterations: 3", "rows: 0:1", "views: fixed:10", "axis: 20.5"]
    )
    succeeds("recon", "scan.h5", *OPTIONS, "--write-config", "r.yaml")
    assert (folder / "r.yaml").read_text() == first.parameters["recipe"]
    assert beamline("recon", "scan.h5", *OPTIONS, "--write-config", "-").stdout == first.parameters["recipe"]
    write_exchange(folder / "other.h5", SCAN)
    _same(first, _made(folder, "recon", "other.h5", "--config", "r.yaml", "-o", "a.h5", "--no-report"))
    from_volume = _made(folder, "recon", "scan.h5", "--config", "v.h5", "-o", "b.h5", "--no-report")
    _same(first, from_volume)


def test_the_command_line_goes_before_the_recipe(folder: Path) -> None:
    (folder / "r.yaml").write_text("method: sirt\niterations: 3\n")
    record = _made(folder, "recon", "scan.h5", "--config", "r.yaml", "--iterations", "2", "--no-report")
    assert record.parameters["iterations"] == 2
    assert record.parameters["recipe"] == "method: sirt\niterations: 2\n"


def test_any_setting_comes_by_its_name_and_a_recipe_keeps_it(folder: Path) -> None:
    short = ("-m", "r2-published", "--steps", "3", "--gaussians", "60", "--rows", "0:1", "--no-report")
    settings = ("--set", "fit.decay=0.2 fit.rates=[1e-4,5e-3,1e-3,1e-2]", "--set", "fit.policy.every=50")
    first = _made(folder, "recon", "scan.h5", *short, *settings, "--plain-splatting", "-o", "v.h5")
    assert first.parameters["method"] == "r2-published" and first.parameters["start"] == "published"
    assert 'set: "fit.decay=0.2 fit.rates=[1e-4,5e-3,1e-3,1e-2] fit.policy.every=50"' in str(first.parameters["recipe"])
    _same(first, _made(folder, "recon", "scan.h5", "--config", "v.h5", "--no-report", "-o", "w.h5"))
    rectified = _made(folder, "recon", "scan.h5", *short, *settings, "-o", "x.h5")
    assert not np.array_equal(first.volume.data, rectified.volume.data)


def test_a_flag_that_a_recipe_switches_off_excludes_nothing_and_chooses_no_method(folder: Path) -> None:
    Path("recipe.yaml").write_text("uncertainty: false\nearly-stop: no\n")
    result = beamline("recon", "scan.h5", "--config", "recipe.yaml", "--budget", "30s", "--write-config", "-")
    assert (result.exit_code, result.stdout) == (0, "method: auto\nbudget: 30s\n"), result.output


def test_an_option_of_the_recipe_that_the_method_does_not_have_is_called_one_of_the_recipe(folder: Path) -> None:
    """The user did not type it, so the message says where it comes from."""
    Path("recipe.yaml").write_text("method: sirt\niterations: 3\n")
    of_recipe = beamline("recon", "scan.h5", "--config", "recipe.yaml", "-m", "fbp", "-o", "v.h5")
    typed = beamline("recon", "scan.h5", "--iterations", "3", "-m", "fbp", "-o", "v.h5")
    assert (of_recipe.exit_code, typed.exit_code) == (2, 2)
    assert "--iterations comes from --config, and it works only with" in of_recipe.output
    assert "--config" not in typed.output


def test_with_an_output_the_recipe_is_written_and_the_volume_made(folder: Path) -> None:
    succeeds("recon", "scan.h5", *OPTIONS, "--write-config", "both.yaml", "-o", "both.h5")
    assert (folder / "both.yaml").read_text() == read_reconstruction(folder / "both.h5").parameters["recipe"]
    assert beamline("recon", "scan.h5", *OPTIONS, "--write-config", "none.yaml", "-o", "both.h5").exit_code == 5
    assert not (folder / "none.yaml").exists()


def test_a_recipe_by_hand_may_name_the_angles_of_all_scans_and_none_is_written(folder: Path) -> None:
    np.savetxt(folder / "list.txt", np.degrees(SCAN.angles))
    (folder / "r.yaml").write_text("method: sirt\niterations: 3\nrows: 0:1\naxis: 20.5\nangles: list.txt\n")
    write_exchange(folder / "bare.h5", SCAN, {"theta": None})
    made = _made(folder, "recon", "bare.h5", "--config", "r.yaml", "-o", "v.h5", "--no-report")
    options = ("-m", "sirt", "--iterations", "3", "--rows", "0:1", "--axis", "20.5", "--no-report")
    whole = _made(folder, "recon", "scan.h5", *options, "-o", "w.h5")
    np.testing.assert_allclose(made.volume.data, whole.volume.data, rtol=1e-4, atol=1e-6)
    assert "angles" not in str(made.parameters["recipe"])
