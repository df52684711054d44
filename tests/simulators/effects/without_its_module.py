"""Without its module: looks whether each effect is imported where no scene names it, and whether the others still make
the same frames where it cannot be imported. Run as a program, for it unloads the simulators again and again:

    python -m tests.simulators.effects.without_its_module

It prints, as JSON, what went wrong by effect, and the effects that were taken away.
"""

from __future__ import annotations

import importlib
import json
import sys
import traceback

from simulators.effects.catalogue import CATALOGUE
from tests.simulators.effects import on_demand

NAMES = list(CATALOGUE)


def _module(name: str) -> str:
    return f"{CATALOGUE[name].package}.{name}"


def _imported() -> list[str]:
    return [name for name in NAMES if _module(name) in sys.modules]


def _imports(name: str) -> list[str]:
    """The effects that its module imports where nothing of the simulators has been imported yet."""
    kept = {key: module for key, module in sys.modules.items() if key.split(".")[0] == "simulators"}
    for key in kept:
        del sys.modules[key]
    importlib.import_module(_module(name))
    found = _imported()
    for key in [key for key in sys.modules if key.split(".")[0] == "simulators"]:
        del sys.modules[key]
    sys.modules.update(kept)
    return found


def _without(name: str) -> str:
    """What goes wrong with the frames of all others where its module cannot be imported; empty if nothing does."""
    scene = on_demand.scene([other for other in NAMES if other != name])
    with_it, key = on_demand.frames(scene), _module(name)
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
    for name in NAMES:
        if (found := _imports(name)) != [name]:
            wrong[name] = f"imported {found}"
    on_demand.frames(on_demand.scene(NAMES))
    for name in NAMES:
        if said := _without(name):
            wrong[name] = said
    sys.stdout.write(json.dumps({"wrong": wrong, "taken": NAMES}))


if __name__ == "__main__":
    main()
