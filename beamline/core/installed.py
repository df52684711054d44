"""What is installed: the version, the configurations and scenes of the package, and modules by the names of ours."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType, TracebackType


def config_folder() -> Path:
    """The folder of the configurations that come with the package: installed, or beside the packages of a checkout."""
    installed = Path(__file__).parents[1] / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def shipped_scenes() -> dict[str, Path]:
    """The scenes that come with the package, by name."""
    return {path.stem: path for path in sorted((config_folder() / "scenes").glob("*.yaml"))}


def version() -> str:
    """The installed distribution's version; "uninstalled" when run from a bare checkout."""
    from importlib import metadata  # here: it imports much that a file of the user may hide

    try:
        return metadata.version("splatline")
    except metadata.PackageNotFoundError:
        return "uninstalled"


OWN_PACKAGES = ("drivers", "recon", "simulators")
_MARK = b"splatline"  # in the first line of each one's __init__.py
_LIBRARIES = (
    *("PIL", "click", "h5py", "hdf5plugin", "jinja2", "matplotlib", "numba", "numpy", "psutil", "pydantic", "rich"),
    *("scipy", "serial", "skimage", "starlette", "tifffile", "torch", "usb", "uvicorn", "yaml", "zlib_ng"),
)
"""What ours import. Each is a folder: one file of that name is another module."""
_DISTRIBUTIONS = {
    **{"PIL": "pillow", "serial": "pyserial", "skimage": "scikit-image", "usb": "pyusb", "yaml": "pyyaml"},
    "zlib_ng": "zlib-ng",
}
_WITHOUT = {"torch": " Without it, use -m fbp, -m fista-tv or -m auto."}


def package_problem(home: str) -> str:
    """A sentence with advice if Python imports another module by the name of one of this project's packages; "" if not.

    Args:
        home: the folder that holds our packages.
    """
    for name in OWN_PACKAGES:
        ours = os.path.join(home, name, "__init__.py")  # noqa: PTH118 - to load pathlib takes longer than this check
        origin = _origin(name)
        if origin is None:
            return f"splatline is incomplete: Python finds no package {name!r}. {_AGAIN}."
        if origin != ours and os.path.realpath(origin) != os.path.realpath(ours):
            return f"Python finds {name!r} at {origin}, not splatline's at {ours}: {_way_out(origin)}."
        with open(origin, "rb") as file:  # noqa: PTH123
            if _MARK not in file.readline():
                return f"{origin} is not splatline's: {_way_out(origin)}."
    for name in _LIBRARIES:
        if (origin := _origin(name) or "").endswith(f"{os.sep}{name}.py"):
            return f"{origin} hides the library {name!r}, which splatline needs: {_way_out(origin)}."
    return ""


def installation_problem(error: BaseException) -> str:
    """A sentence with advice on the library whose loading raised `error`; "" if no loading did."""
    if not (name := _library(error)):
        return ""
    cause, origin, needed = error.__cause__ or error, _origin(name), _needed(name)
    if name in sys.stdlib_module_names:
        where = f"Python's own was expected, of {sys.executable}"
        advice = (
            "use another Python" if origin is None or _installed(origin) else f"{origin} hides it: {_way_out(origin)}"
        )
    elif origin is None:
        where, advice = f"{sys.executable} does not find it", f"install it: pip install {needed}"
    else:
        where, advice = f"It is at {origin}", f"install it again: pip install --force-reinstall {needed}"
        if not _installed(origin):
            advice = f"if this is another one, {_way_out(origin)}; if not, {advice}"
    said = " ".join(f"{type(cause).__name__}: {cause}".split())
    return f"the library {name!r} cannot be loaded ({said}). {where}; {advice}.{_WITHOUT.get(name, '')}"


def as_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """`sys.excepthook` that says in one line which library cannot be loaded."""
    if problem := installation_problem(error):
        sys.stderr.write(f"beamline: {problem}\n")
    else:
        sys.__excepthook__(kind, error, trace)


def _needed(name: str) -> str:
    """A library as pip takes it, in quotes where its version matters."""
    from importlib import metadata

    package = _DISTRIBUTIONS.get(name, name)
    with suppress(metadata.PackageNotFoundError):
        for each in metadata.requires("splatline") or ():
            if each.startswith(package) and not each[len(package)].isalnum() and "extra ==" not in each:
                return f'"{each}"'
    return package


def _library(error: BaseException) -> str:
    """The top-level name of the library whose import raised the error; "" if none did."""
    name = error.name if isinstance(error, ImportError) else None
    if isinstance(error, AttributeError) and isinstance(error.obj, ModuleType):  # np.zeros, where np is the user's
        file = getattr(error.obj, "__file__", None)
        name = error.obj.__name__ if file and not _installed(file) else None
    root = (name or _imported(error.__traceback__, isinstance(error, ImportError))).partition(".")[0]
    return "" if _ours(root) else root


def _imported(trace: TracebackType | None, failed: bool) -> str:
    """The library that our code was importing; "" where it called one, unless an import `failed` in that call."""
    name = ""
    while trace is not None:
        root, what = str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0], trace.tb_frame.f_code.co_name
        if _ours(root):
            name = ""
        elif not name and root not in ("importlib", "_frozen_importlib", "_frozen_importlib_external"):
            name = root if failed or what == "<module>" else "a call"
        trace = trace.tb_next
    return "" if name == "a call" else name


def _ours(root: str) -> bool:
    return root in ("", "__main__", "beamline", *OWN_PACKAGES) or root.startswith("splatline")


def _installed(file: str) -> bool:
    """Whether a file lies where Python or pip puts modules."""
    return file.startswith(os.path.dirname(os.__file__)) or any(  # noqa: PTH120
        f"{os.sep}{folder}{os.sep}" in file for folder in ("site-packages", "dist-packages")
    )


def _origin(name: str) -> str | None:
    """The file that Python loads for a module, or has loaded; None where it has none."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__file__", None)
    specs = (finder.find_spec(name, None) for finder in sys.meta_path)
    return next((spec.origin for spec in specs if spec is not None), None)


_AGAIN = "Install it again: `pip install --force-reinstall --no-deps splatline`"


def _way_out(origin: str) -> str:
    """What to do about a module that is not ours."""
    if not _installed(origin):
        return "rename that one, or work in another folder"
    return "it belongs to another distribution. Install splatline in a separate environment (python -m venv)"
