"""The scripts in tests/bench run with the least work that covers all their code, so that breakage is noticed.

What they measure means nothing at these sizes, so that the limits which a script asserts do not count here.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import subprocess
import sys
import textwrap
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import recon
from recon.base.error_law import ErrorLaw
from tests.beamline.cli.small_scan import succeeds
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.bench import quality_cases
from tests.bench.quality_cases import Case
from tests.bench.spheres import spheres

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
Patch = pytest.MonkeyPatch
FEW = recon.R2(steps=4, finish=1, gaussians=40)


def script(name: str) -> ModuleType:
    return import_module(f"tests.bench.{name}")


class _Judged(ast.NodeTransformer):
    """What is asserted is worked out, and may be false."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.decorator_list = []
        return self.generic_visit(node)

    def visit_Assert(self, node: ast.Assert) -> ast.AST:
        return ast.copy_location(ast.Expr(node.test), node)


def measured(judge: Any, *arguments: object) -> None:
    """Call a script's test without its own limits, which are those of full size."""
    tree = _Judged().visit(ast.parse(textwrap.dedent(inspect.getsource(judge))))
    made: dict[str, Any] = {}
    exec(compile(ast.fix_missing_locations(tree), f"<{judge.__name__}>", "exec"), judge.__globals__, made)
    made[judge.__name__](*arguments)


def small(patch: Patch, module: ModuleType, **values: object) -> None:
    for name, value in values.items():
        patch.setattr(module, name, value)


def toy_case(*_: object, **__: object) -> Case:
    views, geometry, truth = spheres(24, 4, 12)
    return Case("toy", views, geometry, recon.Grid.matching(geometry), truth, float(truth.max()))


def called(patch: Patch, module: ModuleType, *words: object) -> Any:
    """Its `main`, as from the command line."""
    patch.setattr(sys, "argv", [module.__name__, *map(str, words)])
    return module.main()


def test_acquisition(tmp_path: Path, monkeypatch: Patch) -> None:
    bench = script("test_acquisition")
    small(monkeypatch, bench, SECONDS=0.01, ROUNDS=1, FEWEST=12)
    measured(bench.test_rate_of_acquisition, (48, 64), tmp_path)


def test_live_volumes(monkeypatch: Patch) -> None:
    curve, live = script("test_anytime_curve"), script("test_live_accuracy")
    n = 24  # of fewer, none are held out
    angles = np.linspace(0, np.pi, n, endpoint=False)
    small(monkeypatch, curve, ROWS=4, SIDE=24, VIEWS=n, QUARTERS=(6, 12, 18, n), LAST=8, ORDERS={"golden": angles})
    measured(curve.test_quality_at_every_quarter, curve.smooth, 2)
    small(monkeypatch, live, VIEWS=n, LOOKS=(12, n), ORDERS={"sequential": angles}, STEPS_A_VIEW={"quiet": 0.5})
    small(monkeypatch, live, warm_up=lambda: None)
    measured(live.test_accuracy_against_time)


def test_calibration(monkeypatch: Patch) -> None:
    bench = script("test_calibration")
    small(monkeypatch, bench, VIEWS=16, SHAPE=(12, 24), METHOD=recon.FistaTv(2, tv_weight=3e-3))
    measured(bench.test_calibration, "parallel", "balls", "axis")


def test_dry_run(monkeypatch: Patch) -> None:
    bench, case = script("test_dry_run"), toy_case()
    small(monkeypatch, bench, SCANS={"toy": lambda: (case.projections, case.geometry)}, SHARES=[])
    for method in (recon.Fbp(), recon.Sirt(iterations=2)):
        bench.test_a_run_takes_the_seconds_that_were_expected("toy", method)
    assert len(bench.SHARES) == 2
    measured(bench.test_most_runs_were_near)


def test_error_bars(monkeypatch: Patch, tmp_path: Path) -> None:
    bench = script("test_error_bars")
    small(monkeypatch, bench, METHODS={"fbp": recon.Fbp(), "fista-tv": recon.FistaTv(2)})
    small(monkeypatch, bench, ROWS=4, dense_battery=lambda *_: quality_cases.dense_battery(12, 24, particles=20))
    measured(bench.test_voxels_of_the_truth_within_one_deviation, tmp_path, "battery", 12, 3000)


