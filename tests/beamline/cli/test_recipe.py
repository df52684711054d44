"""Recipes and the lines "to repeat": what they give is what the call gave."""

import errno
import io
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from beamline.cli import recon as log
from beamline.cli.recipe import repeating
from beamline.features.particles.command import segment
from beamline.features.trials.command import study, tradeoff
from beamline.storage.writers.recon_file import ReconRecord, read_reconstruction
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


def test_the_line_to_repeat_repeats_from_any_folder(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save("truth.npy", np.ones((1, 40, 40), np.float32) * np.arange(40, dtype=np.float32))
    first = _made(folder, "recon", "scan.h5", *OPTIONS, "--truth", "truth.npy:0:1", "-o", "v.h5")
    program, *line = shlex.split(str(first.parameters["command"]))
    assert program == "beamline"
    _same(first, _made(folder, *line))
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.chdir(elsewhere)
    again = _made(elsewhere, *line)
    _same(first, again)
    assert again.metrics["psnr"] == first.metrics["psnr"]


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
    _, *line = shlex.split(str(from_volume.parameters["command"]))
    _same(first, _made(folder, *line))  # the recipe's options are in the line: it needs no recipe


def test_the_command_line_goes_before_the_recipe(folder: Path) -> None:
    (folder / "r.yaml").write_text("method: sirt\niterations: 3\n")
    record = _made(folder, "recon", "scan.h5", "--config", "r.yaml", "--iterations", "2", "--no-report")
    assert record.parameters["iterations"] == 2
    assert record.parameters["recipe"] == "method: sirt\niterations: 2\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("methods: fbp\n", "option of a recipe 'methods' is unknown; legal: method"),
        ("output: v.h5\n", "option of a recipe 'output' is unknown"),
        ("method: [fbp, r2]\n", "expected one value"),
        ("method: r3\n", "r3"),
        ("rows: 5\n", "FIRST:END"),
        ("method: fbp\niterations: 3\n", "--iterations is of fista-tv, os-sirt-tv, pnp-dct, sirt"),
        ("just text\n", "expected lines such as"),
        ("a: b: c\n", "YAML"),
        ("method: &a [x, x]\n" + "".join(f"b{i}: &b{i} [*a, *a, *a]\n" for i in range(9)), "expected one value"),
        ("method: " + "[" * 1000, "YAML"),
        ("\x00", "YAML"),
    ],
)
def test_a_recipe_that_is_wrong_is_refused_before_any_work(folder: Path, text: str, said: str) -> None:
    (folder / "r.yaml").write_text(text)
    result = beamline("recon", "scan.h5", "--config", "r.yaml")
    assert result.exit_code == 2, result.output
    assert said in " ".join(result.stderr.split())
    assert left(folder) == {"scan.h5", "r.yaml"}


def test_other_volumes_and_missing_files_hold_no_recipe(folder: Path) -> None:
    for name in ("scan.h5", "none.yaml"):
        result = beamline("recon", "scan.h5", "--config", name)
        assert result.exit_code in (2, 5) and name in result.stderr, result.output
    assert left(folder) == {"scan.h5"}


