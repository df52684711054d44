"""`beamline tune` and `align`."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.config.load import Config, config_folder, load
from beamline.config.planned import plan_of
from beamline.core.errors import InstrumentError, QualityError, ScanStopped
from beamline.core.stop import StopRequest
from beamline.features.tuning.align import Alignment, align
from beamline.features.tuning.tune import TARGET, evaluate, tune
from beamline.instrument.connect import connect
from beamline.monitor.references import ReferenceLimits
from drivers.base.frame import Frame, FrameKind
from drivers.orca_quest import LightPath
from simulators.frame.sensor import CONVERSION, OFFSET
from tests.beamline.acquired import assert_safe
from tests.beamline.ball_scan import shipped, with_scene
from tests.beamline.cli.small_scan import beamline
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import small

SHAPE = (96, 128)
BIAS, READ, GAIN, FULL = 120.0, 3.0, 4.0, 65535
PLAN = replace(plan_of(small()), exposure=0.1)


def counts(photons: NDArray[np.float64] | float, rng: np.random.Generator) -> NDArray[np.uint16]:
    light = GAIN * rng.poisson(np.broadcast_to(photons, SHAPE))
    return np.clip(BIAS + light + rng.normal(0, READ, SHAPE), 0, FULL).round().astype(np.uint16)


def frames(per_s: float, through: float, exposures: tuple[float, ...] = (0.1, 0.0125)) -> list[Frame]:
    """Two darks, and two flats and a view at each exposure; the beam falls to a third towards the right."""
    rng = np.random.default_rng(4)
    beam = per_s * np.linspace(1, 1 / 3, SHAPE[1])
    shots = [(FrameKind.DARK, 0.0, exposures[0])] * 2
    shots += [(FrameKind.FLAT, 1.0, t) for t in exposures for _ in range(2)]
    shots += [(FrameKind.PROJECTION, through, t) for t in exposures]
    return [
        Frame(counts(share * t * beam, rng), kind, i, i, i, 0.5, float(i), t)
        for i, (kind, share, t) in enumerate(shots)
    ]


@pytest.mark.parametrize("per_s", [8e4, 3e3])
def test_what_the_frames_hold_is_found(per_s: float) -> None:
    found = evaluate(frames(per_s, 0.3), PLAN, FULL, longest=10.0, limits=ReferenceLimits())
    assert (found.exposure, found.saturated, found.faults, found.angle) == (0.1, 0.0, (), 0.5)
    assert found.dark == pytest.approx(BIAS, abs=1)
    assert found.dark_noise == pytest.approx(READ, rel=0.1)
    assert found.gain == pytest.approx(GAIN, rel=0.05)
    assert found.photons == pytest.approx(per_s * 0.1 * 2 / 3, rel=0.06)
    assert found.transmission[1] == pytest.approx(0.3, rel=0.02)
    top = BIAS + GAIN * per_s * found.advised
    assert 0.95 * TARGET * FULL < top < 1.01 * TARGET * FULL  # noise in the brightest blocks errs to the safe side


def test_the_noise_predicted_is_that_of_line_integrals() -> None:
    """Against the scatter of line integrals of many views at the exposure advised."""
    found = evaluate(frames(8e4, 0.3), PLAN, FULL, longest=10.0, limits=ReferenceLimits())
    rng = np.random.default_rng(9)
    middle = found.advised * 8e4 * 2 / 3
    flat = np.mean([counts(middle, rng) for _ in range(PLAN.flats.count)], axis=0) - BIAS
    view = counts(0.3 * middle, rng) - BIAS
    assert np.std(np.log(flat / view)) == pytest.approx(found.noise[1], rel=0.05)


def test_a_saturated_exposure_gives_way_to_a_shorter_one() -> None:
    found = evaluate(frames(1e6, 0.3), PLAN, FULL, longest=10.0, limits=ReferenceLimits())
    assert found.exposure == 0.0125
    assert found.saturated == pytest.approx(1.0)
    assert found.transmission[1] == pytest.approx(0.3, rel=0.02)
    assert BIAS + GAIN * 1e6 * found.advised == pytest.approx(TARGET * FULL, rel=0.03)
    assert len(found.faults) == 1 and "are saturated" in found.faults[0]
    lines = found.lines()
    assert lines[-1].startswith("FAULT") and f"scan.exposure_s={found.advised:.4g}" in lines[-2]


@pytest.mark.parametrize(
    ("dark", "flat", "said"), [(1.0, 1.0, "no beam"), (0.8, 1.0, "exposed to the beam"), (0, 0, "no beam")]
)
def test_no_exposure_is_advised_where_the_shutter_is_at_fault(dark: float, flat: float, said: str) -> None:
    rng = np.random.default_rng(5)
    share = {FrameKind.DARK: dark, FrameKind.FLAT: flat, FrameKind.PROJECTION: 0.3 * flat}
    shots = [replace(frame, counts=counts(share[frame.kind] * 8e3, rng)) for frame in frames(1.0, 0.3, (0.1,))]
    found = evaluate(shots, PLAN, FULL, longest=10.0, limits=ReferenceLimits())
    assert np.isnan(found.advised) and said in found.faults[0]
    assert [line.split()[0] for line in found.lines()] == ["dark", "flat", "saturated", "exposure", "FAULT"]


def test_the_period_bounds_the_exposure() -> None:
    found = evaluate(frames(3e3, 0.3), PLAN, FULL, longest=0.2, limits=ReferenceLimits())
    assert found.advised == 0.2


def test_the_demo_is_tuned_with_its_own_camera() -> None:
    """The simulated camera's conversion is known; the exposure advised fills the range and does not saturate."""
    words = ["scan.exposure_s=0.095", "simulation.clock=virtual"]
    config = load(config_folder() / "demo.yaml", words, {})
    with connect(config) as instrument:
        home = instrument.devices.stage.position()
        found = tune(config, instrument, StopRequest(), lambda event: None, angle=0.7)
        assert instrument.devices.stage.position() == home
        assert not instrument.devices.shutter.is_open()
        assert found.angle == pytest.approx(0.7, abs=1e-4)
        assert found.gain == pytest.approx(1 / CONVERSION["standard"], rel=0.05)
        assert found.dark == pytest.approx(OFFSET["standard"], abs=2)
        assert found.saturated > 0.9 and found.exposure == pytest.approx(0.095 / 8, rel=0.01)
        again = load(config_folder() / "demo.yaml", [*words, f"scan.exposure_s={found.advised}"], {})
        assert math.isnan(found.x_rays)
        better = tune(again, instrument, StopRequest(), lambda event: None, angle=0.7)
    assert (better.saturated, better.faults) == (0.0, ())
    assert better.brightest == pytest.approx(TARGET * 65535, rel=0.02)
    assert better.advised == pytest.approx(found.advised, rel=0.03)


