"""Laterally offset projections: after the ordinary ones, the sample is moved across the beam to show all of it."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.config.models import Config
from beamline.config.planned import offset_places, plan_of
from beamline.core.errors import ConfigError, ScanStopped
from beamline.core.events import Event
from beamline.core.stop import StopRequest
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe, validate
from beamline.plan.timeline import describe as lines_of
from beamline.projections.corrections.poses import PosesOfFile
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.reconstruct.run import views_for
from beamline.reconstruct.scan_facts import MadeVolume
from beamline.reconstruct.volume_checks import check_volume
from beamline.scan.dry_run import dry_run
from beamline.scan.resume import open_for_resume
from beamline.scan.run import run_scan
from beamline.storage.pose_table import read_poses
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.writers import layout
from drivers.base.clock import SystemClock
from drivers.base.frame import FrameKind
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv
from tests.beamline.ball_scan import COMMON, shipped, with_scene
from tests.beamline.scans import seal
from tests.slow_cases import others_slow

# A can of 2.8 fields with a ball near its wall, which no ordinary view at 0 degrees shows.
PIXEL, COLS, VIEWS = 4.6e-3, 40, 12
FIELD = PIXEL * COLS
X, Y = 0.2, 0.05
SCENE = {
    "phantom": {
        "kind": "solids",
        "solids": [
            {"kind": "cylinder", "radius": 1.4 * FIELD, "height": 1.0, "attenuation": 3.0},
            {"kind": "ellipsoid", "semi_axes": [0.03] * 3, "attenuation": 20.0, "centre": [X, Y, 0.01]},
        ],
    },
    "beam": {"photons_per_s": 1.0e5},
    "effects": ["photon_noise"],
}
SHORT = (
    f"scan.angles={{scheme: fixed, views: {VIEWS}}}", "scan.flats={count: 2, at: both}", "scan.darks={count: 2}",
    "devices.camera.roi=[1136, 2028, 32, 40]", "simulation.clock=virtual", "recon.live=false", "scan.mode=step",
    "scan.period_s=0.6", "devices.stage.low_deg=-60",
)  # fmt: skip
WIDE = ("scan.offset_views=2", f"sample.diameter_mm={2.8 * FIELD}")
STEPS = (-1.8, -0.9, 0.9, 1.8)  # fields
FIRST = 4 + VIEWS  # row of the first offset view


def motor(mm_per_deg: float, high: float = 25) -> str:
    """A sample mover on a linear axis."""
    stage = f"{{kind: epics, port: 'sim://epics', unit: mm, high_deg: {high}, {COMMON}}}"
    return (
        f"devices.sample_mover={{kind: stage, in_deg: 1, out_deg: 12, mm_per_deg: {mm_per_deg}, speed_deg_s: 10, "
        f"stage: {stage}}}"
    )


@pytest.fixture(scope="module")
def wide_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a scan with offset views, for tests that only read it."""
    return run_scan(asked(*WIDE), tmp_path_factory.mktemp("runs"), []).path


def asked(*words: str) -> Config:
    return with_scene(shipped("simulated", *SHORT, *words), SCENE)


def prepared(path: Path) -> tuple[PreparedProjections, list[str]]:
    told: list[str] = []
    with open_scan(path) as source:
        return prepare_projections(select(source, Selection(axis_col=(COLS - 1) / 2)), told.append), told


@pytest.mark.parametrize(
    ("fields", "steps"),
    [(1.05, 1), (1.5, 1), (2.6, 1), (2.8, 2), (4.4, 2), (4.6, 3)],
)
def test_the_sample_stands_at_every_nine_tenths_of_the_field_until_air_shows(fields: float, steps: int) -> None:
    places = offset_places(asked("scan.offset_views=4", f"sample.diameter_mm={fields * FIELD}"))
    expected = [0.9 * FIELD * k for k in range(-steps, steps + 1) if k]
    assert places == pytest.approx(expected)
    assert places[-1] + FIELD / 2 >= fields * FIELD / 2 + 0.05 * FIELD > places[-1] - 0.9 * FIELD + FIELD / 2


def test_an_axis_beside_the_middle_takes_more_steps() -> None:
    words = ("scan.offset_views=4", f"sample.diameter_mm={2.6 * FIELD}")
    assert len(offset_places(asked(*words))) == 2
    assert len(offset_places(asked(*words, "optics.axis_col=25"))) == 4


