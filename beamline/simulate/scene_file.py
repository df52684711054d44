"""Scene file: a scene from a YAML file, or one of those that come with the package, by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beamline.config import config_folder
from beamline.config_text import read
from beamline.errors import ConfigError
from simulators.mapping import SceneError
from simulators.scene import Scene, load_scene


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene, and where it stands.

    Attributes:
        text: the file's, for the record.
    """

    scene: Scene
    path: Path
    text: str


def shipped_scenes() -> dict[str, Path]:
    """The scenes that come with the package, by name."""
    return {path.stem: path for path in sorted((config_folder() / "scenes").glob("*.yaml"))}


def open_scene(name: str) -> SceneFile:
    """The scene that `name` says: a file, or the name of a shipped one.

    Raises:
        ConfigError: there is no such scene, or it is wrong.
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
        return SceneFile(load_scene(read(text, str(path)).data), path, text)
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None
