"""Following a growing file: its volume, snapshots and stops, and what cannot be followed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Event
from beamline.projections.selection import Selection
from beamline.reconstruct import live_steps, snapshots
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.live_states import Feeds, WaitsForAxis, WaitsForReferences
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.writers.recon_file import read_reconstruction, write_reconstruction
from drivers.base.frame import Frame
from recon.assess.metrics import psnr
from recon.splatting.r2 import R2
from recon.voxels.direct import Fbp
from recon.warm_up import warm_up
from tests.beamline.reconstruct.growing_scan import (
    BRIEF,
    EPOCH,
    FIT,
    INTERLACED,
    RHYTHM,
    SCAN,
    ScanClock,
    close,
    follower_of,
    options,
    schedule,
)
from tests.beamline.scans import frames_of
from tests.messages import refused
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_volume_grows_with_the_scan(tmp_path: Path) -> None:
    warm_up()  # with kernels to be compiled the scan is over before the first look
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    target = OutputPaths(tmp_path / "recon.h5", tmp_path / "report.html")
    wanted = options(tmp_path, target=target, method=replace(FIT, seconds=4.0))
    metrics = reconstruct_file(wanted, events.append, clock).metrics

    names = [event.event for event in events]
    assert names[0] == "state"
    assert [event.data["state"] for event in events[:3]] == ["warming_up", "ready", "waiting"]
    watch = f"open {tmp_path / 'recon.live.png'}: the picture shows slices from the eighth projection on"
    assert watch in str(events[1].data["message"])
    assert '<a href="recon.live.png">' in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert names.count("recon_started") == 1
    assert "snapshot" in names
    drawn = [event.data for event in events if event.event == "slices"]
    assert drawn[0]["n_views"] == 8 and drawn[-1]["n_views"] == SCAN.angles.size
    assert names.index("slices") < names.index("snapshot")
    assert names[-1] == "done"
    steps = [event.data for event in events if event.data.get("stage") == "recon" and not event.data.get("unit")]
    views = [step["n_views"] for step in steps]  # the sweeps of the finish follow
    assert views == sorted(views)
    assert views[0] < 30  # it began before the scan had ended
    assert views[-1] == 30

    record = read_reconstruction(tmp_path / "recon.h5")
    assert record.parameters["n_views"] == 30
    assert {"ssim_weight", "tv_weight", "rates", "policy_every", "seconds_after_scan", "finish"} <= set(
        record.parameters
    )
    assert record.metrics == pytest.approx(metrics)
    truth = SCAN.truth(record.volume.grid)
    assert psnr(truth, record.volume.data) > 20
    assert metrics["residual"] < 0.1
    np.testing.assert_array_equal(record.history["n_views"], views)
    assert "<html" in (tmp_path / "report.html").read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recon.h5", "recon.live.png", "report.html", "scan.h5"]


@pytest.mark.slow
def test_the_last_round_can_be_ended_early_with_what_there_is(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))

    @contextmanager
    def at_the_end() -> Iterator[Callable[[], bool]]:
        yield lambda: any(event.data.get("state") == "finishing" for event in events)

    reconstruct_file(options(tmp_path, method=replace(FIT, seconds=1e5)), events.append, clock, at_the_end)
    assert events[-1].event == "done"
    parameters = read_reconstruction(tmp_path / "recon.h5").parameters
    assert parameters["ended_early"] and parameters["n_views"] == 30


@pytest.mark.parametrize(
    ("seconds", "told"),
    others_slow(
        [
            (3.0, "Stopped during the scan: the volume is reconstructed from the first {} projections."),
            (1.5, ""),  # seven views
            (np.inf, "Stopped: the volume is reconstructed from the first {} of 30 projections."),
        ]
    ),
)
def test_a_stop_delivers_the_views_so_far_if_they_make_a_volume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float, told: str
) -> None:
    """While the scan runs; and where it has ended, without waiting for all of its views."""
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    if np.isinf(seconds):
        close(clock)
        monkeypatch.setattr(live_steps, "BATCH_VIEWS", 8)

    @contextmanager
    def soon() -> Iterator[Callable[[], bool]]:
        yield lambda: clock.time > EPOCH + min(seconds, 1e5)

    wanted = options(tmp_path, method=replace(FIT, seconds=1e5))
    if not told:
        with pytest.raises(KeyboardInterrupt):
            reconstruct_file(wanted, events.append, clock, soon)
        assert not wanted.target.output.exists()
    else:
        reconstruct_file(wanted, events.append, clock, soon)
        parameters = read_reconstruction(tmp_path / "recon.h5").parameters
        n_views = int(parameters["n_views"])
        assert parameters["ended_early"] and 16 <= n_views < 30
        assert told.format(n_views) in [event.data["message"] for event in events if event.event == "warning"]
    close(clock)


@pytest.mark.slow
def test_a_scan_that_waits_is_waited_for_as_long_as_its_writer_lives(tmp_path: Path) -> None:
    clock = ScanClock()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED), pause=5 * RHYTHM.patience)
    reconstruct_file(options(tmp_path, method=BRIEF), lambda event: None, clock)
    assert read_reconstruction(tmp_path / "recon.h5").parameters["n_views"] == 30


@pytest.mark.slow
def test_snapshots_are_whole_volumes_while_the_scan_runs(tmp_path: Path) -> None:
    clock = ScanClock()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    seen: list[tuple[int, float]] = []
    unlearnt: list[float] = []

    def look(event: Event) -> None:
        if event.event == "snapshot":
            record = read_reconstruction(Path(event.data["path"]))
            assert record.parameters["n_views"] == event.data["n_views"]
            picture = Path(event.data["picture"])
            assert picture == tmp_path / "recon.live.png" and picture.read_bytes().startswith(b"\x89PNG")
            unlearnt.append(event.data["unlearnt"])
            seen.append((event.data["n_views"], psnr(SCAN.truth(record.volume.grid), record.volume.data)))

    reconstruct_file(options(tmp_path), look, clock)
    assert len(seen) >= 3
    assert seen[-1][0] > seen[0][0]
    assert max(quality for _, quality in seen) > 18
    known = [u for u in unlearnt if np.isfinite(u)]
    assert known[-1] < known[0] < 1  # of views that no step had seen
    assert (tmp_path / "recon.live.png").exists()  # the report links it
    assert not (tmp_path / "recon.snapshot.h5").exists()  # the volume is there


FRAMES = frames_of(INTERLACED)
SO_FAR = {"recon.snapshot.h5", "recon.live.png"}


@pytest.mark.parametrize(
    ("frames", "status", "said", "left"),
    [
        ([], None, "No scan began in .* within 3 s", set()),
        (
            FRAMES[:16],
            None,
            "is no longer being written.* and is not finished.*`beamline recover .*12 projections",
            SO_FAR,
        ),
        (FRAMES[:4], "stopped", "0 projections", set()),
        (FRAMES[:5], "stopped", "1 projection", set()),
        ([f for f in FRAMES if f.kind != 1], "complete", "The frames are counts, but flats are missing", set()),
    ],
    ids=["none", "dies", "no views", "one view", "no flats"],
)
def test_scans_that_make_no_volume(
    tmp_path: Path, frames: list[Frame], status: str | None, said: str, left: set[str]
) -> None:
    clock = ScanClock()
    if frames:
        schedule(clock, tmp_path / "scan.h5", [replace(f, index=i) for i, f in enumerate(frames)], status=status)
    with pytest.raises(DataError, match=said):
        reconstruct_file(options(tmp_path), lambda event: None, clock)
    assert {p.name for p in tmp_path.iterdir()} - {"scan.h5"} == left
    close(clock)


@pytest.mark.parametrize(
    "changes",
    [
        {"selection": Selection(views="fixed:5")},
        {"method": R2(steps=10)},
        {"truth": "missing.npz"},
    ],
)
def test_what_cannot_be_followed_is_refused_at_once(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        reconstruct_file(options(tmp_path, **changes), lambda event: None, ScanClock())
    assert list(tmp_path.iterdir()) == []


def test_an_existing_result_stays(tmp_path: Path) -> None:
    (tmp_path / "recon.h5").write_text("precious")
    with refused(DataError):
        reconstruct_file(options(tmp_path), lambda event: None, ScanClock())
    assert (tmp_path / "recon.h5").read_text() == "precious"


@pytest.mark.slow
def test_snapshots_a_viewer_holds_open_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = write_reconstruction

    def write(path: Path, record: object, *, replace: bool = False) -> None:
        if "snapshot" in path.name:
            raise DataError("the file is in use")
        real(path, record, replace=replace)  # type: ignore[arg-type]

    monkeypatch.setattr(snapshots, "write_reconstruction", write)
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(INTERLACED))
    reconstruct_file(options(tmp_path, method=BRIEF), events.append, clock)
    assert any("snapshot could not be written" in str(e.data.get("message")) for e in events)
    assert "snapshot" not in [e.event for e in events]
    assert h5py.is_hdf5(tmp_path / "recon.h5")


def _follower(folder: Path, clock: ScanClock, frames: list[Frame]) -> tuple[ScanFollower, list[Event]]:
    """Of a file that takes a frame a second, without an axis."""
    events: list[Event] = []
    schedule(clock, folder / "scan.h5", [replace(f, index=i) for i, f in enumerate(frames)], period=1.0)
    clock.sleep(1.0)
    wanted = options(folder, selection=Selection())
    return follower_of(wanted, clock, events), events


def test_it_waits_for_references_then_for_the_axis_then_feeds(tmp_path: Path) -> None:
    clock, frames = ScanClock(), frames_of(INTERLACED)
    follower, _ = _follower(tmp_path, clock, frames)
    states = []
    with follower.source:
        for n in (4, 1, 29):  # references, the first view, the others
            clock.sleep(n)
            assert follower.take_new_frames(False)
            states.append((type(follower.state), follower.n_views_taken))
        assert isinstance(follower.state, Feeds)
        assert follower.state.axis_col == pytest.approx(SCAN.axis_col, abs=0.5)
    close(clock)
    assert states == [(WaitsForReferences, 0), (WaitsForAxis, 0), (Feeds, 30)]


def test_without_a_projection_there_is_no_last_fit(tmp_path: Path) -> None:
    clock = ScanClock()
    follower, _ = _follower(tmp_path, clock, frames_of(INTERLACED))
    with follower.source:
        clock.sleep(40.0)
        follower.source.refresh()  # past the follower
        with refused(DataError):
            follower.end()
    close(clock)


def test_references_that_follow_the_views_are_waited_for_until_the_scan_has_ended(tmp_path: Path) -> None:
    clock, frames = ScanClock(), frames_of(INTERLACED)
    follower, events = _follower(tmp_path, clock, [*frames[4:], *frames[:4]])
    with follower.source:
        for _ in range(2):
            clock.sleep(20.0)
            follower.take_new_frames(False)
            assert isinstance(follower.state, WaitsForReferences)
        assert [event.data["state"] for event in events] == ["waiting"]
        follower.take_new_frames(True)
        assert isinstance(follower.state, Feeds) and follower.n_views_taken == 30
    close(clock)


def test_a_method_that_needs_all_views_waits_for_the_end(tmp_path: Path) -> None:
    clock, events = ScanClock(), list[Event]()
    schedule(clock, tmp_path / "scan.h5", frames_of(SCAN))
    wanted = options(tmp_path, method=Fbp(), selection=Selection(rows=(0, 1), axis_col=SCAN.axis_col))
    record = reconstruct_file(wanted, events.append, clock)
    assert record.method == "fbp" and record.parameters["n_views"] == SCAN.angles.size
    assert [e.data["state"] for e in events if e.event == "state"][:2] == ["waiting", "waiting"]  # for it, for its end
