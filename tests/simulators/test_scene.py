"""Scene: Beer-Lambert exactly where nothing is named, each effect against its own law, and wrong scenes refused."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from simulators import sensor
from simulators.detector import Detector
from simulators.effects.catalogue import CATALOGUE, load_effect
from simulators.effects.chain import Chain
from simulators.effects.domain import Domain
from simulators.effects.hot_pixels import HotPixels
from simulators.effects.shot import AngleAt, Shot
from simulators.exposure import expose
from simulators.mapping import SceneError
from simulators.scene import Scene, load_scene
from simulators.solids import SOLIDS

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
PHANTOM = {
    "kind": "solids",
    "solids": [
        {"kind": "cylinder", "radius": 0.3, "height": 0.5, "attenuation": 2.0},
        {"kind": "ellipsoid", "semi_axes": [0.15, 0.05, 0.1], "attenuation": 3.0, "centre": [0.1, 0.05, 0.0]},
    ],
}


CONVERSION = sensor.CONVERSION["standard"]


def _scene(*effects: Any, flux: float = 4e5, phantom: Any = PHANTOM) -> Scene:
    return load_scene({"phantom": phantom, "beam": {"photons_per_s": flux}, "effects": list(effects)})


def _shot(**changes: Any) -> Shot:
    values = {
        "detector": Detector.centred((60, 80), 0.01),
        "exposure": 0.01,
        "time": 1000.0,
        "angle": 0.4,
        "elapsed": 50.0,
        "row_period": 3.6e-6,
        "roi": (1120, 2008, 60, 80),
        "binning": 1,
        "readout": "standard",
        "conversion": CONVERSION,
        "angle_at": _never,
        "beam": True,
        "sample": True,
        "radius": 0.3,
        "seed": 1,
        "frame": 2,
        "view": 0,
    }
    return Shot(**(values | changes))


def _never(time: float) -> float:
    raise AssertionError("a scene without motion asked where the stage was")


def _frame(scene: Scene, shot: Shot | None = None, angle_at: AngleAt = _never, **state: bool) -> NDArray[np.uint16]:
    return expose(scene, replace(shot or _shot(), angle_at=angle_at, **state))


def _depth(scene: Scene, angle: float) -> NDArray[np.float64]:
    return scene.sample.line_integrals(angle, _shot().detector)


def test_without_effects_a_frame_is_exactly_beer_lambert() -> None:
    scene, shot = _scene(), _shot()
    expected = np.rint(4e5 * 0.01 / CONVERSION * np.exp(-_depth(scene, 0.4)))
    np.testing.assert_array_equal(_frame(scene, shot), expected.astype(np.uint16))
    assert (_frame(scene, sample=False) == round(4000 / CONVERSION)).all()
    assert not _frame(scene, beam=False).any()
    # Chords of a centred cylinder of radius r: 2 √(r² - u²).
    u = shot.detector.u()
    chord = 2 * np.sqrt(np.clip(0.3**2 - u**2, 0, None))
    np.testing.assert_array_equal(_frame(scene, shot)[8], np.rint(4000 / CONVERSION * np.exp(-2 * chord)))


def test_a_scene_pays_only_for_what_it_names() -> None:
    """Where no motion is named nobody asks for the stage (_never), and no step is taken that is not named."""
    steps: list[str] = []

    def watch(step: str) -> AbstractContextManager[None]:
        steps.append(step)
        return nullcontext()

    expose(_scene({"kind": "beam_profile", "sigma": [1, 1]}, {"kind": "beam_decay", "lifetime": 9.0}), _shot(), watch)
    assert [step for step in steps if step in CATALOGUE] == ["beam_profile", "beam_decay"]


def test_the_same_seed_makes_the_same_frame_again() -> None:
    scene = load_scene(yaml.safe_load((SCENES / "battery.yaml").read_text(encoding="utf-8")))
    frames = [_frame(scene, _shot(frame=k)) for k in (3, 4, 3)]
    np.testing.assert_array_equal(frames[0], frames[2])
    assert (frames[0] != frames[1]).mean() > 0.9


def test_photon_noise_is_poisson() -> None:
    electrons = _frame(_scene("photon_noise"), sample=False) * CONVERSION
    assert electrons.mean() == pytest.approx(4000, abs=4 * math.sqrt(4000 / electrons.size))
    assert electrons.var() == pytest.approx(4000, rel=4 * math.sqrt(2 / electrons.size))
    thin = _frame(_scene("photon_noise", flux=0.5 / 0.01), sample=False)
    assert (thin == 0).mean() == pytest.approx(math.exp(-0.5), abs=0.03)  # P(0) = exp(-λ)


def test_read_noise_and_offset_make_the_dark() -> None:
    dark = _frame(_scene("read_noise", "offset"), beam=False).astype(float)
    assert dark.mean() == pytest.approx(200, abs=0.3)
    assert dark.std() == pytest.approx(math.hypot(0.43 / CONVERSION, 12**-0.5), rel=0.05)
    quiet = _frame(_scene("read_noise", "offset"), _shot(readout="ultra_quiet"), beam=False).astype(float)
    assert quiet.std() == pytest.approx(math.hypot(0.27 / CONVERSION, 12**-0.5), rel=0.05)
    binned = _frame(_scene("read_noise", "offset"), _shot(binning=4), beam=False).astype(float)
    assert binned.std() == pytest.approx(4 * 0.43 / CONVERSION, rel=0.05)  # √16 pixels


def test_dark_current_grows_with_the_exposure() -> None:
    dark = _frame(_scene("dark_current"), _shot(exposure=100.0), beam=False) * CONVERSION
    assert dark.mean() == pytest.approx(0.36, abs=0.04)
    binned = _frame(_scene("dark_current"), _shot(exposure=100.0, binning=2), beam=False) * CONVERSION
    assert binned.mean() == pytest.approx(4 * 0.36, abs=0.1)


def test_beam_profile_is_a_gaussian_with_stripes_that_drift() -> None:
    profile = {"kind": "beam_profile", "sigma": [0.4, 0.3], "stripes": 0.1, "stripe_period": 0.2, "drift": 1e-3}
    shot = _shot()
    u, v = shot.detector.u()[None, :], shot.detector.v()[:, None]
    gauss = np.exp(-(u**2) / (2 * 0.4**2) - v**2 / (2 * 0.3**2))
    for elapsed in (0.0, 50.0):
        flat = _frame(_scene(profile), _shot(elapsed=elapsed), sample=False) * CONVERSION / 4000
        stripes = 1 + 0.1 * np.sin(2 * np.pi * (v - 1e-3 * elapsed) / 0.2)
        np.testing.assert_allclose(flat, gauss * stripes, atol=2e-5)
    # The sample's transmission is untouched: projection / flat is Beer-Lambert.
    scene = _scene(profile)
    ratio = _frame(scene) / _frame(scene, sample=False)
    np.testing.assert_allclose(ratio, np.exp(-_depth(scene, 0.4)), rtol=2e-3)


def test_beam_decay_halves_in_its_half_life() -> None:
    scene = _scene({"kind": "beam_decay", "lifetime": 100.0})
    half = _frame(scene, _shot(elapsed=100 * math.log(2)), sample=False)
    assert (half == round(2000 / CONVERSION)).all()


def test_hot_pixels_stay_on_the_sensor_whatever_the_roi() -> None:
    scene = _scene({"kind": "hot_pixels", "fraction": 0.01, "rate": 1e5, "seed": 4})
    frame = _frame(scene, beam=False)
    assert 0.006 < (frame > 0).mean() < 0.012
    moved = _frame(scene, _shot(roi=(1124, 2016, 60, 80)), beam=False)
    np.testing.assert_array_equal(frame[4:, 8:] > 0, moved[:-4, :-8] > 0)
    binned_shot = _shot(detector=Detector.centred((30, 40), 0.02), binning=2)
    binned = _frame(scene, binned_shot, beam=False)
    np.testing.assert_array_equal(binned > 0, (frame > 0).reshape(30, 2, 40, 2).any(axis=(1, 3)))
    rows, cols, rates = HotPixels(1e-3, 2000.0, 1).pixels()
    assert rates.mean() == pytest.approx(2000, rel=0.05)
    assert rows.max() > 2290
    assert cols.max() > 4080


def test_zingers_are_as_many_as_their_rate_says_and_in_one_frame_only() -> None:
    scene = _scene({"kind": "zingers", "rate": 1000.0, "charge": 500.0})
    frames = np.stack([_frame(scene, _shot(frame=k), beam=False) for k in range(30)])
    assert (frames > 0).sum() == pytest.approx(300, abs=4 * math.sqrt(300))  # 30 frames x 10 ms x 1000/s
    assert frames[frames > 0].mean() * CONVERSION == pytest.approx(500, rel=0.3)
    assert ((frames > 0).sum(axis=0) <= 2).all()


def test_motion_blur_is_the_mean_transmission_over_the_exposure() -> None:
    def stage(time: float) -> float:
        return 0.4 + 20.0 * (time - 1000.0)  # 0.2 rad during the exposure

    scene = _scene({"kind": "motion_blur", "samples": 5})
    angles = stage(1000.0 + 0.01 * (np.arange(5) + 0.5) / 5)
    mean = np.mean([np.exp(-_depth(scene, a)) for a in angles], axis=0)
    blurred = _frame(scene, angle_at=stage)
    np.testing.assert_allclose(blurred * CONVERSION / 4000, mean, atol=2e-5)
    # A finer midpoint rule agrees to second order: the samples are spread evenly over the exposure.
    fine = np.mean([np.exp(-_depth(scene, stage(1000.0 + 0.01 * t))) for t in (np.arange(200) + 0.5) / 200], axis=0)
    assert np.abs(mean - fine).max() < 0.1 * np.abs(np.exp(-_depth(scene, 0.4)) - fine).max()


def test_rolling_shutter_shows_each_row_at_its_own_time() -> None:
    def stage(time: float) -> float:
        return 0.4 + 2000.0 * (time - 1000.0)

    scene = _scene("rolling_shutter")
    skewed = _frame(scene, angle_at=stage)
    for row in (21, 30, 38):  # rows that the ellipsoid casts its shadow on
        depth = _depth(scene, stage(1000.0 + row * 3.6e-6))[row]
        assert np.abs(depth - _depth(scene, 0.4)[row]).max() > 0.01
        np.testing.assert_allclose(skewed[row] * CONVERSION / 4000, np.exp(-depth), atol=2e-5)
    both = _frame(_scene("motion_blur", "rolling_shutter"), angle_at=stage)
    assert (both != skewed).any()


def test_a_standing_sample_has_neither_blur_nor_skew() -> None:
    moving = _scene({"kind": "motion_blur", "samples": 3}, "rolling_shutter")
    np.testing.assert_array_equal(_frame(moving, angle_at=lambda time: 0.4), _frame(_scene()))


def test_photon_transfer_curve_has_the_conversion_factor() -> None:
    """Variance over mean above the offset is 1 / (electrons a count), whatever the light (Janesick 2007)."""
    for flux in (2e4, 1e5, 6e5):
        flat = _frame(_scene("photon_noise", "read_noise", "offset", flux=flux), sample=False) - 200.0
        signal_variance = flat.var() - (0.43 / CONVERSION) ** 2 - 1 / 12
        assert flat.mean() / signal_variance == pytest.approx(CONVERSION, rel=4 * math.sqrt(2 / flat.size))


def test_binned_pixels_collect_the_light_of_all_they_sum() -> None:
    flat = _frame(_scene(flux=4e4), _shot(binning=2), sample=False)
    assert (flat == round(1600 / CONVERSION)).all()


def test_too_much_light_saturates() -> None:
    assert (_frame(_scene("offset", flux=1e6), sample=False) == 65535).all()


@pytest.mark.parametrize("name", ["battery", "plain"])
def test_scenes_that_come_with_the_package_load(name: str) -> None:
    scene = load_scene(yaml.safe_load((SCENES / f"{name}.yaml").read_text(encoding="utf-8")))
    detector = Detector.centred((144, 160), 4.6e-3)
    views = np.stack([scene.sample.line_integrals(angle, detector) for angle in np.linspace(0, np.pi, 8)])
    assert 1.0 < views.max() < 3.0
    assert not views[:, :, [0, -1]].any()  # air on both sides
    assert not views[:, [0, -1]].any()
    assert bool(scene.chain.effects) == (name == "battery")
    flat = _frame(scene, _shot(exposure=0.05), sample=False)
    assert flat.max() < 65535 or name == "battery"  # a zinger may saturate
    assert np.median(flat) < 60_000


def test_every_solid_can_be_named() -> None:
    assert set(SOLIDS) == {"cylinder", "tube", "ellipsoid", "box", "octahedron"}


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_of_the_catalogue_is_what_it_says(name: str) -> None:
    effect = load_effect(name)
    assert (effect.name, effect.domain) == (name, CATALOGUE[name].domain)
    assert effect.__module__ == f"simulators.effects.{name}"


def _with(**changes: Any) -> dict[str, Any]:
    return {"phantom": PHANTOM, "beam": {"photons_per_s": 1e5}} | changes


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ({}, "scene: key 'phantom' is missing; needed: phantom, beam"),
        (
            _with(colour="red"),
            "scene: key 'colour' is unknown; legal: phantom, beam, axis_offset_px, effects",
        ),
        (_with(beam={"photons": 1}), "scene.beam: key 'photons' is unknown; legal: photons_per_s, sod, sdd"),
        (_with(beam={"photons_per_s": -1}), "scene.beam: photons_per_s must be >= 0, got -1.0"),
        (_with(beam={"photons_per_s": "many"}), "scene.beam.photons_per_s must be a finite number, got 'many'"),
        (_with(beam=5), "scene.beam must be a mapping with the keys photons_per_s, sod, sdd; got 5"),
        (_with(axis_offset_px=True), "scene.axis_offset_px must be a finite number, got True"),
        (_with(phantom={"kind": "teapot"}), "scene.phantom: kind 'teapot' is unknown; legal: battery, solids"),
        (_with(phantom={"kind": "battery"}), "scene.phantom (battery): key 'field_of_view' is missing"),
        (
            _with(phantom={"kind": "battery", "field_of_view": [1, 1], "n_particles": 1.5}),
            "n_particles must be a whole number, got 1.5",
        ),
        (
            _with(phantom={"kind": "battery", "field_of_view": [1]}),
            "field_of_view must be a list of 2 numbers, got [1]",
        ),
        (
            _with(phantom={"kind": "battery", "field_of_view": [1, 1], "fill": 0.9}),
            "scene.phantom (battery): only",
        ),
        (_with(phantom={"kind": "solids"}), "scene.phantom (solids): key 'solids' is missing"),
        (_with(phantom={"kind": "solids", "solids": {"a": 1}}), "scene.phantom (solids): solids must be a list"),
        (
            _with(phantom={"kind": "solids", "solids": [{"kind": "cone"}]}),
            "scene.phantom (solids).solids[0]: kind 'cone' is unknown; legal: cylinder, tube, ellipsoid",
        ),
        (
            _with(phantom={"kind": "solids", "solids": [{"kind": "box", "edges": [1, 1, 0], "attenuation": 1}]}),
            "scene.phantom (solids).solids[0] (box): box: edges must be positive",
        ),
        (_with(effects="offset"), "scene: effects must be a list, got 'offset'"),
        (_with(effects=["fog"]), "scene.effects[0]: kind 'fog' is unknown; legal: motion_blur, rolling_shutter, "),
        (_with(effects=[7]), "scene.effects[0]: kind 7 is unknown"),
        (
            _with(effects=["photon_noise", {"kind": "zingers", "rat": 1}]),
            "scene.effects[1] (zingers): key 'rat' is unknown; legal: rate, charge",
        ),
        (_with(effects=["zingers"]), "scene.effects[0] (zingers): key 'rate' is missing"),
        (_with(effects=[{"kind": "motion_blur", "samples": 1}]), "samples must be >= 2"),
        (_with(effects=[{"kind": "beam_decay", "lifetime": 0}]), "lifetime must be positive"),
        (_with(effects=[{"kind": "beam_profile", "sigma": [1, 0]}]), "sigma and stripe_period must be positive"),
        (_with(effects=[{"kind": "hot_pixels", "fraction": 2}]), "fraction must lie in 0 ... 0.1"),
        (_with(effects=[{"kind": "zingers", "rate": -2}]), "rate must be >= 0"),
        (
            _with(effects=["offset", "photon_noise"]),
            "effect 'photon_noise' acts on photons and cannot follow 'offset', which acts on counts; "
            "the order is motion, optical depth, photons, electrons, counts",
        ),
        (_with(effects=["read_noise", "rolling_shutter"]), "'rolling_shutter' acts on motion and cannot follow"),
        (_with(effects=["offset", "offset"]), "effect 'offset' is named twice"),
        (
            _with(effects=["photon_noise", {"kind": "beam_decay", "lifetime": 9}]),
            "effect 'beam_decay' must come before 'photon_noise', which ends the photons",
        ),
    ],
)
def test_a_wrong_scene_is_refused_in_a_sentence(mapping: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError) as caught:
        load_scene(mapping)
    assert words in str(caught.value)


def test_numbers_that_yaml_takes_for_text_are_numbers() -> None:
    scene = load_scene(yaml.safe_load("{phantom: {kind: solids, solids: []}, beam: {photons_per_s: 1.0e5}}"))
    assert scene.beam.photons_per_s == 1e5
    assert scene.axis_offset_px == 0.0


def test_each_domain_is_seen_in_the_order_of_physics() -> None:
    """An effect for each image domain that writes down what it was given: depth, photons, electrons, counts."""
    seen: dict[Domain, NDArray[np.float64]] = {}

    class Witness:
        final: ClassVar[bool] = False

        def __init__(self, domain: Domain) -> None:
            self.name, self.domain = f"witness of {domain.name}", domain  # type: ignore[misc]

        def apply(self, image: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
            seen[self.domain] = image
            return image + 1.0

    chain = Chain.of([Witness(domain) for domain in list(Domain)[1:]])
    frame = _frame(replace(_scene(), chain=chain))
    depth = _depth(_scene(), 0.4)
    np.testing.assert_array_equal(seen[Domain.OPTICAL_DEPTH], depth)
    np.testing.assert_allclose(seen[Domain.PHOTONS], 4000 * np.exp(-depth - 1))
    np.testing.assert_allclose(seen[Domain.ELECTRONS], 4000 * np.exp(-depth - 1) + 1)
    np.testing.assert_allclose(seen[Domain.COUNTS], (4000 * np.exp(-depth - 1) + 2) / CONVERSION)
    np.testing.assert_array_equal(frame, np.rint(seen[Domain.COUNTS] + 1))
