"""Scene: Beer-Lambert exactly where nothing is named, the order of physics, and wrong scenes refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from simulators.effects.catalogue import CATALOGUE, Domain, load_effect
from simulators.effects.chain import AnyEffect, Chain
from simulators.frame import sensor
from simulators.frame.mapping import SceneError
from simulators.frame.shot import Detector, Shot
from simulators.scenes.expose import expose
from simulators.scenes.scene import load_scene
from tests.simulators import shots

SCENES = Path(__file__).parents[3] / "configs" / "scenes"
CONVERSION = sensor.CONVERSION["standard"]


def test_without_effects_a_frame_is_exactly_beer_lambert() -> None:
    scene, shot = shots.scene(), shots.shot()
    expected = np.rint(4e5 * 0.01 / CONVERSION * np.exp(-shots.depth(scene, 0.4)))
    np.testing.assert_array_equal(shots.frame(scene, shot), expected.astype(np.uint16))
    assert (shots.frame(scene, sample=False) == round(4000 / CONVERSION)).all()
    assert not shots.frame(scene, beam=False).any()
    # Chords of a centred cylinder of radius r: 2 √(r² - u²).
    u = shot.detector.u()
    chord = 2 * np.sqrt(np.clip(0.3**2 - u**2, 0, None))
    np.testing.assert_array_equal(shots.frame(scene, shot)[8], np.rint(4000 / CONVERSION * np.exp(-2 * chord)))


def test_a_scene_pays_only_for_what_it_names() -> None:
    """Where no motion is named nobody asks for the stage (_never)."""
    expose(
        shots.scene({"kind": "beam_profile", "sigma": [1, 1]}, {"kind": "ring_current", "lifetime": 9.0}), shots.shot()
    )


def test_binned_pixels_collect_the_light_of_all_they_sum() -> None:
    flat = shots.frame(shots.scene(flux=4e4), shots.shot(binning=2), sample=False)
    assert (flat == round(1600 / CONVERSION)).all()


@pytest.mark.parametrize("name", ["battery", "plain"])
def test_scenes_that_come_with_the_package_load(name: str) -> None:
    scene = load_scene(yaml.safe_load((SCENES / f"{name}.yaml").read_text(encoding="utf-8")))
    detector = Detector.centred((144, 160), 4.6e-3)
    views = np.stack([scene.sample.line_integrals(angle, detector) for angle in np.linspace(0, np.pi, 8)])
    assert 1.0 < views.max() < 3.0
    assert not views[:, :, [0, -1]].any()  # air on both sides
    assert not views[:, [0, -1]].any()
    assert bool(scene.chain.effects) == (name == "battery")
    flat = shots.frame(scene, shots.shot(exposure=0.05), sample=False)
    assert flat.max() < 65535 or name == "battery"  # a zinger may saturate
    assert np.median(flat) < 60_000


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_of_the_catalogue_matches_its_entry(name: str) -> None:
    effect = load_effect(name)
    assert (effect.name, effect.domain) == (name, CATALOGUE[name].domain)
    assert effect.__module__ == CATALOGUE[name].module


def _with(**changes: Any) -> dict[str, Any]:
    return {"phantom": shots.PHANTOM, "beam": {"photons_per_s": 1e5}} | changes


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ({}, "scene.phantom is missing; expected any value"),
        (
            _with(colour="red"),
            "scene.colour is not a known key; legal keys in this section: phantom, beam, axis_offset_px, effects",
        ),
        (
            _with(beam={"photons": 1}),
            "scene.beam.photons is not a known key (did you mean photons_per_s?)",
        ),
        (_with(beam=5), "scene.beam is 5; expected a group of keys: photons_per_s, sod, sdd, energy_kev"),
        (_with(phantom={"kind": "teapot"}), "scene.phantom: kind 'teapot' is unknown; legal: battery, solids"),
        (
            _with(phantom={"kind": "battery", "field_of_view": [1, 1], "fill": 0.9}),
            "scene.phantom (battery): lower fill",
        ),
        (_with(phantom={"kind": "solids"}), "scene.phantom (solids).solids is missing; expected a list of"),
        (
            _with(phantom={"kind": "solids", "solids": [{"kind": "cone"}]}),
            "scene.phantom (solids).solids[0]: kind 'cone' is unknown; legal: cylinder, ellipsoid, box",
        ),
        (
            _with(phantom={"kind": "solids", "solids": [{"kind": "box", "edges": [1, 1, 0], "attenuation": 1}]}),
            "scene.phantom (solids).solids[0] (box): box: edges must be positive",
        ),
        (_with(effects="offset"), "scene.effects is 'offset'; expected a list of 0 or more: any value | null"),
        (_with(effects=["fog"]), "scene.effects[0]: kind 'fog' is unknown; legal: motion_blur, rolling_shutter, "),
        (
            _with(effects=["photon_noise", {"kind": "zingers", "rat": 1}]),
            "scene.effects[1] (zingers).rat is not a known key (did you mean rate?); legal keys in this section: rate",
        ),
        (
            _with(effects=["offset", "photon_noise"]),
            "effect 'photon_noise' acts on photons and cannot follow 'offset', which acts on counts; "
            "the order is motion, optical depth, photons, electrons, counts",
        ),
        (_with(effects=["offset", "offset"]), "effect 'offset' is given twice"),
        (
            _with(effects=["photon_noise", {"kind": "ring_current", "lifetime": 9}]),
            "effect 'ring_current' must come before 'photon_noise', which ends the photons",
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
            self.name, self.domain = f"witness of {domain.name}", domain

        def apply(self, image: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
            seen[self.domain] = image
            return image + 1.0

    chain = Chain.of([cast(AnyEffect, Witness(domain)) for domain in list(Domain)[1:]])
    frame = shots.frame(replace(shots.scene(), chain=chain))
    depth = shots.depth(shots.scene(), 0.4)
    np.testing.assert_array_equal(seen[Domain.OPTICAL_DEPTH], depth)
    np.testing.assert_allclose(seen[Domain.PHOTONS], 4000 * np.exp(-depth - 1))
    np.testing.assert_allclose(seen[Domain.ELECTRONS], 4000 * np.exp(-depth - 1) + 1)
    np.testing.assert_allclose(seen[Domain.COUNTS], (4000 * np.exp(-depth - 1) + 2) / CONVERSION)
    np.testing.assert_array_equal(frame, np.rint(seen[Domain.COUNTS] + 1))