def test_free_geometry(monkeypatch: Patch) -> None:
    bench = script("test_free_geometry")
    methods = {"fbp": recon.Fbp(), "fista-tv, weight 0.003": recon.FistaTv(2, tv_weight=0.003)}
    small(monkeypatch, bench, VIEWS=6, GRID=recon.Grid((8, 24, 24)), METHODS=methods, INSIDE=(slice(2, 6),) * 3)
    measured(bench.test_free_sources_are_level_with_a_circle_of_sources)


def test_full_size() -> None:
    measured(script("test_full_size").test_fbp, 20, 32, "hann")


def test_hidden_detail(monkeypatch: Patch, tmp_path: Path) -> None:
    """Of scans of two cylinders, in place of the measured ones, as large as the parts that are looked at."""
    bench, angles = script("test_hidden_detail"), np.arange(8) * np.pi / 8
    for name, shape in (("aps2bm_tooth_181x2x640.h5", (2, 420)), ("diamond_24737_parallel_91x135x160.h5", (86, 130))):
        write_exchange(tmp_path / name, TwoCylinders(angles=angles, shape=shape))
    measured(bench.test_crack_in_a_tooth, tmp_path, "FBP hann, vo")
    measured(bench.test_plastic_around_a_metal_wire, tmp_path, "FBP hann")


def test_monitor(monkeypatch: Patch, capsys: pytest.CaptureFixture[str]) -> None:
    cost, roc = script("test_monitor_cost"), script("test_monitor_roc")
    small(monkeypatch, cost, SHAPE=(512, 2048), WARM=2, VIEWS=3)
    cost.test_a_frame_of_2304_x_4096(capsys)
    small(monkeypatch, roc, EVENTS=1, SAMPLES=1, SCANS=1, BEFORE=3, AFTER=3)
    measured(roc.test_recall_and_latency, "beam lost, 2 % left", capsys)


def test_queue_plan(monkeypatch: Patch, tmp_path: Path) -> None:
    bench = script("test_queue_plan")
    small(monkeypatch, bench, SCANS=4, ROUNDS=1)
    for kind in ("good", "wrong"):
        measured(bench.test_a_hundred_scans_are_planned_within_a_second, kind, tmp_path)


def test_published(monkeypatch: Patch, tmp_path: Path) -> None:
    one, tables = script("test_published"), script("test_published_tables")
    for each in (one, tables):
        small(monkeypatch, each, cone=toy_case, warm_up=lambda *_, **__: None)
    small(monkeypatch, one, PUBLISHED=one.R2Published(30), TOWARDS={"toy": FEW})
    monkeypatch.setenv("CURVE_SECONDS", "0.5")
    monkeypatch.setenv("CURVE_STEPS", "4")
    one.test_what_a_setting_costs(tmp_path, "toy", "toy")
    measured(one.test_accuracy_against_time, tmp_path, "toy")
    small(monkeypatch, tables, SECONDS=0.2, ROWS=["FDK", "SIRT"], METHODS={"FDK": recon.Fbp(), "SIRT": recon.Sirt(2)})
    tables.test_the_published_methods_by_default_and_at_equal_time(tmp_path, "toy", 12)


def test_series(monkeypatch: Patch) -> None:
    bench = script("test_series")
    small(monkeypatch, bench, SIDE=8, VIEWS=24, PITCH=0.06, PARTS=(1, 2))
    monkeypatch.setattr(recon, "fit_series", partial(recon.fit_series, tv_weight=0.01, sweeps=3))
    measured(bench.test_one_fit_in_time, bench.FOAM | {"n_holes": 5}, 2, False)


def test_splat_speed(monkeypatch: Patch) -> None:
    bench = script("test_splat_speed")
    small(monkeypatch, bench, N=60, SIDE=24, SIZES=((30, 16), (60, 16), (60, 24)), warm_up=lambda: None)
    measured(bench.test_projection_against_the_machine_and_the_scatter_reference)
    measured(bench.test_a_whole_step_and_its_parts)
    measured(bench.test_a_whole_fit_of_published_length, 4, 24)
    measured(bench.test_time_is_linear_in_pairs)


def test_thresholds(monkeypatch: Patch, tmp_path: Path) -> None:
    bench = script("test_thresholds")
    removed = {"SPREAD": bench.Removed(1.0, ("toy",), FEW), "WILD_PIXEL": bench.Removed(np.inf, ("toy",), FEW)}
    small(monkeypatch, bench, ROWS={"toy": toy_case}, REMOVED=removed)
    monkeypatch.setattr(recon, "R2", lambda **_: recon.splatting.r2.R2(steps=4, finish=1, gaussians=40))
    measured(bench.test_what_each_constant_brings, tmp_path)


