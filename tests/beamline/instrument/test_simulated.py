"""Simulated devices scan like real ones: trigger, right angle, beam, and the requested clock."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.config.models import Config, Speed
from beamline.config.planned import camera_settings
from beamline.core.errors import ConfigError
from beamline.instrument import connect as devices
from beamline.instrument.simulated import clock_of
from beamline.plan.plan import Block
from beamline.plan.timeline import block_seconds
from beamline.scan.dry_run import dry_run
from drivers.base.clock import SystemClock
from drivers.base.protocols import TriggerSource
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from simulators.devices.clock import ScaledClock, VirtualClock
from simulators.frame.shot import Detector
from simulators.scenes.scene import load_scene
from tests.beamline.ball_scan import BALL, COMMON, STAGES, fly, shipped, small
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("simulated_zaber")


def _seen(block: Block) -> NDArray[np.float64]:
    """Angles in the middle of the exposures of 50 ms, which begin at the pulses: a scene without blur shows these."""
    return block.angles + np.sign(block.angles[1] - block.angles[0]) * block.speed * 0.05 / 2


def assert_pictures(images: NDArray[np.uint16], block: Block) -> None:
    """Each is the scene's at its angle, to the rounding of a count; a tenth of a step would show."""
    scene, detector = load_scene(BALL), Detector((32, 40), 4.6e-3, 19.5, 15.5)
    exact = np.array([1e5 * 0.05 / 0.107 * np.exp(-scene.sample.line_integrals(a, detector)) for a in _seen(block)])
    assert np.abs(images - exact).max() <= 0.5 + 1e-6 * exact.max()


@pytest.mark.parametrize("stage", others_slow(STAGES.values(), 4), ids=STAGES)
def test_every_stage_gives_the_planned_angles(stage: str) -> None:
    """The stand-in of each controller behind the same configuration: as many frames as pulses, each from its count."""
    settings = small(
        f"devices.stage={stage}",
        f"devices.camera.trigger_polarity={'negative' if 'active_high: false' in stage else 'positive'}",
        *("devices.stage.low_deg=-60", "scan.angles={scheme: interlaced, views: 24, passes: 3}", "scan.period_s=2"),
    )
    worked = dry_run(settings)
    assert worked.timeline.violations == ()
    block = worked.timeline.views
    with devices.connect(settings) as instrument:
        assert instrument.devices.stage.limits == worked.stage
        instrument.devices.shutter.open()
        stamps, images = fly(instrument, block, settings)
    assert stamps == list(range(block.n))
    assert_pictures(images, block)


@pytest.mark.parametrize("output", ["kind: pi_gcs, trigger_line", "kind: zaber, output"])
def test_an_output_that_a_simulated_controller_lacks_is_refused_in_words(output: str) -> None:
    kind, _ = output.removeprefix("kind: ").split(", ")
    settings = small(f"devices.stage={{{output}: 9, port: 'sim://{kind}', {COMMON}}}")
    with pytest.raises(ConfigError, match=r"has 1 to 4"):
        devices.connect(settings)


@pytest.mark.parametrize("stage", ["pi_gcs", "zaber, falling"])
def test_a_simulated_camera_that_takes_the_other_edge_is_refused_with_the_one_it_needs(stage: str) -> None:
    """It would expose at every pulse's end; a real cable may have an inverter, so a real camera may."""
    falling = "falling" in stage
    other, needed = ("positive", "negative") if falling else ("negative", "positive")
    with pytest.raises(ConfigError, match=f"active_high {str(not falling).lower()} .* Set trigger_polarity {needed}"):
        small(f"devices.stage={STAGES[stage]}", f"devices.camera.trigger_polarity={other}")
    real = shipped("instrument", "devices.camera.trigger_polarity=negative")
    assert real.devices.stage.settings.active_high


@pytest.mark.parametrize("kind", ["pi_gcs", "zaber"])
@pytest.mark.parametrize("open_high", [True, False])
def test_a_shutter_on_the_stage_s_output_lets_the_beam_through(kind: str, open_high: bool) -> None:
    """The driver sets the controller's output; the simulated blade follows the cable, and the camera sees it."""
    settings = small(
        f"devices.stage={STAGES[kind]}",
        f"devices.shutter={{kind: stage_output, output: 4, open_high: {str(open_high).lower()}, settle_s: 0.25}}",
    )
    with devices.connect(settings) as instrument:
        camera, shutter = instrument.devices.camera, instrument.devices.shutter
        camera.configure(camera_settings(settings, 0.05, TriggerSource.SOFTWARE))
        camera.arm(4)

        def brightest() -> int:
            instrument.clock.sleep(camera.timing.min_period)
            camera.software_trigger()
            return int(camera.next_frame(1.0).counts.max())

        shutter.close()
        assert (shutter.is_open(), brightest()) == (False, 0)
        before = instrument.clock.now()
        shutter.open()
        assert instrument.clock.now() - before == pytest.approx(0.25, abs=0.05)
        assert (shutter.is_open(), brightest()) == (True, round(1e5 * 0.05 / 0.107))
        shutter.close()
        assert (shutter.is_open(), brightest()) == (False, 0)


