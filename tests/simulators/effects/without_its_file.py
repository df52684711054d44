"""Without its file: takes each effect's module from the disk in turn and looks whether the others still make the same
frames. Run as a program, for it unloads the simulators again and again:

    python without_its_file.py COPY CHECKOUT

Args:
    COPY: a folder with a copy of `simulators`, from which the files are taken.
    CHECKOUT: the folder with the other packages and the tests.

It prints, as JSON, what went wrong by effect, and the effects that were taken away.
"""

from __future__ import annotations

import importlib
import json
import sys
import traceback
from pathlib import Path
from typing import Any


def unload() -> None:
    """As in a fresh interpreter, but for what is not ours."""
    for name in [name for name in sys.modules if name.split(".")[0] in ("simulators", "tests")]:
        del sys.modules[name]
    importlib.invalidate_caches()


def on_demand() -> Any:
    return importlib.import_module("tests.simulators.effects.on_demand")


def imported(names: list[str]) -> list[str]:
    return [name for name in names if f"simulators.effects.{name}" in sys.modules]


def main(copy: Path, checkout: Path) -> None:
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(copy / "bytecode")  # or all is compiled each time
    sys.path[:0] = [str(copy), str(checkout)]
    room = on_demand()
    names = list(room.CATALOGUE)
    home = Path(sys.modules["simulators.scenes.expose"].__file__ or "").parents[1]
    if home != copy / "simulators":
        raise SystemExit(f"the simulators came from {home} and not from the copy")
    wrong: dict[str, str] = {}
    room.frames(room.scene([]))
    if found := imported(names):
        wrong["a scene without effects"] = f"imported {found}"
    with_it = {name: room.frames(room.scene([other for other in names if other != name])) for name in names}
    for name in names:
        file = home / "effects" / f"{name}.py"
        file.rename(file.with_suffix(".away"))
        unload()
        try:
            room = on_demand()
            without = room.frames(room.scene([other for other in names if other != name]))
            if not room.same(without, with_it[name]):
                wrong[name] = "the others' frames changed"
            if imported([name]):
                wrong[name] = "it was imported from elsewhere"
        except Exception:
            wrong[name] = traceback.format_exc()
        finally:
            file.with_suffix(".away").rename(file)
    sys.stdout.write(json.dumps({"wrong": wrong, "taken": names}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
