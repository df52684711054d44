"""Composition root: a configuration becomes devices that scan, on a virtual clock, from trigger to the right angle."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline import config, devices
from beamline.config_models import Config
from beamline.dry_run import dry_run
from beamline.errors import ConfigError
from beamline.plan import Block
from beamline.stages import output_of
from beamline.stop import ScanAborted
from beamline.timeline import block_seconds, pass_ends
from drivers.clock import SystemClock
from drivers.dcam.options import DcamOptions
from drivers.errors import DeviceError, DeviceRefused
from drivers.manual import ManualSampleMover, ManualShutter
from drivers.protocols import TriggerSource
from recon.geometry import Geometry
from recon.volume import Grid
from simulators.clock import ScaledClock, VirtualClock
from simulators.phantom import Detector
from simulators.scene import load_scene

REPOSITORY = Path(__file__).parents[2]
# A ball off the axis and no effects: every frame is Beer-Lambert, so that its angle can be read off the picture.
BALL = {
    "phantom": {
        "kind": "solids",
        "solids": [
            {"kind": "ellipsoid", "semi_axes": [0.02, 0.02, 0.02], "attenuation": 30.0, "centre": [0.06, 0, 0.01]}
        ],
    },
    "beam": {"photons_per_s": 1.0e5},
}


def shipped(name: str, *overrides: str) -> Config:
    return config.load(config.config_folder() / f"{name}.yaml", overrides, {})


def small(*overrides: str) -> Config:
    loaded = shipped("simulated", "devices.camera.roi=[1136, 2028, 32, 40]", "simulation.clock=virtual", *overrides)
    simulation = loaded.simulation.model_copy(update={"scene": BALL})  # type: ignore[union-attr]
    return loaded.model_copy(update={"simulation": simulation})


def fly(bench: devices.Bench, block: Block, settings: Config) -> tuple[list[int], np.ndarray]:
    """The block's passes by hand, as acquisition does it: framestamps and counts [frame, row, col]."""
    stage, camera = bench.devices.stage, bench.devices.camera
    camera.configure(devices.camera_settings(settings, block.exposure, TriggerSource.EXTERNAL))
    stamps, images = [], []
    camera.arm(block.n)
    for train, (start, stop) in zip(block.trains, pass_ends(block), strict=True):
        stage.start_move(start, stage.limits.max_speed)
        stage.wait(60.0)
        stage.arm(train)
        stage.start_move(stop, block.speed)
        for _ in range(train.n):
            frame = camera.next_frame(10.0)
            stamps.append(frame.framestamp)
            images.append(frame.counts)
        stage.wait(60.0)
    camera.disarm()
    return stamps, np.array(images)


COMMON = "counts_per_turn: 360000, max_speed_deg_s: 30, acceleration_deg_s2: 60, low_deg: -20"
STAGES = {
    "pm16c": f"{{kind: pm16c, port: 'sim://pm16c', channel: 3, {COMMON}}}",
    "pm16c, 10 us": f"{{kind: pm16c, port: 'sim://pm16c', pulse_width_s: 1.0e-5, {COMMON}}}",
    "pm16c, an interval after": f"{{kind: pm16c, port: 'sim://pm16c', first_pulse: interval_after, {COMMON}}}",
    "pi_gcs": f"{{kind: pi_gcs, port: 'sim://pi_gcs', axis: A, trigger_line: 2, {COMMON}}}",
    "pi_gcs, a step after": f"{{kind: pi_gcs, port: 'sim://pi_gcs', first_pulse: step_after, {COMMON}}}",
    "zaber": f"{{kind: zaber, port: 'sim://zaber', device: 2, output: 3, {COMMON}}}",
    "pi_gcs, falling": f"{{kind: pi_gcs, port: 'sim://pi_gcs', active_high: false, firmware_pulse_s: 0.1, {COMMON}}}",
    "zaber, falling": f"{{kind: zaber, port: 'sim://zaber', active_high: false, {COMMON}}}",
    "zaber, toggled": f"{{kind: zaber, port: 'sim://zaber', toggle: true, {COMMON}}}",
    "zaber, unchained": f"{{kind: zaber, port: 'sim://zaber', chained: false, {COMMON}}}",
}


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
@pytest.mark.parametrize("angles", ["{scheme: fixed, views: 24}", "{scheme: interlaced, views: 24, passes: 3}"])
def test_every_stage_gives_the_planned_angles(stage: str, angles: str) -> None:
    """The stand-in of each controller behind the same configuration: as many frames as pulses, each at its count."""
    settings = small(
        f"devices.stage={stage}",
        f"devices.camera.trigger_polarity={'negative' if 'active_high: false' in stage else 'positive'}",
        *("devices.stage.low_deg=-60", f"scan.angles={angles}", "scan.period_s=2"),
    )
    worked = dry_run(settings)
    assert worked.timeline.violations == ()
    block = worked.timeline.views
    with devices.connect(settings) as bench:
        assert bench.devices.stage.limits == worked.stage
        bench.devices.shutter.open()
        stamps, images = fly(bench, block, settings)
        assert bench.devices.stage.remaining_pulses() in (0, None)
    assert stamps == list(range(block.n))
    scene, detector = load_scene(BALL), Detector((32, 40), 4.6e-3, 19.5, 15.5)
    exact = np.array([1e5 * 0.05 / 0.107 * np.exp(-scene.line_integrals(a, detector)) for a in block.angles])
    assert np.abs(images - exact).max() <= 0.5 + 1e-6 * exact.max()


