"""No two public classes of the four packages have the same name."""

import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_each_public_class_has_a_name_of_its_own() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for package in ("beamline", "recon", "drivers", "simulators"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for name in re.findall(r"(?m)^class (?!_|TestMine)(\w+)", path.read_text(encoding="utf-8")):
                found[name].append(path.relative_to(ROOT).as_posix())
    assert len(found) > 500 and {name: places for name, places in found.items() if len(places) > 1} == {}
