"""Scene files: volumes are searched next to the scene, wherever it is opened from."""

from pathlib import Path

import numpy as np
import pytest

from beamline.config.load import load
from beamline.core.errors import ConfigError, DataError
from beamline.instrument.simulated import scene_of
from beamline.scenes.scene_file import open_scene
from recon.base.volume import Grid

VOLUME = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
PHANTOM = "{kind: volume, file: data/v.npy, voxel_mm: 0.1}"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    np.save(tmp_path / "data" / "v.npy", VOLUME)
    path = tmp_path / "scene.yaml"
    path.write_text(f"phantom: {PHANTOM}\nbeam: {{photons_per_s: 1.0e+5}}\n", encoding="utf-8")
    return path


def test_a_volume_is_sought_beside_its_scene(scene: Path) -> None:
    sample = open_scene(str(scene)).scene.sample
    np.testing.assert_array_equal(sample.attenuation(Grid((2, 3, 4), 0.1)), VOLUME)
    (scene.parent / "data" / "v.npy").unlink()
    with pytest.raises(DataError, match=r"v\.npy"):
        open_scene(str(scene))


def test_wrong_settings_of_a_volume_are_the_scenes_fault(scene: Path) -> None:
    scene.write_text(scene.read_text(encoding="utf-8").replace("0.1", "-0.1"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"scene\.yaml: scene\.phantom \(volume\)\.voxel_mm"):
        open_scene(str(scene))


@pytest.mark.parametrize("inline", [False, True])
def test_the_simulated_instrument_finds_the_same_volume(scene: Path, inline: bool) -> None:
    entry = f"\n    phantom: {PHANTOM}\n    beam: {{photons_per_s: 1.0e+5}}\n" if inline else " scene.yaml\n"
    template = (Path(__file__).parents[3] / "configs" / "simulated.yaml").read_text(encoding="utf-8")
    head, found, rest = template.partition("\n  scene:")
    assert found
    config = scene.parent / "config.yaml"
    config.write_text(f"{head}\n  scene:{entry}{rest.partition(chr(10))[2]}", encoding="utf-8")
    sample = scene_of(load(config)).sample
    np.testing.assert_array_equal(sample.attenuation(Grid((2, 3, 4), 0.1)), VOLUME)
