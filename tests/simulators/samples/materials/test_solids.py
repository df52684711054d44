"""Solids: scenes with materials, with attenuations and with both, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from simulators.frame.detector import Detector
from simulators.frame.mapping import SceneError
from simulators.samples.materials.palette import palette_of
from simulators.samples.sample import Sample
from simulators.scenes.scene import load_scene

BATH = {"kind": "cylinder", "radius": 0.1, "height": 0.3, "material": "electrolyte"}
GRAIN = {
    "kind": "ellipsoid", "semi_axes": [0.01, 0.01, 0.01], "material": "NMC811", "instead_of": "electrolyte",
    "name": "active",
}  # fmt: skip
GREY = {"kind": "box", "edges": [0.1, 0.02, 0.1], "attenuation": 2.0, "name": "wall"}


def _sample(*solids: Any, materials: Any = None, **light: Any) -> Sample:
    phantom = {"kind": "solids", "solids": list(solids)} | ({} if materials is None else {"materials": materials})
    return load_scene({"phantom": phantom, "beam": {"photons_per_s": 1.0} | light}).sample


def test_a_scene_s_grain_stands_out_by_its_contrast() -> None:
    charged = {"NMC811": {"state_of_charge": 1.0}}
    sample = _sample(BATH, GRAIN, GREY, materials=charged, energy_kev=8.3485)
    assert sample.names == ("electrolyte", "active", "wall")
    centre = sample.line_integrals(0.0, Detector.centred((1, 1), 0.01))[0, 0]
    colours = palette_of("", charged)
    oxide, bath = (float(colours(name).attenuation(8.3485)) for name in ("NMC811", "electrolyte"))
    assert centre == pytest.approx(0.2 * bath + 0.02 * (oxide - bath) + 0.02 * 2.0)


def test_a_tube_s_filters_may_be_the_scene_s_own_materials() -> None:
    tube = {"tube": {"kv": 40, "filters": {"foil": 0.5}}}
    hard = _sample(BATH, materials={"foil": {"formula": "Cu", "density": 8.96}}, **tube)
    soft = _sample(BATH, materials={"foil": {"formula": "C", "density": 0.1}}, **tube)
    at = Detector.centred((1, 1), 0.01)
    assert 0 < hard.line_integrals(0.0, at)[0, 0] < 0.2 * soft.line_integrals(0.0, at)[0, 0]


def test_tables_are_loaded_only_where_a_material_is_named() -> None:
    code = (
        "import sys; from simulators.scenes.scene import load_scene; solid = {'kind': 'box', 'edges': [1, 1, 1]};"
        "load_scene({'phantom': {'kind': 'solids', 'solids': [solid | {'attenuation': 1}]}, 'beam': "
        "{'photons_per_s': 1, 'energy_kev': 8}}); assert 'xraylib' not in sys.modules;"
        "load_scene({'phantom': {'kind': 'solids', 'solids': [solid | {'material': 'Al'}]}, 'beam': "
        "{'photons_per_s': 1, 'energy_kev': 8}}); assert 'xraylib' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("solids", "light", "words"),
    [
        ([BATH], {}, r"scene.phantom \(solids\): materials need the beam's energy"),
        ([BATH | {"attenuation": 1.0}], {"energy_kev": 8}, r"solids\[0\]: attenuation and material exclude each other"),
        ([BATH, GREY | {"material": "mud"}], {"energy_kev": 8}, r"solids\[1\]: attenuation and material"),
        ([BATH | {"material": "mud"}], {"energy_kev": 8}, r"solids\[0\]: material 'mud' is unknown"),
        ([BATH | {"material": 5}], {"energy_kev": 8}, r"solids\[0\]: material must be text"),
        ([BATH, GREY | {"instead_of": "Al"}], {"energy_kev": 8}, "instead_of 'Al' needs a material"),
        ([BATH, "box"], {"energy_kev": 8}, r"solids\[1\] \(box\): key 'edges' is missing"),
        ([BATH | {"colour": 1}], {"energy_kev": 8}, r"solids\[0\] \(cylinder\): key 'colour' is unknown"),
        ([BATH], {"energy_kev": 900}, "tabulated from 0.1 to 800 keV"),
        ([BATH], {"tube": {"kv": 60, "filters": {"mud": 1}}}, r"scene.phantom \(solids\): material 'mud' is unknown"),
    ],
)
def test_what_cannot_be_seen_is_refused(solids: list[Any], light: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        _sample(*solids, **light)


def test_a_name_alone_is_for_grey_solids_too() -> None:
    sample = _sample(GREY, materials={})
    assert sample.names == ("wall",)
    assert np.ptp(sample.line_integrals(0.0, Detector.centred((1, 2), 0.01))) == 0
