"""Every fault of the scene early_acquisition is found by its own check; no check reports anything else."""

import pytest
import yaml

from beamline.config.load import config_folder
from beamline.monitor import watch
from beamline.monitor.check import Flag, Level, ScanContext
from simulators.scenes.scene import load_scene
from tests.bench.monitor_scenes import SATURATION, seen

pytestmark = pytest.mark.slow

SIDE = 256  # pixels: half of the scene's, twice as large


@pytest.fixture(scope="module")
def found() -> tuple[list[Flag], dict[str, list[int]]]:
    """Warnings and alarms, and the rows that each label of the scene is in."""
    settings = yaml.safe_load((config_folder() / "scenes" / "early_acquisition.yaml").read_text(encoding="utf-8"))
    settings["detector"] |= {"shape": [SIDE, SIDE], "pixel_size_um": 5.2}
    settings["axis_offset_px"] /= 2
    monitor = watch.start(ScanContext(SATURATION, SIDE * SIDE, 0.1))
    flags, labels = list[Flag](), dict[str, list[int]]()
    for frame in seen(load_scene(settings), seed=41, preview_bin=2):
        monitor, raised = watch.look(monitor, frame.frame, frame.digest)
        flags += [flag for flag in raised if flag.level is not Level.INFO]
        for label in frame.labels:
            labels.setdefault(f"{label.kind} {label.which}", []).append(frame.frame.index)
    return flags, labels


@pytest.mark.parametrize(
    ("label", "check", "latency"),
    [
        ("floaters 1", "floater", 16),  # of 41 views
        ("ghost 0", "ghost", 10),
        ("lost_beam 0", "lost", 0),
        ("jump 0", "motion", 0),
        ("jump 0", "opposite", 99),  # the last view against the first
        ("black_band 0", "field", 0),  # from the first flat on
        ("narrow_field 0", "field", 0),
    ],
)
def test_each_fault_is_found_by_its_own_check(
    found: tuple[list[Flag], dict[str, list[int]]], label: str, check: str, latency: int
) -> None:
    flags, labels = found
    shown = labels[label]
    marked = sorted({flag.frame for flag in flags if flag.check == check and flag.frame in shown})
    assert marked and marked[0] - shown[0] <= latency


def test_nothing_else_is_flagged_but_a_few_hot_pixels(found: tuple[list[Flag], dict[str, list[int]]]) -> None:
    flags, labels = found
    assert {flag.check for flag in flags} <= {"floater", "ghost", "lost", "motion", "field", "opposite"}
    lost = {flag.frame for flag in flags if flag.check == "lost"}
    assert lost == set(labels["lost_beam 0"])
    crumbs = set(labels["floaters 0"] + labels["floaters 1"])
    late = {row for flag in flags if flag.check == "floater" for row in flag.frames} - crumbs
    assert len(late) <= 4  # a view is judged when three later ones are there