def test_the_dry_run_counts_them() -> None:
    plain, wide = dry_run(asked()), dry_run(asked(*WIDE))
    frames = 2 * len(STEPS)
    assert wide.timeline.n_frames == plain.timeline.n_frames + frames
    grown = wide.timeline.total_bytes / plain.timeline.total_bytes
    assert grown == pytest.approx(wide.timeline.n_frames / plain.timeline.n_frames)
    # Eight frames, and moves by 165 and then seven times 90 degrees at 30 degrees a second, less the way home from 165.
    assert wide.timeline.duration - plain.timeline.duration == pytest.approx(32, abs=6)
    text = "\n".join(lines_of(wide.plan, wide.timeline, wide.stage, wide.camera))
    assert text.count("offset_view") == 4
    assert "-0.3312, -0.1656, +0.1656, +0.3312 mm across the beam" in text
    assert plan_of(asked(*WIDE)).n_views == VIEWS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scan.offset_views=4",), "set sample.diameter_mm"),
        ((*WIDE, "devices.sample_mover={kind: stage, in_deg: 1, out_deg: 12, stage: "
          f"{{kind: epics, port: 'sim://epics', {COMMON}}}}}"), "set devices.sample_mover.kind to stage"),
        (("scan.offset_views=4", "sample.diameter_mm=0.1"), "field of view of 0.184 mm shows all of a sample"),
        ((*WIDE, motor(0.01)), r"-0.3312 mm, -32.12 is beyond the limits of the stage of this device, -20"),
        (("scan.offset_views=4", "sample.diameter_mm=0"), "sample.diameter_mm"),
    ],
    ids=["no diameter", "no axis", "all in the field", "out of reach", "no size"],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_a_sentence(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=said) as refused:
        asked(*words)
    assert len(str(refused.value).splitlines()) == 1


def test_a_cone_is_refused() -> None:
    cone = {**SCENE, "beam": {"photons_per_s": 1e5, "sod": 50.0, "sdd": 100.0}}
    with pytest.raises(ConfigError, match="offset_views needs a parallel beam"):
        dry_run(with_scene(asked(*WIDE), cone))


@pytest.mark.parametrize(
    "words",
    [(), *(pytest.param((word,), marks=pytest.mark.slow) for word in ("scan.mode=fly", motor(-1.0)))],
    ids=["step", "fly", "motor"],
)
def test_triggers_frames_and_rows_are_one(words: tuple[str, ...], tmp_path: Path) -> None:
    events: list[Event] = []
    scan = run_scan(asked(*WIDE, *words), tmp_path, [events.append])
    rows = slice(FIRST, FIRST + 8)
    planned = sum(event.data["n"] for event in events if event.event == "block_started")
    assert (scan.n_frames, scan.missing) == (planned, ()) == (FIRST + 8 + 2, ())
    assert {check: levels for check, levels in scan.flags.items() if set(levels) != {"info"}} == {}
    with h5py.File(scan.path) as file:
        assert file[layout.X_TRANSLATION][rows] == pytest.approx(FIELD * np.repeat(STEPS, 2))
        assert not np.delete(file[layout.X_TRANSLATION][()], rows).any()
        assert file[layout.X_TRANSLATION].attrs["units"] == "mm"
        assert (file[layout.IMAGE_KEY][rows] == 0).all() and (file[layout.KIND][rows] == -1).all()
        assert file[layout.ANGLE][rows] == pytest.approx(np.tile([0, 90], 4), abs=1e-3)
        assert len(file["/exchange/data"]) == VIEWS
        assert {len(file[path]) for path in (layout.DATA, *layout.growing(file))} == {scan.n_frames}
    assert describe(scan.path)["kinds"] == {"projection": VIEWS, "offset_view": 8, "flat": 4, "dark": 2}
    assert [finding for finding in validate(scan.path) if finding.severity == "error"] == []
    with h5py.File(scan.path, "r+") as file:  # a view that was taken again before them has the trigger of the first
        file[layout.TRIGGER][FIRST - 1], file[layout.FRAMESTAMP][FIRST - 1] = file[layout.TRIGGER][FIRST], 0
        file[layout.REPLACES][FIRST - 1] = FIRST - 2
        seal(file)
    assert [finding for finding in validate(scan.path) if finding.rule == "framestamps"] == []


@pytest.mark.parametrize("moved_by", others_slow(["simulated", "motor"]))
def test_the_sample_is_where_the_geometry_says(moved_by: str, wide_scan: Path, tmp_path: Path) -> None:
    """The ball's image in the frames of the simulator, beside the column that the shifts predict."""
    scan = wide_scan if moved_by == "simulated" else run_scan(asked(*WIDE, motor(-1.0)), tmp_path, []).path
    views, told = prepared(scan)
    geometry, data = views.geometry, views.seen.data
    assert geometry.shifts[:, 0] == pytest.approx([0.0] * VIEWS + [COLS * step for step in np.repeat(STEPS, 2)])
    assert not geometry.shifts[:, 1].any()
    u = (X * np.cos(geometry.angles) + Y * np.sin(geometry.angles)) / PIXEL
    cols = geometry.axis_col + geometry.shifts[:, 0] + u
    found = {}
    for view in np.flatnonzero((cols > 8) & (cols < COLS - 9)):
        ball = data[view, 8:18].mean(axis=0) - data[view, -6:].mean(axis=0)  # of rows with the ball, less the can alone
        found[view] = float((ball * np.arange(COLS)).sum() / ball.sum()) - cols[view]
    assert any(view >= VIEWS for view in found) and any(view < VIEWS for view in found)
    assert list(found.values()) == pytest.approx(np.zeros(len(found)), abs=0.4)
    assert not any("beside the rotation axis" in sentence for sentence in told)  # as one that leaves on one side does