@pytest.mark.parametrize(
    "angles",
    [
        "{scheme: fixed, views: 24}",
        "{scheme: fixed, views: 12, start_deg: 180, span_deg: -180}",
        "{scheme: sector, views: 13, first_deg: 30, last_deg: 150}",
    ],
)
def test_a_fly_scan_sees_the_sample_at_the_planned_angles(angles: str) -> None:
    settings = small(f"scan.angles={angles}", "scan.period_s=2", "devices.stage.low_deg=-20")
    worked = dry_run(settings)
    assert worked.timeline.violations == ()
    block = worked.timeline.views
    with devices.connect(settings) as instrument:
        assert isinstance(instrument.clock, VirtualClock)
        instrument.devices.shutter.open()
        began = instrument.clock.now()
        stamps, images = fly(instrument, block, settings)
        seconds = instrument.clock.now() - began
    # Nothing but the polls of a standing stage separates the plan from the clock.
    assert seconds == pytest.approx(
        block_seconds(block, worked.stage, worked.camera, settle=0), abs=0.05 * len(block.trains)
    )
    assert stamps == list(range(block.n))
    assert_pictures(images, block)


def test_step_darks_and_flats() -> None:
    settings = small()
    with devices.connect(settings) as instrument:
        stage, camera, shutter, sample = (
            getattr(instrument.devices, name) for name in ("stage", "camera", "shutter", "sample")
        )
        camera.configure(camera_settings(settings, 0.05, TriggerSource.SOFTWARE))
        camera.arm(3)

        def shot() -> np.ndarray:
            instrument.clock.sleep(camera.timing.min_period)
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


def settings_clock(settings: Config) -> type:
    with devices.connect(settings) as instrument:
        return type(instrument.clock)


def test_clocks() -> None:
    assert settings_clock(shipped("demo")) is SystemClock
    assert settings_clock(shipped("demo", "simulation.clock=virtual")) is VirtualClock
    assert settings_clock(shipped("demo", "simulation.clock={speed: 4}")) is ScaledClock
    given = VirtualClock(5.0)
    with devices.connect(shipped("demo"), given) as instrument:
        assert instrument.clock is given


@pytest.mark.slow
def test_truth_lies_where_a_reconstruction_puts_it() -> None:
    """A region off the sensor's middle: z counts from the middle of the rows that were read."""
    settings = small("devices.camera.roi=[1136, 2020, 40, 56]")  # its rows' middle is 4 rows above the sensor's
    with devices.connect(settings) as instrument:
        instrument.devices.camera.configure(camera_settings(settings, 0.05, TriggerSource.EXTERNAL))
        assert instrument.truth is not None
        volume = instrument.truth(Grid.matching(Geometry.parallel([0.0], (40, 56), pixel_pitch=4.6e-3)))
    z, y, x = (
        float((volume.data.sum(axis=axes) * at).sum() / volume.data.sum())
        for axes, at in zip(((1, 2), (0, 2), (0, 1)), volume.grid.coordinates(), strict=True)
    )
    assert (x, y) == (pytest.approx(0.06, abs=1e-4), pytest.approx(0, abs=1e-4))
    # Rows 1136 ... 1175 have their middle at 1155.5, the sensor at 1151.5: z of the ball falls by 4 pixels.
    assert z == pytest.approx(0.01 - 4 * 4.6e-3, abs=1e-4)
    # A ball of 0.02 mm radius and 30 / mm.
    assert volume.data.sum() * 4.6e-3**3 == pytest.approx(30 * 4 / 3 * math.pi * 0.02**3, rel=0.01)


@pytest.mark.parametrize("kind", ["virtual", Speed(speed=4.0)])
def test_the_clock_of_a_run_that_goes_on_starts_after_its_last_frame(kind: str | Speed) -> None:
    after = clock_of("real").now() + 1e6
    assert after <= clock_of(kind, not_before=after).now() < after + 60