def test_a_log_says_what_happened_and_why_it_failed(folder: Path) -> None:
    succeeds("recon", "scan.h5", "-m", "fbp", "--log", "log.txt", "--no-report")
    lines = (folder / "log.txt").read_text().splitlines()
    kinds = [line.split()[1] for line in lines]
    assert kinds[0] == "state:" and kinds[-1] == "done:" and "recon_started:" in kinds
    assert "residual" in lines[-1]
    assert beamline("recon", "scan.h5", "-m", "fbp", "--log", "log.txt", "-o", "x.h5").exit_code == 5
    assert beamline("recon", "none.h5", "-m", "fbp", "--log", "bad.txt").exit_code == 5
    assert "none.h5" in (folder / "bad.txt").read_text().splitlines()[-1]
    said = beamline("recon", "scan.h5", "-m", "fbp", "-v", "-o", "y.h5", "--no-report").stderr
    shown = [line.split()[1] for line in said.splitlines()]
    steady = [[kind for kind in each if kind != "progress:"] for each in (shown, kinds[1:])]  # that comes by the clock
    assert steady[0] == steady[1] and "progress:" in shown


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_log_that_the_disk_does_not_take_is_named_and_does_not_end_the_work(
    number: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            if " state: " not in text:
                raise OSError(number, os.strerror(number))
            return super().write(text)

    @contextmanager
    def new_log(path: Path) -> Iterator[Full]:
        path.touch()
        yield Full()

    monkeypatch.setattr(log, "new_log", new_log)
    result = beamline("recon", "scan.h5", "-m", "fbp", "--log", "log.txt", "-o", "x.h5", "--no-report")
    assert result.exit_code == 0
    assert result.stderr.count(f"log.txt could not be written ({os.strerror(number)})") == 1
    assert {"log.txt", "x.h5"} <= left(folder)


def test_lines_of_commands_with_arguments_and_flags(folder: Path) -> None:
    context = study.make_context("study", ["random", "scan.h5", "--draws", "1", "-m", "fbp", "-m", "sirt", "--json"])
    line = shlex.split(repeating(context, Path("scan.h5"), Path("s")))
    scan = str(folder / "scan.h5")
    rest = "--method fbp --method sirt --draws 1 --output s_again"
    assert line == ["beamline", "study", "random", scan, *rest.split()]
    context = tradeoff.make_context("tradeoff", ["scan.h5", "--full", "--darks", "d.tif", "--flats", "60000"])
    line = shlex.split(repeating(context, Path("scan.h5"), Path("t")))
    rest = ["--darks", str(folder / "d.tif"), "--flats", "60000", "--full", "--output", "t_again"]
    assert line == ["beamline", "tradeoff", scan, *rest]


def test_an_option_of_two_values_stands_once(folder: Path) -> None:
    context = segment.make_context("segment", ["scan.h5", "--percentiles", "1", "99"])
    line = shlex.split(repeating(context, Path("scan.h5"), Path("t")))
    assert " ".join(line).count("--percentiles 1 99") == 1


def test_any_setting_comes_by_its_name_and_a_recipe_keeps_it(folder: Path) -> None:
    short = ("--preset", "published", "--steps", "3", "--gaussians", "60", "--rows", "0:1", "--no-report")
    settings = ("--set", "fit.decay=0.2 fit.rates=[1e-4,5e-3,1e-3,1e-2]", "--set", "fit.policy.every=50")
    first = _made(folder, "recon", "scan.h5", *short, *settings, "--plain-splatting", "-o", "v.h5")
    assert first.parameters["method"] == "r2-published" and first.parameters["start"] == "published"
    assert 'set: "fit.decay=0.2 fit.rates=[1e-4,5e-3,1e-3,1e-2] fit.policy.every=50"' in str(first.parameters["recipe"])
    _same(first, _made(folder, "recon", "scan.h5", "--config", "v.h5", "--no-report", "-o", "w.h5"))
    _, *line = shlex.split(str(first.parameters["command"]))
    _same(first, _made(folder, *line))
    rectified = _made(folder, "recon", "scan.h5", *short, *settings, "-o", "x.h5")
    assert not np.array_equal(first.volume.data, rectified.volume.data)


def test_a_flag_that_a_recipe_switches_off_excludes_nothing_and_chooses_no_method(folder: Path) -> None:
    Path("recipe.yaml").write_text("uncertainty: false\nearly-stop: no\n")
    result = beamline("recon", "scan.h5", "--config", "recipe.yaml", "--budget", "30s", "--write-config", "-")
    assert (result.exit_code, result.stdout) == (0, "method: auto\nbudget: 30s\n"), result.output


def test_with_an_output_the_recipe_is_written_and_the_volume_made(folder: Path) -> None:
    succeeds("recon", "scan.h5", *OPTIONS, "--write-config", "both.yaml", "-o", "both.h5")
    assert (folder / "both.yaml").read_text() == read_reconstruction(folder / "both.h5").parameters["recipe"]
    assert beamline("recon", "scan.h5", *OPTIONS, "--write-config", "none.yaml", "-o", "both.h5").exit_code == 5
    assert not (folder / "none.yaml").exists()
