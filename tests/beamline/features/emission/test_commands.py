"""Emission from a scene to a volume by the commands: the same counts and the same bits as by the functions."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

import recon
from beamline.core.errors import DataError
from beamline.core.quantities import VoxelKind
from beamline.features.trials.runner import ComparedScan, run_comparison
from beamline.features.trials.tradeoff import planned_tradeoff
from beamline.features.trials.trial import Trial
from beamline.features.trials.view_choices import ViewChoice
from beamline.features.trials.worker import DATA, TrialData, dump, load, run
from beamline.projections.prepare import DiskBuffer, prepare_projections
from beamline.projections.prepared import hold_out
from beamline.projections.selection import Selection
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.volumes.files import opened_volume
from drivers.base.clock import SystemClock
from recon.methods import names_compared
from simulators.scenes.emission import events, load_emission
from tests.beamline.cli.small_scan import beamline

SCENE = "emission: {radius: 24}\nscanner: {trues: 2.0e+5}\nlines: {views: 24, shape: [3, 32], pitch: 2.0}\n"


@pytest.fixture(scope="module")
def pet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of counts; its truth lies beside it."""
    folder = tmp_path_factory.mktemp("pet")
    (folder / "pet.yaml").write_text(SCENE, encoding="utf-8")
    made = beamline(
        "simulate", folder / "pet.yaml", "-o", folder / "pet.h5", "--truth", folder / "truth.h5", "--seed", 5
    )
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
    done = beamline("recon", str(pet), "-m", "osem", "--iterations", "3", "--truth", truth, "-o", str(out))
    assert done.exit_code == 0, done.output
    assert "Contrast recovery of hot regions" in done.output and "Noise of the body" in done.output
    with open_scan(pet) as source:
        assert source.emission is not None
        counted = source.emission(np.arange(24), slice(0, 3))
        geometry = recon.Geometry.parallel(source.angles, (3, 32), pixel_pitch=2.0)
    expected = recon.mlem(recon.Emission(counted.counts, geometry, counted.survival, counted.background),
                          recon.Grid.matching(geometry), 3, 4)  # fmt: skip
    with h5py.File(out) as file:
        np.testing.assert_array_equal(file["entry/data/data"][()], expected.data)
        assert file["entry/data/data"].attrs["units"] == "counts/mm"
        assert file["entry/data/data"].attrs["long_name"] == "activity (counts/mm)"
    with opened_volume(out) as record, h5py.File(truth) as file:
        assert record.kind is VoxelKind.ACTIVITY and file["entry/data/data"].attrs["units"] == record.unit
    assert beamline("export", str(out), "-o", str(tmp_path / "o.tif")).exit_code == 0
    with opened_volume(tmp_path / "o.tif") as record:
        assert record.kind is VoxelKind.ACTIVITY