@pytest.mark.parametrize("output", ["kind: pi_gcs, trigger_line", "kind: zaber, output"])
def test_an_output_that_a_simulated_controller_lacks_is_refused_in_words(output: str) -> None:
    kind, key = output.removeprefix("kind: ").split(", ")
    settings = small(f"devices.stage={{{output}: 9, port: 'sim://{kind}', {COMMON}}}")
    with pytest.raises(ConfigError, match=rf"{key}: the simulated {kind} controller has no such digital output"):
        devices.connect(settings)


@pytest.mark.parametrize("stage", ["pi_gcs", "zaber, falling"])
def test_a_simulated_camera_that_takes_the_other_edge_is_refused_with_the_one_it_needs(stage: str) -> None:
    """It would expose at every pulse's end; a real cable may have an inverter, so a real camera may."""
    falling = "falling" in stage
    other, needed = ("positive", "negative") if falling else ("negative", "positive")
    with pytest.raises(ConfigError, match=f"active_high {str(not falling).lower()} .* set trigger_polarity {needed}"):
        small(f"devices.stage={STAGES[stage]}", f"devices.camera.trigger_polarity={other}")
    real = shipped("instrument", "devices.camera.trigger_polarity=negative")
    assert real.devices.stage.active_high


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
@pytest.mark.parametrize("open_high", [True, False])
def test_a_shutter_on_the_stage_s_output_lets_the_beam_through(kind: str, open_high: bool) -> None:
    """The driver sets the controller's output; the simulated blade follows the cable, and the camera sees it."""
    settings = small(
        f"devices.stage={STAGES[kind]}",
        f"devices.shutter={{kind: stage_output, output: 4, open_high: {str(open_high).lower()}, settle_s: 0.25}}",
    )
    with devices.connect(settings) as bench:
        camera, shutter = bench.devices.camera, bench.devices.shutter
        camera.configure(devices.camera_settings(settings, 0.05, TriggerSource.SOFTWARE))
        camera.arm(4)

        def brightest() -> int:
            bench.clock.sleep(camera.timing.min_period)
            camera.software_trigger()
            return int(camera.next_frame(1.0).counts.max())

        shutter.close()
        assert (shutter.is_open(), brightest()) == (False, 0)
        before = bench.clock.now()
        shutter.open()
        assert bench.clock.now() - before == pytest.approx(0.25, abs=0.05)
        assert (shutter.is_open(), brightest()) == (True, round(1e5 * 0.05 / 0.107))
        shutter.close()
        assert (shutter.is_open(), brightest()) == (False, 0)


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
def test_a_shutter_never_sits_on_the_trigger_output(kind: str) -> None:
    settings = small(f"devices.stage={STAGES[kind]}")
    taken = {"pi_gcs": 2, "zaber": 3}[kind]
    with devices.connect(settings) as bench, pytest.raises(DeviceRefused, match=f"output {taken} gives the trigger"):
        output_of(settings.devices.stage, bench.devices.stage, taken)
    pm16c = small()
    with devices.connect(pm16c) as bench, pytest.raises(ConfigError, match="has no digital output"):
        output_of(pm16c.devices.stage, bench.devices.stage, 1)


