"""The product's modules import each other in one direction only, also inside functions and for types."""

import re
from graphlib import TopologicalSorter

import grimp
import pytest

from tests.features import PACKAGES, ROOT

JUMPS = "beamline.projections.corrections.jumps.jumps"


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """Modules of the product that each of its modules imports."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_no_module_imports_one_that_imports_it(imported: dict[str, set[str]]) -> None:
    TopologicalSorter(imported).prepare()  # its CycleError names the circle


def test_imports_in_functions_and_for_types_count(imported: dict[str, set[str]]) -> None:
    assert {"beamline.projections.correction", "beamline.projections.usable_views"} <= imported[JUMPS]


def test_nothing_is_pickled() -> None:
    """But for numba's own files of compiled kernels."""
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            pickles = re.search(
                r"(?m)^\s*(import|from) (pickle|dill|joblib|shelve)\b", path.read_text(encoding="utf-8")
            )
            assert not pickles or path.parent == ROOT / "recon/compiled", path