def test_x_rays_a_count_are_found_though_each_makes_several_electrons() -> None:
    """Variance 1 + g times that of single electrons: photon transfer finds 1 + g times the counts of an electron."""
    path = LightPath(absorbed=0.25, light=100, aperture=0.6, index=1.0, transmission=0.5)
    assert path.electrons == pytest.approx(100 * 0.1 * 0.5 * 0.73)
    rng, conversion = np.random.default_rng(1), 0.107
    counts = path.electrons * rng.poisson(0.25 * 1000, 200_000) + rng.normal(0, 1, 200_000)  # light of each is steady
    counts = rng.poisson(counts) / conversion
    gain = counts.var() / counts.mean()
    assert path.x_rays_per_count(gain) == pytest.approx(1000 / counts.mean(), rel=0.02)


def test_tune_states_the_x_rays_a_count() -> None:
    config = load(config_folder() / "demo.yaml", [
        "scan.exposure_s=0.02", "simulation.clock=virtual",
        "optics.light_path={absorbed: 0.2, light: 625, aperture: 0.4}",
    ], {})  # fmt: skip
    with connect(config) as instrument:
        found = tune(config, instrument, StopRequest(), lambda event: None)
    assert config.optics.light_path is not None
    assert found.x_rays == config.optics.light_path.x_rays_per_count(found.gain)
    assert any("X-rays" in line and "--photons-per-count" in line for line in found.lines())


