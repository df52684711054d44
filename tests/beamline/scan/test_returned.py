"""Views on the way back: taken at angles of views, kept out of reconstructions, and compared with the first ones."""

import math
from pathlib import Path

import numpy as np
import pytest

from beamline.config.load import config_folder, load
from beamline.core.events import Event
from beamline.core.stop import ScanStopped, StopRequest
from beamline.features.files.validate import describe, validate
from beamline.projections.flagged_frames import returned_views
from beamline.projections.usable_views import usable_views
from beamline.scan.resume import open_for_resume
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from tests.beamline.fakes import COUNT, FakeInstrument, Faults, decode
from tests.beamline.ran import Ran

FIRST, N, BACK = 5, 16, 3  # the first view's row; 3 darks and 2 flats before, 2 flats after
WORDS = (f"scan.angles.views={N}", "scan.settle_s=0", f"scan.return_views={BACK}")
MIDDLE = {"fly": 11.25 / 0.5 * 0.02 / 2, "step": 0.0}  # degrees turned in half an exposure


@pytest.mark.parametrize("mode", ["fly", "step"])
def test_they_stand_at_angles_of_views_on_the_way_back(mode: str, tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(), *WORDS, f"scan.mode={mode}")
    ran.assert_safe()
    assert ran.of("frame")[-1].data["n"] == ran.of("frame")[-1].data["of"] == FIRST + N + BACK + 2
    with open_scan(ran.result.path) as source:
        frames = list(source.frames())
        back = frames[FIRST + N : FIRST + N + BACK]
        assert [frame.kind for frame in back] == [FrameKind.ALIGNMENT] * BACK
        assert [frame.kind for frame in frames[-2:]] == [FrameKind.FLAT] * 2
        for frame, view in zip(back, (15, 8, 0), strict=True):
            count, is_open, is_in, _ = decode(frame.counts)
            assert (is_open, is_in, frame.replaces) == (True, True, -1)
            assert frame.angle == pytest.approx(frames[FIRST + view].angle, abs=COUNT)
            assert math.degrees(count * COUNT - frame.angle) == pytest.approx(MIDDLE[mode], abs=0.01)
        assert usable_views(source, use_flags=True).frames.tolist() == list(range(FIRST, FIRST + N))
    facts = describe(ran.result.path)
    assert facts["kinds"] == {"alignment": BACK, "projection": N, "flat": 4, "dark": 3}
    assert [finding for finding in validate(ran.result.path) if finding.severity == "error"] == []


def test_one_that_gives_no_frame_is_a_warning(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(lost={FIRST + N + 1})), *WORDS)
    assert (ran.result.n_frames, ran.result.missing) == (FIRST + N + BACK + 1, ())
    assert "Of 3 views on the way back 1 gave no frame." in ran.warnings


def test_a_stopped_scan_takes_none_and_a_resumed_one_does(tmp_path: Path) -> None:
    stop = StopRequest()
    fake = FakeInstrument(at={FIRST + 6: lambda: stop.stop("enough")})
    ran = Ran(tmp_path, fake, *WORDS, "scan.mode=step", stop=stop)
    assert isinstance(ran.error, ScanStopped)
    with open_scan(ran.folder / "scan.h5") as source:
        assert FrameKind.ALIGNMENT not in source.image_key
    with open_for_resume(ran.folder) as series:
        result = run_scan(series.config, series, [], instrument=FakeInstrument().connected())
    with open_scan(result.path) as source:
        assert (source.image_key == FrameKind.ALIGNMENT).sum() == BACK
        assert (source.image_key == FrameKind.PROJECTION).sum() == N


SHIFT_UM = (9.2, -4.6, 4.6)  # x, y, z: 2 px, -1 px, 1 px


def test_a_jump_of_the_sample_is_measured(tmp_path: Path) -> None:
    """A view before the jump is displaced on the way back by x cos + y sin and z; one after it is not."""
    scene = {
        "phantom": {"kind": "battery", "field_of_view": [0.6, 0.5], "n_particles": 80, "seed": 7},
        "beam": {"photons_per_s": 2.5e5},
        "detector": {"shape": [144, 160]},
        "effects": [{"kind": "jump", "view": 40, "shift_um": [*SHIFT_UM]}, "photon_noise"],
    }
    words = (
        "scan.angles={scheme: fixed, views: 61, start_deg: 0, span_deg: 183}", "scan.mode=step", "scan.settle_s=0",
        "scan.exposure_s=0.02", "scan.return_views=4", f"simulation.scene={scene}", "simulation.clock=virtual",
        "recon.live=false",
    )  # fmt: skip
    events: list[Event] = []
    config = load(config_folder() / "simulated.yaml", words, environment={})
    result = run_scan(config, tmp_path, [events.append])
    with open_scan(result.path) as source:
        found = returned_views(source)
        pixel = source.pixel_size_mm
    assert found == list(result.returned)
    assert [round(math.degrees(view.angle)) for view in found] == [180, 120, 60, 0]
    x, y, z = (1e-3 * value / pixel for value in SHIFT_UM)
    for view in found:
        jumped = view.first - 20 < 40  # behind 20 darks and flats
        across = (x * np.cos(view.angle) + y * np.sin(view.angle)) * jumped
        assert (view.across, view.down) == pytest.approx((across, z * jumped), abs=0.02)
        assert view.moved is bool(jumped)
        assert view.pixel_mm == pixel
    (warning,) = [event.data["message"] for event in events if event.event == "warning"]
    assert warning.startswith("On the way back: 60°, frame")
    assert "mm across" in warning and "the sample has moved" in warning
    ended = next(event for event in events if event.event == "scan_done")
    assert '"returned": [{"frame":' in ended.to_json()