@pytest.mark.parametrize(
    "angles",
    [
        "{scheme: fixed, views: 24}",
        "{scheme: fixed, views: 12, start_deg: 180, span_deg: -180}",
        "{scheme: interlaced, views: 24, passes: 4}",
        "{scheme: sector, views: 13, first_deg: 30, last_deg: 150}",
    ],
)
def test_a_fly_scan_sees_the_sample_at_the_planned_angles(angles: str) -> None:
    settings = small(f"scan.angles={angles}", "scan.period_s=2", "devices.stage.low_deg=-20")
    worked = dry_run(settings)
    assert worked.timeline.violations == ()
    block = worked.timeline.views
    with devices.connect(settings) as bench:
        assert isinstance(bench.clock, VirtualClock)
        bench.devices.shutter.open()
        began = bench.clock.now()
        stamps, images = fly(bench, block, settings)
        seconds = bench.clock.now() - began
    # Nothing but the polls of a standing stage separates the plan from the clock.
    assert seconds == pytest.approx(
        block_seconds(block, worked.stage, worked.camera, settle=0), abs=0.05 * len(block.trains)
    )
    assert stamps == list(range(block.n))
    # The ball's shadow stands at u = x cos(angle) on a detector of 4.6 um pixels whose middle is the axis.
    u = (np.arange(40) - 19.5) * 4.6e-3
    depth = -np.log(np.maximum(images, 1) / (1e5 * 0.05 / 0.107))
    centre = (depth.clip(0.05) - 0.05).sum(axis=1) @ u / (depth.clip(0.05) - 0.05).sum(axis=(1, 2))
    np.testing.assert_allclose(centre, 0.06 * np.cos(block.angles), atol=2e-4)
    # And each picture is the scene's at that angle, to the rounding of a count; a tenth of a step would show.
    scene, detector = load_scene(BALL), Detector((32, 40), 4.6e-3, 19.5, 15.5)
    exact = np.array([1e5 * 0.05 / 0.107 * np.exp(-scene.line_integrals(a, detector)) for a in block.angles])
    assert np.abs(images - exact).max() <= 0.5 + 1e-6 * exact.max()


def test_step_darks_and_flats() -> None:
    settings = small()
    with devices.connect(settings) as bench:
        stage, camera, shutter, sample = (
            getattr(bench.devices, name) for name in ("stage", "camera", "shutter", "sample")
        )
        camera.configure(devices.camera_settings(settings, 0.05, TriggerSource.SOFTWARE))
        camera.arm(3)

        def shot() -> np.ndarray:
            bench.clock.sleep(camera.timing.min_period)
            camera.software_trigger()
            return camera.next_frame(1.0).counts

        stage.start_move(math.pi / 2, stage.limits.max_speed)
        assert stage.wait(60.0) == pytest.approx(math.pi / 2, abs=1e-5)
        dark = shot()
        shutter.open()
        view = shot()
        sample.out()
        flat = shot()
    assert dark.max() == 0
    assert flat.min() == flat.max() == round(1e5 * 0.05 / 0.107)
    assert view.min() < 0.5 * flat.min()


@pytest.mark.parametrize(
    ("name", "stage"), [("simulated", "pm16c"), ("demo", "pm16c"), ("demo", "pi_gcs"), ("demo", "zaber")]
)
def test_dry_run_figures_are_what_the_devices_say(name: str, stage: str) -> None:
    """`describe` asks nobody, yet must agree with the stage and the camera once they are there."""
    settings = shipped(
        name,
        "simulation.clock=virtual",
        f"devices.stage={STAGES[stage]}",
        "devices.stage.acceleration_deg_s2=55",
    )
    limits, timing, to_counts = devices.describe(settings)
    with devices.connect(settings) as bench:
        stage, camera = bench.devices.stage, bench.devices.camera
        camera.configure(devices.camera_settings(settings, settings.scan.exposure_s, TriggerSource.EXTERNAL))
        assert stage.limits == limits
        assert camera.timing == timing
        assert [to_counts(a) for a in (-0.1, 0, 1, 6.3)] == [stage.to_counts(a) for a in (-0.1, 0, 1, 6.3)]
    assert math.degrees(limits.acceleration) <= 55  # the controller has only certain accelerations


def settings_clock(settings: Config) -> type:
    with devices.connect(settings) as bench:
        return type(bench.clock)


def test_clocks() -> None:
    assert settings_clock(shipped("demo")) is SystemClock
    assert settings_clock(shipped("demo", "simulation.clock=virtual")) is VirtualClock
    assert settings_clock(shipped("demo", "simulation.clock={speed: 4}")) is ScaledClock
    given = VirtualClock(5.0)
    with devices.connect(shipped("demo"), given) as bench:
        assert bench.clock is given


def test_benches_do_not_share_a_controller() -> None:
    settings = small()
    with devices.connect(settings) as one, devices.connect(settings) as two:
        one.devices.stage.start_move(1.0, one.devices.stage.limits.max_speed)
        one.devices.stage.wait(60.0)
        assert one.devices.stage.position() == pytest.approx(1.0, abs=1e-4)
        assert two.devices.stage.position() == 0.0


