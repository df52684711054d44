"""What each effect and each scene costs a frame; run with  pytest -m bench -s tests/bench/test_scene_cost.py."""

from __future__ import annotations

import statistics
import time
from typing import Any

import pytest
import yaml

from beamline.core.installed import shipped_scenes
from beamline.scenes.scene_file import open_scene
from simulators.effects.catalogue import CATALOGUE
from simulators.frame.shot import Shot
from simulators.scenes.cost import explain
from simulators.scenes.expose import Scan, expose
from simulators.scenes.scene import Scene

SIDE = 2048
REPEATS = 7
LAW = 0.2  # a scene costs the sum of its parts to this share

# One of each in a setting that users would take, for the battery of the scene `ideal`.
TYPICAL: dict[str, dict[str, Any]] = {
    "motion_blur": {},
    "rolling_shutter": {},
    "afterglow": {"shares": [0.02], "decay_times": [0.01]},
    "encoder_error": {"harmonics": [[36, 5.0, 0.0]], "random_mdeg": 2.0},
    "backlash": {"lost_motion_deg": 0.01},
    "stage_wobble": {"harmonics": [[2, 20.0, 0.0]]},
    "runout": {"radial": [[2, 0.2, 0.0]], "radial_random_um": 0.05},
    "jump": {"view": 0, "shift_um": [8.0, 0.0, 4.0]},
    "pixel_area": {},
    "floaters": {"distance": [0.1, 0.5], "count": 4, "size": [0.02, 0.06]},
    "phase_fringes": {"delta_beta": 5.0, "distance": 10.0, "energy": 8.3485},
    "harmonics": {"share": 0.005},
    "beam_hardening": {"weights": [0.5, 0.5], "ratios": [1.0, 1.5]},
    "beam_profile": {"sigma": [1.6, 0.8], "stripes": 0.03, "drift": 1e-5},
    "ring_current": {"lifetime": 36000.0},
    "beam_bend": {"curvature": [0.1, 0.0]},
    "scatter": {"ratio": 0.01, "width_mm": 0.2},
    "scintillator_blur": {"fwhm_um": 3.0, "tail_share": 0.02, "tail_um": 60.0},
    "flat_structure": {"specks": 2000, "radius_um": 8.0},
    "quantum_efficiency": {"wavelength_nm": 535.0},
    "prnu": {},
    "ghost": {"view": 89, "width": 0.35, "speed": 0.15},
    "black_band": {"width": 0.06, "penumbra": 0.01},
    "narrow_field": {"width": 1.05, "penumbra": 0.02},
    "lost_beam": {"views": [0, 180], "share": 0.5},
    "photon_noise": {},
    "dark_current": {},
    "hot_pixels": {"fraction": 2e-4},
    "zingers": {"rate": 40.0},
    "saturation": {},
    "dead_pixels": {},
    "read_noise": {},
    "offset": {},
    "adc": {"bits": 12},
}


def _sized(name: str, side: int, *more: str) -> Scene:
    """A shipped scene, seen by a detector of `side` x `side` pixels that is as large as the scene's own."""
    detector = open_scene(name).scene.detector
    pitch = detector.pixel_size_um * detector.binning * detector.shape[0] / side
    sets = (f"detector.shape=[{side},{side}]", f"detector.pixel_size_um={pitch}", "detector.binning=1")
    return open_scene(name, [*sets, *more]).scene


def _shot(scene: Scene) -> Shot:
    scan = Scan.of(scene)
    return scan.frame(len(scan) - 1 - scan.views // 2).shot


def _in_turns(scenes: dict[str, Scene]) -> dict[str, list[float]]:
    """ms of a frame of each scene, by name, one after the other in each of REPEATS rounds."""
    shots = {name: _shot(scene) for name, scene in scenes.items()}
    rounds: dict[str, list[float]] = {name: [] for name in scenes}
    for repeat in range(REPEATS + 1):
        for name, scene in scenes.items():
            start = time.perf_counter()
            expose(scene, shots[name])
            if repeat:  # the first one compiles
                rounds[name].append(1e3 * (time.perf_counter() - start))
    return rounds


@pytest.mark.bench
def test_each_effect_alone() -> None:
    assert set(TYPICAL) == set(CATALOGUE), "an effect without a typical setting"
    print(f"\n| effect | acts on | ms at {SIDE}² (quartiles) |\n|---|---|---|")
    bare = _sized("ideal", SIDE)
    print(f"without effects {statistics.median(_in_turns({'ideal': bare})['ideal']):.1f} ms")
    for name, entry in CATALOGUE.items():
        with_it = yaml.safe_dump([{"kind": name} | TYPICAL[name]], default_flow_style=True, width=10**6).strip()
        runs = _in_turns({"ideal": bare, name: _sized("ideal", SIDE, f"effects={with_it}")})
        more = [a - b for a, b in zip(runs[name], runs["ideal"], strict=True)]
        low, middle, high = statistics.quantiles(more, n=4)
        print(f"| {name} | {entry.domain.words} | {middle:.1f} ({low:.1f} ... {high:.1f}) |", flush=True)


@pytest.mark.bench
@pytest.mark.parametrize("name", [*shipped_scenes()])
def test_a_scene_costs_the_sum_of_its_parts(name: str) -> None:
    scene = _sized(name, SIDE)
    found = explain(scene, _shot(scene), time.perf_counter, REPEATS)
    parts = sum(cost.ms for cost in found.costs)
    quarter = statistics.median(_in_turns({name: _sized(name, SIDE // 4)})[name])
    dearest = max(found.costs, key=lambda cost: cost.ms)
    print(
        f"\n| {name} | {len(scene.chain.effects)} | {found.ms:.0f} | {parts / found.ms:.2f} | {quarter:.1f} | "
        f"{dearest.name} {dearest.ms:.0f} |"
    )
    assert parts == pytest.approx(found.ms, rel=LAW)
