"""Facts about the installation: the version, the configurations and scenes of the package, and advice if the
installation is broken."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from traceback import walk_tb
from types import FrameType, ModuleType, TracebackType


def config_folder() -> Path:
    """The folder with the configurations that come with the package. In a checkout it is next to the packages."""
    installed = Path(__file__).parents[1] / "configs"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "configs"


def shipped_scenes() -> dict[str, Path]:
    """The scenes that come with the package, by name."""
    return {path.stem: path for path in sorted((config_folder() / "scenes").glob("*.yaml"))}


def version() -> str:
    """The version of the installed distribution; "uninstalled" if the program runs from a checkout that is not
    installed."""
    from importlib import metadata  # imported here, because it imports many modules, which a file of the user may hide

    try:
        return metadata.version("splatline")
    except metadata.PackageNotFoundError:
        return "uninstalled"


OWN_PACKAGES = ("drivers", "recon", "simulators")
_MARK = b"splatline"  # a word in the first line of the __init__.py of each package
# libraries that our packages import; each is a folder, so that a file of the same name is another module
_LIBRARIES = (
    *("PIL", "click", "h5py", "hdf5plugin", "jinja2", "matplotlib", "numba", "numpy", "psutil", "pydantic", "rich"),
    *("scipy", "serial", "skimage", "starlette", "tifffile", "torch", "usb", "uvicorn", "yaml", "zlib_ng"),
)
_DISTRIBUTIONS = {
    **{"PIL": "pillow", "serial": "pyserial", "skimage": "scikit-image", "usb": "pyusb", "yaml": "pyyaml"},
    "zlib_ng": "zlib-ng",
}
_IMPORTERS = ("importlib", "_frozen_importlib", "_frozen_importlib_external")
_WITHOUT = {"torch": " Methods that work without torch: -m fbp, -m fista-tv, -m auto."}


def package_problem(home: str) -> str:
    """A sentence with advice if Python imports another module under the name of one of this project's packages; ""
    otherwise.

    Args:
        home: the folder that holds our packages.
    """
    for name in OWN_PACKAGES:
        ours = os.path.join(home, name, "__init__.py")  # noqa: PTH118 - to load pathlib takes longer than this check
        origin = _origin(name)
        if origin is None:
            return f"splatline is incomplete: Python finds no package {name!r}. {_AGAIN}."
        if origin != ours and os.path.realpath(origin) != os.path.realpath(ours):
            return (
                f"Python finds {name!r} at {origin} instead of the module of splatline at {ours}: {_way_out(origin)}."
            )
        with open(origin, "rb") as file:  # noqa: PTH123
            if _MARK not in file.readline():
                return f"{origin} is not splatline's: {_way_out(origin)}."
    for name in _LIBRARIES:
        if (origin := _origin(name) or "").endswith(f"{os.sep}{name}.py"):
            return f"{origin} hides the library {name!r}, which splatline needs: {_way_out(origin)}."
    return ""


def installation_problem(error: BaseException) -> str:
    """A sentence with advice if `error` was raised while a library was loaded; "" for other errors."""
    if _ours(name := _library(error)):
        return str(error) if name == "splatline" else ""  # which says all
    cause, origin, package = error.__cause__ or error, _origin(name), _DISTRIBUTIONS.get(name, name)
    if origin is None:
        advice = f"{sys.executable} does not find this library. Install it: pip install {package}"
    elif name in sys.stdlib_module_names or not _installed(origin):
        advice = (
            f"Python finds a library of this name at {origin}. If the library there is a different package, "
            f"{_way_out(origin)}; otherwise install the library again"
        )
    else:
        advice = f"The library is at {origin}. Install it again: pip install --force-reinstall {package}"
    reason = " ".join(f"{type(cause).__name__}: {cause}".split())
    return f"the library {name!r} cannot be loaded ({reason}). {advice}.{_WITHOUT.get(name, '')}"


def as_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """A `sys.excepthook` that prints in one line which library cannot be loaded, or that Ctrl-C ended the command while
    it was loaded."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("beamline: interrupted\n")
        sys.exit(130)  # as errors.INTERRUPTED, in a module that is loaded later
    if problem := installation_problem(error):
        sys.stderr.write(f"beamline: {problem}\n")
        sys.exit(2)
    sys.__excepthook__(kind, error, trace)


def _library(error: BaseException) -> str:
    """The top-level name of the module whose import raised the error; "" if no import raised it."""
    failed = isinstance(error, ImportError)
    if isinstance(error, ImportError) and error.name:
        return error.name.partition(".")[0]
    module = error.obj if isinstance(error, AttributeError) else None
    if isinstance(module, ModuleType) and not _installed(getattr(module, "__file__", None) or os.__file__):
        return module.__name__.partition(".")[0]  # np.zeros, where np is the user's
    frames = [
        (str(frame.f_globals.get("__name__")).partition(".")[0], frame.f_code.co_name)
        for frame, _ in walk_tb(error.__traceback__)
    ]
    last = max((index for index, (root, _) in enumerate(frames) if _ours(root)), default=-1)
    called = [frame for frame in frames[last + 1 :] if frame[0] not in _IMPORTERS]
    return next((root for root, what in called[:1] if failed or what == "<module>"), "")


def _ours(root: str) -> bool:
    return root in ("", "__main__", "beamline", *OWN_PACKAGES) or root.startswith("splatline")


def of_library(frame: FrameType) -> bool:
    """Whether the code in a stack frame belongs to Python or to an installed package of others."""
    root = str(frame.f_globals.get("__name__")).partition(".")[0]
    return not _ours(root) and _installed(_origin(root) or frame.f_code.co_filename)


def _installed(file: str) -> bool:
    """Whether a file lies where Python or pip puts modules."""
    return file.startswith(os.path.dirname(os.__file__)) or any(  # noqa: PTH120
        f"{os.sep}{folder}{os.sep}" in file for folder in ("site-packages", "dist-packages")
    )


def _origin(name: str) -> str | None:
    """The file that Python loads for a module, or has loaded; None if the module has no file."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__file__", None)
    with suppress(ImportError):  # of a finder that forbids the library
        specs = (finder.find_spec(name, None) for finder in sys.meta_path)
        return next((spec.origin for spec in specs if spec is not None), None)
    return None


_AGAIN = "Install it again: `pip install --force-reinstall --no-deps splatline`"


def _way_out(origin: str) -> str:
    """What the user can do about a module that is not ours."""
    if not _installed(origin):
        return "rename that file or folder, or work in another folder"
    return "this package belongs to another distribution. Install splatline in a separate environment (python -m venv)"
