"""Scenes at several energies: frames are right at each energy, regions show the material, grey samples are errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from beamline.core.errors import ConfigError
from simulators.samples.materials.materials import palette_of
from splatline_spectral.contrast import find_edge
from splatline_spectral.sources import _curve, series_of_scene

SCENE: dict[str, Any] = {
    "phantom": {
        "kind": "solids",
        "materials": {"NMC811": {"state_of_charge": 1.0}},
        "solids": [
            {"kind": "cylinder", "radius": 0.06, "height": 1.0, "material": "electrolyte"},
            {"kind": "box", "edges": [0.03, 0.01, 0.03], "material": "NMC811", "instead_of": "electrolyte"},
        ],
    },
    "beam": {"photons_per_s": 1e5, "energy_kev": 8.4},
    "detector": {"shape": [32, 64], "pixel_size_um": 2.5},
    "scan": {"darks": 1},
}
ENERGIES = np.array([8.30, 8.3485, 8.40])


def _scene(folder: Path, **changes: Any) -> str:
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE | changes), encoding="utf-8")
    return str(path)


def test_frames_are_beer_lambert_at_each_energy(tmp_path: Path) -> None:
    series = series_of_scene(_scene(tmp_path), ENERGIES)
    assert (series.title, series.elements[-1]) == ("NMC811 in scene, simulated", 28)
    colours = palette_of("", SCENE["phantom"]["materials"])
    bath, oxide = (colours(name).attenuation(ENERGIES) for name in ("electrolyte", "NMC811"))
    u = (np.arange(64) - 31.5) * 2.5e-3
    chord = 2 * np.sqrt(0.06**2 - u**2, where=np.abs(u) < 0.06, out=np.zeros_like(u))
    frames = list(series.frames)
    assert [energy for energy, _ in frames] == ENERGIES.tolist()
    for k, (_, frame) in enumerate(frames):
        expected = bath[k] * chord + (oxide - bath)[k] * 0.01 * (np.abs(u) < 0.015)
        np.testing.assert_allclose(frame[16], expected, atol=1e-4)  # counts are whole numbers


def test_harmonics_flatten_the_contrast(tmp_path: Path) -> None:
    clean = [frame for _, frame in series_of_scene(_scene(tmp_path), ENERGIES).frames]
    dirty_beam = SCENE["beam"] | {"harmonics": {3: 0.05}}
    dirty = [frame for _, frame in series_of_scene(_scene(tmp_path, beam=dirty_beam), ENERGIES).frames]
    colours = palette_of("", SCENE["phantom"]["materials"])
    oxide, bath = (colours(name).attenuation([8.3485, 3 * 8.3485]) for name in ("NMC811", "electrolyte"))
    expected = -np.log(np.array([0.95, 0.05]) @ np.exp(-0.01 * oxide - 0.11 * bath))
    assert dirty[1][16, 32] == pytest.approx(expected, abs=1e-3)
    assert dirty[1][16, 32] < clean[1][16, 32] - 0.02


def test_regions_are_the_material_and_what_is_next_to_it(tmp_path: Path) -> None:
    regions = series_of_scene(_scene(tmp_path), ENERGIES).regions
    assert regions.thickness == pytest.approx(0.01)
    assert regions.inside.sum() == 12 * 12
    assert regions.around is not None
    assert not (regions.inside & regions.around).any()
    assert regions.around[16].sum() == 48 - 12  # the rest of the capillary, 0.12 mm across, and no air


def test_a_series_of_charges_moves_the_edge_as_the_radiographs_show_it(tmp_path: Path) -> None:
    """By 2 eV from the discharged to the charged state, as simulators.samples.materials.materials has it."""
    energies = np.arange(8.320, 8.375, 0.001)
    found = []
    for charge in (0.0, 0.5, 1.0):
        curve = _curve(series_of_scene(_scene(tmp_path), energies, charge=charge), lambda n, of: None)
        found.append(find_edge(curve.energies, curve.absorption))
    lines, edges = np.array([(edge.white_line, edge.energy) for edge in found]).T
    np.testing.assert_allclose(lines, [8.3465, 8.3475, 8.3485], atol=2.5e-4)
    np.testing.assert_allclose(np.diff(edges), 1e-3, atol=2e-4)


def test_energies_at_which_nothing_comes_through_are_left_out(tmp_path: Path) -> None:
    """0.2 mm of the oxide are 18 depths above the edge, 5 below: where no light is, there is no noise either, and it
    must not look like the best of all contrasts."""
    bar = {"kind": "box", "edges": [0.03, 0.2, 0.03], "material": "NMC811"}
    phantom = SCENE["phantom"] | {"solids": [bar]}
    path = _scene(tmp_path, phantom=phantom, effects=["photon_noise"])
    energies = np.arange(8.320, 8.365, 0.001)
    curve = _curve(series_of_scene(path, energies), lambda n, of: None)
    assert curve.energies.size >= 9 and curve.energies.max() < 8.344
    assert curve.left_out.min() > 8.335 and curve.left_out.max() == pytest.approx(8.364)
    expected = palette_of("", SCENE["phantom"]["materials"])("NMC811").attenuation(curve.energies[:5])
    np.testing.assert_allclose(curve.absorption[:5], expected, rtol=0.02)


def test_noise_is_the_seed_s(tmp_path: Path) -> None:
    path = _scene(tmp_path, effects=["photon_noise"])
    one, same, other = (next(iter(series_of_scene(path, ENERGIES, seed=seed).frames))[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.9


def test_a_beam_too_bright_for_the_sensor_tells_nothing(tmp_path: Path) -> None:
    """5e4 electrons where 7000 are the most: clipped flats would put the edge 4 eV too high."""
    path = _scene(tmp_path, beam=SCENE["beam"] | {"photons_per_s": 5e5})
    curve = _curve(series_of_scene(path, ENERGIES), lambda n, of: None)
    assert (curve.energies.size, curve.left_out.size) == (0, 3)


@pytest.mark.parametrize(
    ("changes", "material", "words"),
    [
        ({"phantom": {"kind": "solids", "solids": [{"kind": "box", "edges": [1, 1, 1], "attenuation": 1}]}}, None,
         "give the sample the key `material`: without a material"),
        ({"phantom": SCENE["phantom"] | {"materials": {}}}, None, "the materials electrolyte, NMC811 .0 of these"),
        ({}, "Cu", "--material Cu: choose one of the materials electrolyte, NMC811"),
        ({"beam": {"photons_per_s": 1}}, None, "materials need the beam's energy"),
        ({"detector": {"shape": [4, 4], "pixel_size_um": 0.1}, "axis_offset_px": 3000.0}, None,
         "NMC811 cannot be compared with its surroundings: the material is not in the field of view"),
    ],
)  # fmt: skip
def test_scenes_that_cannot_be_scanned_are_refused(
    tmp_path: Path, changes: dict[str, Any], material: str | None, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        series_of_scene(_scene(tmp_path, **changes), ENERGIES, material)