def test_direct_methods_leave_them_out_and_others_get_them(wide_scan: Path) -> None:
    views, _ = prepared(wide_scan)
    assert [views_for(method, views.views).geometry.n_views for method in (Fbp(), FistaTv())] == [VIEWS, VIEWS + 8]


def test_stepped_views_of_another_program_come_by_poses(wide_scan: Path, tmp_path: Path) -> None:
    with h5py.File(wide_scan) as ours, h5py.File(tmp_path / "other.nxs", "w") as file:
        for name in ("detector/data", "detector/image_key"):
            file[f"entry/instrument/{name}"] = ours[f"entry/instrument/{name}"][()]
        file["entry/sample/rotation_angle"] = ours["entry/sample/rotation_angle"][()]
        file["entry/sample/rotation_angle"].attrs["units"] = "deg"
        across = ours["entry/sample/x_translation"][()] / PIXEL
        file["entry/instrument/detector/x_pixel_size"] = PIXEL
        file["entry/instrument/detector/x_pixel_size"].attrs["units"] = "mm"
        file["entry"].attrs["NX_class"], file["entry/definition"] = "NXentry", "NXtomo"
        for name, kind in (("instrument", "NXinstrument"), ("instrument/detector", "NXdetector")):
            file[f"entry/{name}"].attrs["NX_class"] = kind
    rows = [f"{row},{shift},0" for row, shift in enumerate(across)]
    poses = tmp_path / "poses.csv"
    poses.write_text("\n".join(["frame,shift_col_px,shift_row_px", *rows]), encoding="utf-8")
    selection = Selection(axis_col=19.5).with_steps(PosesOfFile(read_poses(str(poses))))
    with open_scan(tmp_path / "other.nxs") as source:
        other = prepare_projections(select(source, selection), lambda sentence: None)
    views, _ = prepared(wide_scan)
    assert other.geometry.shifts == pytest.approx(views.geometry.shifts)
    assert other.centred.geometry.n_views == VIEWS
    assert other.seen.data == pytest.approx(views.seen.data)


@pytest.mark.slow
@pytest.mark.parametrize("at", ["offset_view", "projection"])
def test_a_scan_that_is_resumed_has_them_and_its_copy_too(at: str, tmp_path: Path) -> None:
    stop = StopRequest()

    def hear(event: Event) -> None:
        if event.event == "block_started" and event.data["kind"] == at:
            stop.stop("enough")

    with pytest.raises(ScanStopped):
        run_scan(asked(*WIDE), tmp_path, [hear], stop)
    (folder,) = tmp_path.iterdir()
    with open_scan(folder / "scan.h5") as source:
        assert ((source.table.kinds == FrameKind.PROJECTION).sum() == VIEWS) == (at == "offset_view")
    with open_for_resume(folder) as series:
        joined = run_scan(series.config, series, []).path
    ingest(joined, tmp_path / "copy.h5")
    for path in (joined, tmp_path / "copy.h5"):
        views, _ = prepared(path)
        assert views.geometry.shifts[-8:, 0] == pytest.approx(COLS * np.repeat(STEPS, 2))
        assert (views.geometry.shifts[:VIEWS] == 0).all()


def test_the_record_names_all_views_used_and_ordinary_ones_judge_the_volume(
    wide_scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[int] = []

    def noted(made: MadeVolume, *more: Any) -> Any:
        judged.append(made.prepared.geometry.n_views)
        return check_volume(made, *more)

    monkeypatch.setattr("beamline.reconstruct.record.check_volume", noted)
    used = []
    for method in (Fbp(), FistaTv(iterations=2, tv_weight=0.01)):
        target = OutputPaths(tmp_path / f"{method.name}.h5", None)
        options = ReconOptions(SourceOptions(wide_scan), target, Selection(axis_col=(COLS - 1) / 2), method=method)
        record = reconstruct_file(options, lambda event: None, SystemClock())
        used.append(len(np.atleast_1d(record.parameters["view_frames"])))
    assert (used, judged) == ([VIEWS, VIEWS + 8], [VIEWS, VIEWS])