def test_close_frees_everything_twice() -> None:
    bench = devices.connect(small())
    bench.close()
    bench.close()
    with pytest.raises(DeviceError):
        bench.devices.stage.position()
    with pytest.raises(DeviceError):
        bench.devices.camera.arm(1)


def test_truth_lies_where_a_reconstruction_puts_it() -> None:
    """A region off the sensor's middle: z counts from the middle of the rows that were read."""
    settings = small("devices.camera.roi=[1136, 2020, 40, 56]")  # its rows' middle is 4 rows above the sensor's
    with devices.connect(settings) as bench:
        bench.devices.camera.configure(devices.camera_settings(settings, 0.05, TriggerSource.EXTERNAL))
        assert bench.truth is not None
        volume = bench.truth(Grid.matching(Geometry.parallel([0.0], (40, 56), 4.6e-3)))
    z, y, x = (
        float((volume.data.sum(axis=axes) * at).sum() / volume.data.sum())
        for axes, at in zip(((1, 2), (0, 2), (0, 1)), volume.grid.coordinates(), strict=True)
    )
    assert (x, y) == (pytest.approx(0.06, abs=1e-4), pytest.approx(0, abs=1e-4))
    # Rows 1136 ... 1175 have their middle at 1155.5, the sensor at 1151.5: z of the ball falls by 4 pixels.
    assert z == pytest.approx(0.01 - 4 * 4.6e-3, abs=1e-4)
    # A ball of 0.02 mm radius and 30 / mm.
    assert volume.data.sum() * 4.6e-3**3 == pytest.approx(30 * 4 / 3 * math.pi * 0.02**3, rel=0.01)


def test_settings_that_a_device_would_refuse() -> None:
    for change, message in (
        ("devices.camera.roi=[0, 0, 30, 40]", "devices.camera: roi .* must be in steps of 4"),
        ("scan.exposure_s=1e-7", "devices.camera: exposure 1e-07 s lies outside"),
        ("devices.stage.acceleration_deg_s2=0.001", "devices.stage: .*gentl"),
        ("devices.stage.max_speed_deg_s=5001", r"devices.stage: 5001 deg/s are 5001000 pulses/s, .* 1 to 5000000"),
        ("devices.stage.max_speed_deg_s=0.0001", "devices.stage: 0.0001 deg/s are 0 pulses/s"),
        ("devices.stage.pulse_width_s=0.005", "devices.stage: the trigger output has no pulses of 0.005 s; it has"),
        (f"devices.stage={STAGES['zaber'].replace('60,', '1e-9,')}", "devices.stage: 30 deg/s and 1e-09 deg/s² are"),
        (f"devices.stage={STAGES['pi_gcs'].replace('60,', '1e-9,')}", "devices.stage: .* must be "),
    ):
        with pytest.raises(ConfigError, match=message):
            devices.describe(small(change))
    wrong = small().model_copy(
        update={
            "simulation": config.load(  # a scene that is none
                config.config_folder() / "simulated.yaml", ("simulation.scene={phantom: 7}",), {}
            ).simulation
        }
    )
    for call in (devices.describe, devices.connect):
        with pytest.raises(ConfigError, match=r"simulation\.scene: "):
            call(wrong)


class _Stage:
    """Stands in for a stage on a port that this computer has not."""

    name = "stage"

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1


def test_instrument_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stage is freed where the camera does not open; shutter and sample are the operator's."""
    stage, made = _Stage(), []
    monkeypatch.setattr(devices, "make_stage", lambda *args: stage)
    with pytest.raises(DeviceError, match="camera"):
        devices.connect(shipped("instrument", "devices.camera.library=/nowhere/libdcamapi.so"))
    assert stage.closed == 1

    class Camera(_Stage):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__()
            made.append((args, kwargs))

    monkeypatch.setattr("drivers.dcam.camera.DcamCamera", Camera)
    asked: list[str] = []
    bench = devices.connect(shipped("instrument", "devices.camera.index=1"), ask=asked.append)
    assert made[0][0] == (None, 1)
    assert made[0][1]["options"] == DcamOptions(ring_bytes=1_000_000_000)
    assert isinstance(bench.devices.shutter, ManualShutter)
    assert isinstance(bench.devices.sample, ManualSampleMover)
    assert bench.truth is None
    bench.devices.shutter.open()
    assert asked == ["Open the beam shutter."]
    bench.close()
    assert stage.closed == 2