def test_other_methods_take_its_weighted_lines(pet: Path, tmp_path: Path) -> None:
    out = tmp_path / "cgls.h5"
    assert beamline("recon", str(pet), "-m", "cgls", "--iterations", "4", "-o", str(out)).exit_code == 0
    with h5py.File(pet) as file, h5py.File(out) as made:
        sets = {name: item[()] for name, item in file["emission"].items()}
        survival = sets["normalisation"] * np.exp(-sets["attenuation"])
        geometry = recon.Geometry.parallel(np.radians(sets["angles"]), (3, 32), pixel_pitch=2.0)
        emission = recon.Emission(sets["counts"], geometry, survival, sets["randoms"] + sets["scatter"])
        expected = recon.reconstruct(emission, geometry, recon.Cgls(iterations=4)).volume.data
        np.testing.assert_allclose(made["entry/data/data"][()], expected, rtol=1e-3, atol=1e-3 * expected.max())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("--bin", "2"), "go with --bin"), (("--rings", "sort"), "go with --rings"),
     (("--cols", "2:30"), "go with --cols"), (("--follow",), "--follow")],
)  # fmt: skip
def test_what_counts_do_not_take_is_refused(pet: Path, tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    refused = beamline("recon", str(pet), "-m", "r2", *arguments, "-o", str(tmp_path / "out.h5"))
    assert refused.exit_code in (2, 5) and said in refused.output, refused.output
    assert not list(tmp_path.iterdir())


def test_sets_of_another_shape_and_a_wrong_scene_are_refused(pet: Path, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "wrong.h5", "w") as file, h5py.File(pet) as right:
        right.copy("emission", file)
        del file["emission/randoms"]
        file["emission/randoms"] = np.zeros((3, 32))
    refused = beamline("recon", str(tmp_path / "wrong.h5"))
    assert refused.exit_code == 5 and "randoms has shape (3, 32), the counts (24, 3, 32)" in refused.output
    for override, said in (
        ("emission.radius=-1", "emission.radius"),
        ("emission.radius=12", "leaves the body"),
        ("lines.pixels=3", "key 'pixels' is unknown"),
    ):
        refused = beamline("simulate", str(pet.with_suffix(".yaml")), "-o", str(tmp_path / "x.h5"), "--set", override)
        assert refused.exit_code == 2 and said in refused.output, refused.output
    refused = beamline("simulate", str(pet.with_suffix(".yaml")), "--explain")
    assert refused.exit_code == 2 and "takes no --explain" in refused.output


def test_counts_are_not_spilled(pet: Path) -> None:
    buffer = DiskBuffer(np.zeros((24, 3, 32), np.float32), 4)
    with open_scan(pet) as source, pytest.raises(DataError, match="memory"):
        prepare_projections(source, Selection(), print, buffer)


@pytest.mark.usefixtures("one_thread")
def test_a_trial_gives_what_the_function_gives_of_the_same_counts(pet: Path, tmp_path: Path) -> None:
    """Of all views, of half of them, and beside views held out; the file between has what was counted."""
    with open_scan(pet) as source:
        prepared = prepare_projections(source, Selection(), pytest.fail)
    assert prepared.emission is not None
    truth = np.asarray(h5py.File(pet.with_name("truth.h5"))["entry/data/data"][()])
    for given, views in ((truth, 24), (truth, 12), (None, 21)):
        unseen = prepared if given is not None else hold_out(prepared, 8, most=16, advice="")
        data = TrialData(unseen, given)
        dump(tmp_path / DATA, data)
        trial = Trial("method", "osem", views, settings={"iterations": 2, "subsets": 3}, halves=True)
        found, volume = run(trial, load(tmp_path / DATA), 0)
        ids = (prepared if given is not None else hold_out(prepared, 8, advice="")).projections.view_ids
        some = ids[np.arange(views) * len(ids) // views]
        emission = prepared.emission.summed(some[:, None], prepared.geometry.select(some))
        expected = recon.mlem(emission, recon.Grid.matching(prepared.geometry), 2, 3).data
        np.testing.assert_array_equal(volume, expected)
        assert np.isfinite(found["metrics"]["resolution"])
        assert ("spillover" in found["metrics"]) == (given is not None)


def test_views_added_are_the_counts_of_both(pet: Path) -> None:
    """Two views of the same lines have the activity of one, from counts, survival and background of both."""
    with open_scan(pet) as source:
        emission = prepare_projections(source, Selection(), pytest.fail).emission
    assert emission is not None and emission.survival is not None and emission.background is not None
    views = emission.geometry
    twice = emission.summed(np.stack([np.arange(24)] * 2, axis=1), views)
    np.testing.assert_array_equal(twice.counts, 2 * emission.counts)
    grid = recon.Grid.matching(views)
    np.testing.assert_allclose(recon.mlem(twice, grid, 3).data, recon.mlem(emission, grid, 3).data, rtol=1e-4)
    np.testing.assert_allclose(recon.weighted_lines(twice)[0], recon.weighted_lines(emission)[0], rtol=1e-3, atol=1e-3)
    alone = recon.Emission(emission.counts, views).summed(np.array([[0, 1], [2, 3]]), views.select([0, 2]))
    assert alone.survival is not None and (alone.survival == 2).all() and alone.background is None


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_a_trade_off_reconstructs_counts(pet: Path, tmp_path: Path) -> None:
    """By the commands, beside the truth: osem of the trade-off is osem of `recon`."""
    truth = str(pet.with_name("truth.h5"))
    made = beamline("tradeoff", str(pet), "--methods", "osem", "--truth", truth, "-o", str(tmp_path / "t"))
    assert made.exit_code == 0, made.output
    rows = csv.DictReader((tmp_path / "t/tradeoff.csv").read_text(encoding="utf-8").splitlines())
    base = next(row for row in rows if row["group"] == "method")
    alone = beamline("recon", str(pet), "-m", "osem", "--truth", truth, "-o", str(tmp_path / "o.h5"), "--json")
    figures = json.loads(alone.output.splitlines()[-1])
    for name in ("psnr", "spillover", "recovery", "variation"):
        assert float(base[name]) == pytest.approx(figures[name], rel=1e-3)


@pytest.mark.slow
def test_a_row_of_a_study_adds_the_counts_of_its_windows(pet: Path) -> None:
    with open_scan(pet) as source:
        prepared = prepare_projections(source, Selection(), pytest.fail)
    assert prepared.emission is not None
    groups = np.arange(24).reshape(12, 2)
    angles = prepared.geometry.angles[groups].mean(axis=1)
    views = replace(prepared.geometry.select(groups[:, 1]), angles=angles)
    data = TrialData(prepared, None)
    settings: dict[str, int] = {"iterations": 2, "subsets": 3}
    row = Trial("method", "osem", 12, settings=settings, choice=ViewChoice("pairs", groups.tolist()))
    _, volume = run(row, data, 0)
    expected = recon.mlem(prepared.emission.summed(groups, views), recon.Grid.matching(views), 2, 3).data
    np.testing.assert_array_equal(volume, expected)


def test_a_set_that_changed_on_the_disk_is_refused_by_name(pet: Path, tmp_path: Path) -> None:
    """Every set of the file has a checksum of each view; `validate --deep` compares it, too."""
    said = beamline("validate", str(pet), "--deep")
    assert said.exit_code == 0 and "no checksums" not in said.output
    for name in ("counts", "attenuation", "normalisation", "randoms", "scatter"):
        damaged = tmp_path / f"{name}.h5"
        damaged.write_bytes(pet.read_bytes())
        with h5py.File(damaged) as file:
            chunk = file[f"emission/{name}"].id.get_chunk_info(5)
        with damaged.open("r+b") as raw:
            raw.seek(chunk.byte_offset + chunk.size // 2)
            byte = raw.read(1)[0]
            raw.seek(-1, 1)
            raw.write(bytes([byte ^ 1]))
        refused = beamline("recon", str(damaged), "-m", "fbp", "-o", str(tmp_path / "out.h5"))
        assert refused.exit_code == 5 and "cannot be read" in refused.output, (name, refused.output)
        assert beamline("validate", str(damaged), "--deep").exit_code == 5
        assert f"{name}.h5" in refused.output and not (tmp_path / "out.h5").exists()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fista-tv", "pnp-dct"])  # r2's are those of one of them
def test_error_bars_of_an_emission_are_those_of_its_counts(pet: Path, tmp_path: Path, method: str) -> None:
    """Of the two volumes the noisier one has wider bars: a quarter of the counts, twice the relative deviation."""
    relative = []
    with h5py.File(pet) as file, h5py.File(tmp_path / "fewer.h5", "w") as fewer:
        file.copy("emission", fewer)
        kept = np.random.default_rng(1).binomial(file["emission/counts"][()].astype(int), 0.25)
        for name, values in (("counts", kept), ("randoms", file["emission/randoms"][()] / 4),
                             ("scatter", file["emission/scatter"][()] / 4)):  # fmt: skip
            del fewer[f"emission/{name}"]
            fewer[f"emission/{name}"] = values.astype(np.float32)
    for path in (pet, tmp_path / "fewer.h5"):
        out = tmp_path / f"{path.stem}_{method}.h5"
        done = beamline("recon", str(path), "-m", method, "--uncertainty", "-o", str(out))
        assert done.exit_code == 0, done.output
        with h5py.File(out) as made:
            bars, volume = made["entry/data/data_errors"][()], made["entry/data/data"][()]
        body = volume > 0.5 * np.median(volume[volume > 0.1 * volume.max()])
        assert (bars[body] > 0).all()
        relative.append(float(np.median(bars[body]) / np.median(volume[body])))
    assert 1.3 < relative[1] / relative[0] < 3


def test_a_trade_off_without_names_tries_the_methods_of_counts(pet: Path, tmp_path: Path) -> None:
    """And only there; those that take many times as long stay out."""
    plain, emitting = names_compared(), names_compared(emission=True)
    assert set(emitting) - set(plain) == {"mlem", "osem"} and set(plain) < set(emitting)
    scan = ComparedScan(SourceOptions(pet), Selection(), tmp_path / "t", max_seconds=1e-9)
    table = run_comparison(partial(planned_tradeoff, scan), scan, lambda _: None, SystemClock())
    assert {outcome.trial.method for outcome in table.outcomes} == set(emitting)
