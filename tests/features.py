"""The features of `[tool.splatline.features]`: their folders, and the number of statements of core, features, add-ons.

python -m tests.features [ROOT]
"""

import ast
import sys
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("beamline", "recon", "drivers", "simulators")


@cache
def table(root: Path = ROOT) -> dict[str, list[str]]:
    """Folders and modules of each feature; its tests have the same structure."""
    features: dict[str, list[str]] = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "splatline"
    ]["features"]
    return features


def folders(feature: str, root: Path = ROOT) -> list[Path]:
    """The existing folders and modules of a feature and of its tests."""
    own = [root / folder for folder in table(root)[feature]]
    tests = [root / "tests" / each.relative_to(root).with_suffix("") for each in own]
    return [path for each in (*own, *tests) for path in (each, each.with_name(f"test_{each.name}.py")) if path.exists()]


def statements(path: Path) -> int:
    return sum(isinstance(node, ast.stmt) for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def counted(root: Path = ROOT) -> dict[str, int]:
    """Number of statements in the four packages by feature ("core": the rest), and of each add-on."""
    owners = {root / folder: feature for feature, own in table(root).items() for folder in own}
    add_ons = {folder: folder.parent.name for folder in sorted(root.glob("packages/*/splatline_*"))}
    owners |= add_ons
    counts = {"core": 0, **dict.fromkeys([*table(root), *add_ons.values()], 0)}
    for package in (*(root / name for name in PACKAGES), *add_ons):
        for path in package.rglob("*.py"):
            counts[next((owners[p] for p in (path, *path.parents) if p in owners), "core")] += statements(path)
    return counts


if __name__ == "__main__":
    counts = counted(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT)
    for feature, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{feature:<20}{count:>7}")
    print(f"{'all':<20}{sum(counts.values()):>7}")
