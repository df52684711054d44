"""Scene file: a scene from a YAML file, or one of those that come with the package, by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml

from beamline.config.load import config_folder
from beamline.config.tree import override, read
from beamline.core.errors import ConfigError
from beamline.storage.volume_file import read_volume
from simulators.frame.mapping import SceneError
from simulators.frame.shot import CannotExposeError
from simulators.samples.voxels.stored import ReadVolume, Stored
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene, load_scene
from simulators.scenes.settings import MOST_FRAMES
from simulators.scenes.shots import Scan

__all__ = ["MOST_FRAMES", "Scan", "SceneFile", "begun", "open_scene", "shipped_scenes", "shown", "volumes_beside"]


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene, and where it stands.

    Attributes:
        text: the file's, for the record; with what was put over it.
    """

    scene: Scene
    path: Path
    text: str


def shipped_scenes() -> dict[str, Path]:
    """The scenes that come with the package, by name."""
    return {path.stem: path for path in sorted((config_folder() / "scenes").glob("*.yaml"))}


def open_scene(name: str, overrides: Sequence[str] = ()) -> SceneFile:
    """The scene that `name` says: a file, or the name of a shipped one, with KEY=VALUE `overrides` put over it.

    Raises:
        ConfigError: there is no such scene, or it is wrong.
        DataError: a volume that it names cannot be read.
    """
    shipped = shipped_scenes()
    path = Path(name)
    if not path.is_file():
        if name not in shipped:
            raise ConfigError(
                f"There is no scene {name}: neither a file, nor one of {', '.join(shipped)}. Nothing was simulated."
            )
        path = shipped[name]
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read ({error}). Nothing was simulated.") from error
    try:
        tree = override(read(text, str(path)), overrides, environment={})
        if overrides:
            text = yaml.safe_dump(tree.data, sort_keys=False)
        return SceneFile(load_scene(tree.data, volumes_beside(path.parent)), path, text)
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None


def begun(scene: SceneFile, seed: int, views: int | None, start: float) -> Scan:
    """The scan of a scene, see Scan.of; its last frame has been made once, so that what cannot be is known by now.

    Raises:
        CannotExposeError: the scene cannot be exposed as it asks for.
    """
    scan = Scan.of(scene.scene, seed, views, start)
    expose(scan.scene, scan.frame(len(scan) - 1).shot)
    return scan


@contextmanager
def shown(scene: str) -> Iterator[None]:
    """What a scene cannot show, though each of its values is legal, is told as what is wrong with it.

    Raises:
        ConfigError: instead of CannotExposeError.
    """
    try:
        yield
    except CannotExposeError as error:
        raise ConfigError(f"{scene} cannot be exposed: {error}.") from error


def volumes_beside(folder: Path) -> ReadVolume:
    """Reads the volumes that a scene in `folder` names: by full paths, or by paths from there. It raises DataError."""

    def read_beside(file: str, dataset: str | None) -> Stored:
        return Stored(*read_volume(folder / file, dataset))  # a full path stays itself

    return read_beside
