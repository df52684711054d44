"""The scan of a scene without an instrument, and what a frame costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from beamline.core.errors import ConfigError
from beamline.core.text import size
from beamline.scenes.scene_file import SceneFile
from simulators.frame.shot import CannotExposeError
from simulators.scenes.cost.explain import FrameCost, explain
from simulators.scenes.expose import Scan, expose


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
