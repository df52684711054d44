"""Scene file: opens a scene, from a YAML file or by the name of a shipped one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from beamline.config.tree import override, read
from beamline.core.errors import ConfigError
from beamline.core.files import SETTINGS, text_in
from beamline.core.shipped import shipped_scenes
from beamline.simulate.volumes import volumes_beside
from recon.base.registry import in_folders, unknown
from simulators.frame.mapping import SceneError
from simulators.scenes.scene import Scene, load_scene

S = TypeVar("S")


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene and its file. `text`: of the file, with overridden values, for the record."""

    scene: Scene
    path: Path
    text: str


def open_scene(name: str, overrides: Sequence[str] = ()) -> SceneFile:
    """The scene of a file, or a shipped one by name, with values overridden by KEY=VALUE `overrides`.

    Raises:
        ConfigError: there is no such scene, or it is wrong.
        DataError: a volume of the scene cannot be read.
    """
    path, tree, text = _scene_text(name, overrides)
    with _naming(path):
        return SceneFile(load_scene(tree, volumes_beside(path.parent)), path, text)


def open_other(name: str, overrides: Sequence[str], load: Callable[[Mapping[str, Any]], S]) -> S:
    """As `open_scene`, for a scene of a feature, which `load` makes of its values."""
    path, tree, _ = _scene_text(name, overrides)
    with _naming(path):
        return load(tree)


def feature_of(name: str, overrides: Sequence[str]) -> str | None:
    """The module of the feature whose scenes have a key that this one has; None: it is a scene of frames."""
    _, tree, _ = _scene_text(name, overrides)
    modules = in_folders("beamline.features", "SCENES")
    return next((module for key, module in modules.items() if key in tree), None)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """What is wrong with a scene is told with its file."""
    try:
        yield
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None


def _scene_text(name: str, overrides: Sequence[str]) -> tuple[Path, Mapping[str, Any], str]:
    """The file of a scene, its values and its text."""
    shipped = shipped_scenes()
    path = Path(name)
    if not path.is_file():
        if name not in shipped:
            raise ConfigError(f"There is no file {name}, and {unknown('scene', name, shipped)}. Nothing was simulated.")
        path = shipped[name]
    try:
        text = text_in(path, SETTINGS)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror or error}). Nothing was simulated.") from error
    tree = override(read(text, str(path)), overrides, environment={})
    return path, tree.data, yaml.safe_dump(tree.data, sort_keys=False) if overrides else text