def test_lost_frames_are_the_cameras_fault_and_the_instrument_is_safe() -> None:
    instrument = FakeInstrument(Faults(lost={1}))
    with pytest.raises(InstrumentError, match="camera: frames are missing"):
        tune(small(), instrument.connected(), StopRequest(), lambda event: None)
    assert_safe(instrument)


ROI = "devices.camera.roi=[1080, 1968, 144, 160]"


def _scene(offset: float) -> Config:
    """The battery with its axis `offset` sensor pixels right of the middle."""
    settings = shipped("simulated", "simulation.clock=virtual", ROI)
    scene: dict[str, Any] = {
        "phantom": {"kind": "battery", "seed": 3, "field_of_view": [0.6, 0.5], "n_particles": 150},
        "beam": {"photons_per_s": 2e5},
        "axis_offset_px": offset,
        "effects": ["photon_noise", "read_noise"],
    }
    return with_scene(settings, scene)


def _aligned(settings: Config, angle: float | None = None) -> Alignment:
    with connect(settings) as instrument:
        found = align(settings, instrument, StopRequest(), lambda event: None, angle)
        assert not instrument.devices.shutter.is_open()
        assert instrument.devices.stage.position() == 0
        return found


@pytest.mark.parametrize("offset", [-4.0, 6.3])
def test_the_axis_of_the_scene_is_found_with_its_correction(offset: float) -> None:
    found = _aligned(_scene(offset))
    assert found.offset == pytest.approx(offset, abs=0.2)
    assert found.axis_col == pytest.approx(79.5 + offset, abs=0.2)
    assert found.offset_mm == pytest.approx(offset * 4.6e-3, abs=1e-3)
    assert abs(found.lean) < 0.5 and found.detail > 0
    axis, tilt, detail = found.lines()
    assert ("right of the middle" in axis) is (offset > 0)
    assert f"move the axis {abs(found.offset_mm):.4g} mm towards {'lower' if offset > 0 else 'higher'} columns" in axis
    assert f"optics.axis_col={found.axis_col:.2f}" in axis
    assert "no correction" in tilt and "px is the width of the finest detail in the projection" in detail


def test_an_axis_that_leans_is_turned_back_by_what_is_said() -> None:
    leans = Alignment(79.5, 0.0, 0.0, math.radians(0.5), math.radians(0.05), 3.0, 0.0, 144)
    axis, tilt, _ = leans.lines()
    assert "move" not in axis
    assert "1.25 px between the first and the last row; rotate the axis by 0.500° clockwise" in tilt
    unknown = Alignment(79.5, 0.0, 0.0, math.nan, math.nan, math.nan, 0.0, 144)
    assert "not known" in unknown.lines()[1] and "not known" in unknown.lines()[2]


def test_views_without_contrast_are_refused_and_the_instrument_is_safe() -> None:
    instrument = FakeInstrument()
    with pytest.raises(QualityError, match="two projections do not match"):
        align(small(), instrument.connected(), StopRequest(), lambda event: None)
    assert_safe(instrument)


def test_a_stop_is_taken() -> None:
    stop = StopRequest()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if number == 5 else None)
    with pytest.raises(ScanStopped):
        align(small(), instrument.connected(), stop, lambda event: None)
    assert_safe(instrument)


DEMO = (
    str(config_folder() / "demo.yaml"),
    "--set",
    "simulation.clock=virtual",
    "--set",
    "devices.camera.roi=[1140, 1968, 24, 160]",
)


def test_references_that_would_stop_a_scan_end_with_6() -> None:
    result = beamline("tune", *DEMO, "--set", "scan.exposure_s=0.095", "--angle", "30", "--json")
    assert result.exit_code == 6
    done = json.loads(result.stdout.splitlines()[-1])
    assert done["event"] == "done" and done["saturated"] > 0.9 and 0.04 < done["advised"] < 0.07
    assert "0.05" in result.stderr.splitlines()[-1]