def test_every_camera_option_reaches_the_driver(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Values that are no default, one for each option that the driver has."""
    waited: list[float] = []

    class Camera(_Stage):
        def __init__(self, library: Path, index: int, *, clock: object, options: DcamOptions) -> None:
            super().__init__()
            self.library, self.options = library, options
            made.append(self)

        def wait_until_cold(self, timeout: float, progress: Callable[[float, str], None]) -> None:
            waited.append(timeout)
            progress(-19.5, "busy")

    made: list[Camera] = []
    monkeypatch.setattr(devices, "make_stage", lambda *args: _Stage())
    monkeypatch.setattr("drivers.dcam.camera.DcamCamera", Camera)
    said = {
        "library": "/opt/libdcamapi.so",
        "trigger_active": "level",
        "trigger_mode": "start",
        "trigger_polarity": "negative",
        "trigger_times": 3,
        "trigger_delay_s": 0.5,
        "global_exposure": "global_reset",
        "hot_pixels": "aggressive",
        "exposure_tolerance": 0.1,
        "ring_mb": 50,
        "cool_s": 90,
    }
    changes = [f"devices.camera.{key}={value}" for key, value in said.items()]
    devices.connect(shipped("instrument", "scan.mode=step", *changes)).close()
    assert "-19.5 °C, its cooler says busy" in capsys.readouterr().err
    (camera,) = made
    assert camera.library == Path("/opt/libdcamapi.so")
    default = DcamOptions()
    for field in dataclasses.fields(DcamOptions):
        value = getattr(camera.options, field.name)
        assert value != getattr(default, field.name), field.name
        key = {"trigger_delay": "trigger_delay_s", "ring_bytes": "ring_mb"}.get(field.name, field.name)
        assert value == said[key] * (1_000_000 if key == "ring_mb" else 1)
    assert waited == [90]


def test_a_stop_ends_the_wait_for_a_cold_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signals only set the stop request, so that the wait has to look at it; all that is open is closed again."""
    stage, looks, heeded = _Stage(), itertools.count(1), 3

    class Camera(_Stage):
        def wait_until_cold(self, timeout: float, progress: Callable[[float, str], None]) -> None:
            while True:
                progress(20.0, "busy")

    def heed() -> None:
        if next(looks) == heeded:
            raise ScanAborted("Interrupted")

    camera = Camera()
    monkeypatch.setattr(devices, "make_stage", lambda *args: stage)
    monkeypatch.setattr(devices, "make_camera", lambda *args: camera)
    with pytest.raises(ScanAborted):
        devices.connect(shipped("instrument", "devices.camera.cool_s=900"), heed=heed)
    assert next(looks) == heeded + 1
    assert stage.closed == camera.closed == 1


def test_a_beam_monitor_is_part_of_the_bench(tmp_path: Path) -> None:
    with devices.connect(small()) as bench:
        assert bench.beam_monitor is None
    transcript = tmp_path / "electrometer.txt"
    chosen = f"{{kind: electrometer, port: 'sim://electrometer', scale: 1e9, unit: nA, transcript: '{transcript}'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as bench:
        assert bench.beam_monitor is not None
        reading = bench.beam_monitor.reading()
        assert (reading.value, reading.unit) == (pytest.approx(1.0), "nA")
        assert abs(reading.time - bench.clock.now()) < 1
    with pytest.raises(DeviceError):
        bench.beam_monitor.reading()
    assert b"READ?" in transcript.read_bytes()
    page = tmp_path / "ring.txt"
    page.write_text("I = 99.5 mA", encoding="utf-8")
    chosen = f"{{kind: ring_current, url: '{page.as_uri()}', pattern: 'I = ([0-9.]+) mA'}}"
    with devices.connect(small(f"devices.beam_monitor={chosen}")) as bench:
        assert bench.beam_monitor is not None
        assert bench.beam_monitor.reading().value == 99.5


def test_a_stage_keeps_a_transcript_where_it_is_asked_to(tmp_path: Path) -> None:
    file = tmp_path / "stage.txt"
    with devices.connect(small(f"devices.stage.transcript={file}")) as bench:
        bench.devices.stage.position()
    assert b"PS?0" in file.read_bytes()


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match="COM_NONE"):
        devices.connect(shipped("instrument", "devices.stage.port=COM_NONE"))


def test_limits_hold() -> None:
    with devices.connect(small("devices.stage.high_deg=90")) as bench, pytest.raises(DeviceRefused):
        bench.devices.stage.start_move(math.pi, 0.1)
