"""Scene file: opens a scene, from a YAML file or by the name of a shipped one, and says what its frames cost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from beamline.config.tree import override, read
from beamline.core.errors import ConfigError
from beamline.core.files import SETTINGS, text_in
from beamline.core.shipped import shipped_scenes
from beamline.core.text import size
from beamline.storage.mesh_file import READERS, read_mesh
from beamline.storage.volumes.files import whole_volume
from simulators.frame.mapping import SceneError
from simulators.frame.shot import CannotExposeError
from simulators.scenes.emission import EmissionScene, load_emission
from simulators.scenes.explain import FrameCost, explain
from simulators.scenes.expose import Scan as Scan
from simulators.scenes.expose import expose
from simulators.scenes.scene import Scene, load_scene

if TYPE_CHECKING:
    from simulators.samples.voxels.volume import ReadVolume


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
    try:
        return SceneFile(load_scene(tree, volumes_beside(path.parent)), path, text)
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None


def open_emission(name: str, overrides: Sequence[str] = ()) -> EmissionScene | None:
    """As `open_scene` for a scene of an emission; None: it is another one."""
    path, tree, _ = _scene_text(name, overrides)
    if "emission" not in tree:
        return None
    try:
        return load_emission(tree)
    except SceneError as error:
        raise ConfigError(f"{path}: {error}. Nothing was simulated.") from None


def _scene_text(name: str, overrides: Sequence[str]) -> tuple[Path, Mapping[str, Any], str]:
    """The file of a scene, its values and its text."""
    shipped = shipped_scenes()
    path = Path(name)
    if not path.is_file():
        if name not in shipped:
            raise ConfigError(
                f"There is no scene {name}: neither a file, nor one of {', '.join(shipped)}. Nothing was simulated."
            )
        path = shipped[name]
    try:
        text = text_in(path, SETTINGS)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error}). Nothing was simulated.") from error
    tree = override(read(text, str(path)), overrides, environment={})
    return path, tree.data, yaml.safe_dump(tree.data, sort_keys=False) if overrides else text


def scan_of(scene: SceneFile, seed: int, views: int | None, start: float) -> Scan:
    """The scan of a scene, see Scan.of. Its last frame is computed once, so that an impossible scene is refused here.

    Raises:
        CannotExposeError: the scene cannot be exposed with its settings.
    """
    scan = Scan.of(scene.scene, seed, views, start)
    expose(scan.scene, scan.frame(len(scan) - 1).shot)
    return scan


@contextmanager
def exposure_errors(scene: str) -> Iterator[None]:
    """Within it a CannotExposeError becomes a ConfigError that names the scene."""
    try:
        yield
    except CannotExposeError as error:
        raise ConfigError(f"{scene} cannot be exposed: {error}.") from error


def frame_cost(scan: Scan, now: Callable[[], float]) -> FrameCost:
    """The cost of the view in the middle of the scan, where an anomaly is likeliest."""
    return explain(scan.scene, scan.frame(len(scan) - 1 - scan.views // 2).shot, now)


def cost_table(found: FrameCost) -> str:
    """A line for each step, in order, and the effects that the scene does not name."""
    lines = [f"{'step':<22}{'acts on':<15}{'ms/frame':>9}{'memory':>10}  what happens"]
    for cost in found.costs:
        domain = "" if cost.domain is None else cost.domain.words
        lines.append(f"{cost.name:<22}{domain:<15}{cost.ms:>9.2f}{size(cost.size):>10}  {cost.summary}")
    lines.append(f"{'a frame':<37}{found.ms:>9.2f}")
    lines.append("\nNot named by the scene, hence neither imported nor computed:")
    lines += [f"  {name:<20}{summary}" for name, summary in found.unused]
    return "\n".join(lines)


def volumes_beside(folder: Path) -> ReadVolume:
    """A reader of the volumes that a scene in `folder` names, by full or relative paths. It raises DataError."""

    from simulators.samples.voxels.volume import Stored

    def read_beside(file: str, dataset: str | None) -> Stored:
        if (folder / file).suffix.lower() in READERS:
            return Stored(read_mesh(folder / file))
        return Stored(*whole_volume(folder / file, dataset))  # a full path stays itself

    return read_beside