def test_weak_matter(monkeypatch: Patch, tmp_path: Path) -> None:
    bench = script("test_weak_matter")
    scan = TwoCylinders(angles=np.arange(8) * np.pi / 8, shape=(40, 100))
    write_exchange(tmp_path / "diamond_24737_parallel_91x135x160.h5", scan)
    small(monkeypatch, bench, METHODS={"SIRT": recon.Sirt(1)})
    measured(bench.test_the_cap_keeps_its_mass, tmp_path, "SIRT")


def test_scripts_of_scans(monkeypatch: Patch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(monkeypatch, script("clean_scans"), 0, 1) == 0
    fringes = script("fringes")
    scan_of = fringes.scan_of
    small(monkeypatch, fringes, CASES=fringes.CASES[:1], scan_of=lambda case: scan_of(case, 48, 4, 16))
    called(monkeypatch, fringes, "--method", "fbp")
    wide = script("wide_field")
    small(monkeypatch, wide, balls=lambda *_: np.array([[2.0, 1.0, 0.0, 3.0]]))
    called(
        monkeypatch, wide,
        "--seeds", 7, "--over", 1.5, "--methods", "fbp", "--columns", 32, "--rows", 2, "--views", 16,
        "--offset-views", 2,
    )  # fmt: skip
    full = script("full_scan")
    small(monkeypatch, full, BAND=4)
    full.make(tmp_path / "full", 32, 8)
    volume = tmp_path / "volume.h5"
    recon_of(tmp_path / "full" / "scan.tif", tmp_path / "full" / "angles.txt", volume)
    full.judge(tmp_path / "full", volume)
    assert "of a grain's density" in capsys.readouterr().out


def in_this_process(words: list[str], cwd: Path | None = None, **_: object) -> subprocess.CompletedProcess[str]:
    with contextlib.chdir(cwd or Path()):
        done = succeeds(*words[3:])  # after `python -m beamline.cli.main`
    return subprocess.CompletedProcess(words, 0, done.stdout, done.stderr)


def test_scripts_of_commands(monkeypatch: Patch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Sizes, times, pages of real scans: each runs `beamline` in processes of its own, which the times do here, too."""
    times = script("table_of_times")
    small(monkeypatch, times, make_scans=lambda folder: None)
    called(monkeypatch, times, tmp_path / "times", "--runs", 1, "--only", "missing scan")
    shown = capsys.readouterr().out
    assert "| recon of a missing scan |" in shown
    monkeypatch.setattr(subprocess, "run", in_this_process)
    script("size_table").measure(tmp_path, "fbp", 32, 4, 8)
    assert "CPU s" in capsys.readouterr().out
    pages = script("real_scans")
    (tmp_path / "data").mkdir()
    write_exchange(tmp_path / "data" / "scan.h5", TwoCylinders())
    words = "beamline recon scan.h5 -m {} -o {}.h5"
    pair = words.format("fbp", "a"), words.format("sirt --iterations 1", "b")
    one = pages.Shown(*pair, ("A", "B"), 1, ((0, 1),), ((0, 9, 0, 9),))
    small(monkeypatch, pages, DATA=tmp_path / "data", SCANS={"toy": one}, FURTHER=())
    pages.run(tmp_path / "real")
    pages.picture(one, tmp_path / "real", tmp_path / "page.jpg")
    assert (tmp_path / "page.jpg").stat().st_size > 1000


def test_leagues(monkeypatch: Patch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ours alone, in this process."""
    league, users = script("league"), script("first_users")
    score = league.play("splatline fbp", league.smaller(toy_case(), 2))
    assert "splatline fbp" in league.table({"Diamond": {"splatline fbp": score}})
    kept = users.Kept(tmp_path / "scores.json")
    cell = users.Cell("packed", 32, 8, 1.0, 1e4, 1)
    small(monkeypatch, users, play=lambda *_: users.Score(20.0, 0.5, 0.1, None, None, None, 1.0, 100.0))
    users.play_all(kept, [cell], ["fbp"], False, 10.0)
    assert "fbp" in users.tables(kept, [cell])


def test_half_voxels(monkeypatch: Patch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    halves, ends = script("half_voxels"), script("ends")
    small(monkeypatch, ends, MORE=1, SHARES=())
    halves.main(["--columns", "48", "--views", "12", "--over", "1.5"])
    ends.main(["--columns", "48", "--views", "12", "--methods", "fista-tv", "--half-voxels"])
    assert capsys.readouterr().out.count("fista-tv") == 3
    toy = toy_case()
    unseen = toy.projections, toy.geometry, np.ones(toy.projections.shape, bool)
    ball = {"ball": lambda _: np.ones((8, 8, 8), np.float32)}
    small(monkeypatch, halves, CUT=12, SIDE=16, CONE_VIEWS=4, OBJECTS=ball)
    assert halves.measured(halves.cut(replace(toy, unseen=unseen))).startswith("| toy, 12 columns | 0.")
    assert halves.in_a_cone(tmp_path, "ball").startswith("| ball | ")


def test_next_pass(monkeypatch: Patch, tmp_path: Path) -> None:
    """On made-up scores and laws; one state is measured."""
    bench, policy, devices = (script(f"next_pass{name}") for name in ("", "_policy", "_devices"))
    scores = bench.ScoreFile(tmp_path / "scores")
    scores.scores = {f"0|0|r2|{bench.State(n)}": bench.Score(20.0 + n, 1.0, 1.0) for n in range(1, bench.PASSES + 1)}
    assert "hindsight" in bench.table(scores, [0])
    small(monkeypatch, bench.ScoreFile, law=lambda *_: ErrorLaw(90, 0.5, 0.1, 1.0))
    assert "predictions" in policy.table(scores, [0], [0], policy.ScanTarget(quality_db=1.0))
    assert devices.config_of(2).scan.offset_views == devices.WIDE_ANGLES
    case = toy_case()
    scene = script("next_pass_scenes").Scene(case.projections, case.projections[:0], case.truth, case.geometry)
    small(monkeypatch, bench, _scene=lambda number: scene, _noisy=lambda *_: case.projections, PASS=12)
    assert bench.measured(0, 0, bench.State(1), "fbp").quality > 0


def test_gpu_curve() -> None:
    labels = "published 3000", "ours 1600 0", "auto", "fista-tv"
    made = [script("gpu_curve").method_of(label.split()) for label in labels]
    assert [method.name for method in made] == ["r2-published", "r2", "auto", "fista-tv"]


def test_baselines_of_a_reference() -> None:
    """An edge that the reference has costs nothing in directional total variation, another one is worn down; and what
    PICCS and dTV make of exact line integrals of the reference is the reference."""
    bench = script("operando_baselines")
    m = np.zeros((16, 16, 1), np.float32)
    m[5:11, 4:12] = 1
    kept, other = m.copy(), np.roll(m, 3, 1)
    for each in (kept, other):
        bench.Directional(m, (1.0, 1.0, 1.0))(each, 0.2)
    assert np.abs(kept - m).max() < 0.02 < np.abs(other - np.roll(m, 3, 1)).max()
    angles = np.arange(20) * np.pi / 20
    geometry = recon.Geometry.parallel(angles, (1, 16))
    grid = recon.Grid.matching(geometry)
    moved = recon.Volume(np.ascontiguousarray(m.transpose(2, 0, 1)), grid)
    lines = recon.Projector(geometry, grid).forward(moved.data)
    made = bench.volumes(lines, geometry, moved)
    assert {name: len(each) for name, each in made.items()} == {"piccs": 4, "dtv": 4, "rest": 2, "start": 12}
    for each in (*made["piccs"], *made["rest"], made["dtv"][-1], made["start"][-1]):
        assert np.abs(each - moved.data).max() < 0.05
    assert np.abs(bench.of_series(lines, angles, lines, geometry) - moved.data).max() < 0.2


@pytest.mark.long  # two scans in real time
def test_open_pages(monkeypatch: Patch, tmp_path: Path) -> None:
    bench = script("test_open_pages")
    small(monkeypatch, bench, PAIRS=1, PAGES=1, VIEWS=24, SPAN=60)
    measured(bench.test_open_pages_cost_a_scan_nothing, tmp_path, 10.0)


def recon_of(scan: Path, angles: Path, output: Path) -> None:
    words = ["recon", str(scan), "-m", "fbp", "--quantity", "line-integrals", "--angles", str(angles), "--axis", "15.5"]
    succeeds(*words, "--no-report", "-o", str(output))
