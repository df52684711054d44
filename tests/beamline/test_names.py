"""One name for one thing: no two public classes of the four packages have the same name."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]


def classes() -> dict[str, list[str]]:
    """Where each public class of the four packages is defined, and each Protocol, enumeration and value type."""
    found: dict[str, list[str]] = defaultdict(list)
    for package in ("beamline", "recon", "drivers", "simulators"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    found[node.name].append(path.relative_to(ROOT).as_posix())
    return found


def test_each_public_class_has_a_name_of_its_own() -> None:
    assert {name: places for name, places in classes().items() if len(places) > 1} == {}
