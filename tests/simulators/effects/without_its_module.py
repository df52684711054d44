"""Without its module: looks whether each module of effects is imported where no scene names one of them, and whether
the other effects still make the same frames where it cannot be imported. Run as a program, for it unloads the
simulators again and again:

    python -m tests.simulators.effects.without_its_module

It prints, as JSON, what went wrong by module, and the modules that were taken away.
"""

from __future__ import annotations

import importlib
import json
import sys
import traceback

from simulators.effects.catalogue import CATALOGUE
from tests.simulators.effects import on_demand

MODULES = sorted({row.module for row in CATALOGUE.values()})


def _imported() -> list[str]:
    return [module for module in MODULES if module in sys.modules]


def _imports(module: str) -> list[str]:
    """The modules of effects that it imports where nothing of the simulators has been imported yet."""
    kept = {key: module for key, module in sys.modules.items() if key.split(".")[0] == "simulators"}
    for key in kept:
        del sys.modules[key]
    importlib.import_module(module)
    found = _imported()
    for key in [key for key in sys.modules if key.split(".")[0] == "simulators"]:
        del sys.modules[key]
    sys.modules.update(kept)
    return found


def _without(key: str) -> str:
    """What goes wrong with the frames of all others where it cannot be imported; empty if nothing does."""
    scene = on_demand.scene([other for other, row in CATALOGUE.items() if row.module != key])
    with_it = on_demand.frames(scene)
    module = sys.modules.pop(key)
    sys.modules[key] = None  # type: ignore[assignment]  # to Python: there is none
    try:
        return "" if on_demand.same(on_demand.frames(scene), with_it) else "the others' frames changed"
    except Exception:
        return traceback.format_exc()
    finally:
        sys.modules[key] = module


def main() -> None:
    wrong: dict[str, str] = {}
    on_demand.frames(on_demand.scene([]))
    if found := _imported():
        wrong["a scene without effects"] = f"imported {found}"
    for module in MODULES:
        if (found := _imports(module)) != [module]:
            wrong[module] = f"imported {found}"
    on_demand.frames(on_demand.scene(list(CATALOGUE)))
    for module in MODULES:
        if said := _without(module):
            wrong[module] = said
    sys.stdout.write(json.dumps({"wrong": wrong, "taken": MODULES}))


if __name__ == "__main__":
    main()
