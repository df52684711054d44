"""Registry: all entries of one kind by name, from splatline and from other packages (entry points).

The entry points are in the group `splatline.KIND`. KIND is method, correction, reader, volume_format, stage, wire,
camera, check, effect or command. The name of the entry point is the name of the addition.
"""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules
from typing import Any, Generic, Literal, TypeVar

_PREFIX = "splatline."
ADD_ONS = {
    "cluster": "splatline-cluster",
    "emission": "splatline-emission",
    **dict.fromkeys(("area_detector", "publish", "ride"), "splatline-areadetector"),
    **dict.fromkeys(("intratomo", "naf", "sax-nerf"), "splatline-neural"),
    **dict.fromkeys(("render", "surface", "voxelise"), "splatline-models"),
    **dict.fromkeys(("structure", "study structure"), "splatline-structure"),
    "tango": "splatline-tango",
    **dict.fromkeys(("materials", "xafs"), "splatline-spectral"),
}
"""Names that our add-on packages provide, and the package of each (the folders in `packages/` of the repository)."""
_LIKENESS = 0.65  # similarity, 0 to 1, above which another name is suggested

T = TypeVar("T")


def unknown(kind: str, name: object, legal: Iterable[str]) -> str:
    """The message for an unknown name, with the legal names and the most similar one; without a full stop.

    Args:
        kind: what the name is for, such as "method"; empty if the caller's sentence already says it.
    """
    if str(name) in ADD_ONS:
        return f"{kind} {name!r} {add_on_missing(str(name))}".lstrip()
    names = list(legal)
    return f"{kind} {name!r} is unknown; legal: {', '.join(names) or 'none'}{did_you_mean(name, names)}".lstrip()


def add_on_missing(name: str) -> str:
    """The end of a sentence, without a full stop, that says why an add-on of `ADD_ONS` is missing and what to do."""
    for point in entry_points_announced():
        if point.name == name:
            reason = "is installed, but could not be used: read the earlier warning, which gives the reason"
            try:
                point.load()
            except (Exception, SystemExit) as error:
                reason = _one_line(f"{type(error).__name__}: {error}")
            package = ADD_ONS[name] if point.dist is None else point.dist.name
            reinstall = f"pip install --force-reinstall {package}"
            return f"is installed, but does not load ({point.value}: {reason}). Try: {reinstall}"
    return f"is in a package that is not installed. Install it with: pip install {ADD_ONS[name]}"


def did_you_mean(name: object, legal: Iterable[str]) -> str:
    """The end of a sentence that suggests the most similar legal name, with a space before it; "" if no name is
    similar."""
    return f" (did you mean {nearest_name}?)" if (nearest_name := nearest(name, legal)) else ""


def nearest(name: object, legal: Iterable[str]) -> str:
    """The legal name that was probably meant; "" if no name is similar."""
    from difflib import get_close_matches  # imported here, because only an error message needs it

    return next(iter(get_close_matches(str(name), list(legal), n=1, cutoff=_LIKENESS)), "")


@contextmanager
def signals_waiting() -> Iterator[None]:
    """Delays signal handlers until the context ends. Only the main thread waits, because Python runs signal handlers
    there.

    If a handler raised an exception during an import, the library would be only half loaded. numba and torch would then
    fail until Python is restarted.
    """
    received = list[tuple[Any, Any]]()
    with ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            handlers = {s: handler for s in signal.valid_signals() if callable(handler := signal.getsignal(s))}
            stack.callback(lambda: [handlers[s](s, frame) for s, frame in received])  # runs last
            for number, handler in handlers.items():
                stack.callback(signal.signal, number, handler)
                signal.signal(number, lambda s, frame: received.append((s, frame)))
        yield


class LibraryError(ImportError):
    """A third-party library cannot be loaded."""


def loaded(module: str) -> Any:
    """The module, as from `importlib.import_module`; signals wait until its first import has ended.

    Raises:
        LibraryError: the module is not ours, and its import failed.
    """
    with nullcontext() if module in sys.modules else signals_waiting():
        try:
            return import_module(module)
        except Exception as error:
            if module.partition(".")[0] in ("recon", "beamline") or isinstance(error, MemoryError):
                raise
            raise LibraryError(f"{module} cannot be loaded: {_one_line(str(error))}", name=module) from error


class UnknownNameError(ValueError, KeyError):
    """A registry has no entry of this name."""

    def __str__(self) -> str:
        return str(self.args[0])


class Registry(Mapping[str, T], Generic[T]):
    """The entries of a kind by name: first those of splatline, then those of other packages in alphabetical order.

    Other packages are searched at the first use, so that programs that do not use the registry start quickly.

    Args:
        kind: kind of its entries, as above.
        ours: the entries of splatline.
        made: function that makes an entry from the name and the object of an entry point. It raises ValueError if the
            object is not suitable.
        reserved: further names that no addition may have.

    Raises (when a name is looked up):
        UnknownNameError: there is no entry with this name; the message lists all names.
    """

    def __init__(
        self,
        kind: str,
        ours: Mapping[str, T],
        made: Callable[[str, Any], T] = lambda name, found: found,
        reserved: Collection[str] = (),
    ) -> None:
        self.kind, self.ours, self._made, self._reserved = kind, ours, made, reserved

    @cached_property
    def _entries(self) -> Mapping[str, T]:
        return {**self.ours, **plugins(self.kind, (*self.ours, *self._reserved), self._made)}

    def __getitem__(self, name: str) -> T:
        try:
            return self._entries[name]
        except KeyError:
            raise UnknownNameError(unknown(self.kind.replace("_", " "), name, self._entries)) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


def tables_in_folders(package: str, table: str) -> dict[str, Mapping[str, Any]]:
    """The dictionaries named `table` in the folders of a package, by folder in alphabetical order."""
    folders = sorted(name for _, name, is_folder in iter_modules(import_module(package).__path__) if is_folder)
    return {folder: getattr(import_module(f"{package}.{folder}"), table, {}) for folder in folders}


def in_folders(package: str, table: str) -> dict[str, Any]:
    """The dictionaries named `table` in the folders of a package, merged in alphabetical order of the folders."""
    return {name: row for rows in tables_in_folders(package, table).values() for name, row in rows.items()}


def plugins(
    kind: str, taken: Collection[str], made: Callable[[str, Any], Any] = lambda name, found: found
) -> dict[str, Any]:
    """The additions of other packages to a registry, by name in alphabetical order.

    Args:
        kind: kind of the registry, as above.
        taken: names that the registry already contains. made: function that makes the registry's entry from a name and
            the loaded object. It raises ValueError if the object is not suitable.

    Warns:
        UserWarning: a plug-in is left out because its name is taken, it cannot be loaded, or its object is not
            suitable.
    """
    announced = sorted(point for point in entry_points_announced() if point.group == _PREFIX + kind)
    times, found = Counter(point.name for point in announced), dict[str, Any]()
    for point in announced:
        try:
            if point.name in taken or times[point.name] > 1:
                owner = "splatline" if point.name in taken else "another plug-in"
                raise ValueError(f"the name is already used by {owner}; choose another name")
            with signals_waiting(), redirect_stdout(sys.stderr):  # stdout is for results
                found[point.name] = made(point.name, point.load())
        except (Exception, SystemExit) as error:  # an error in another package must not stop a scan
            package = f" of the package {point.dist.name}" if point.dist is not None else ""
            reason = f"{point.name!r}{package} ({point.value}) was left out: {type(error).__name__}: {error}"
            warnings.warn(
                f"The {kind.replace('_', ' ')} {_one_line(reason)}. Everything else works without this plug-in. "
                "Repair the package of the plug-in, or uninstall it.",
                stacklevel=2,
            )
    return found


def _one_line(text: str) -> str:
    """The text on one line, shortened, without control characters, which could change a terminal or a log."""
    line = " ".join(text[:1000].split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


@cache
def entry_points_announced() -> tuple[EntryPoint, ...]:
    """Entry points of all installed packages. Reading them takes a tenth of a second, once per process."""
    found = entry_points()
    return tuple(point for group in found.groups if group.startswith(_PREFIX) for point in found.select(group=group))


@dataclass(frozen=True)
class Lengths:
    """Numbers of iterations or steps with which a trade-off runs a method.

    Attributes:
        setting: "iterations" or "steps".
        quick, full: numbers for a quick and for a full trade-off. The first number is the baseline for other
            variations.
    """

    setting: Literal["iterations", "steps"]
    quick: tuple[int, ...]
    full: tuple[int, ...]


@dataclass(frozen=True)
class MethodEntry:
    """Entry of a method: the location of its settings class, and whether comparisons include the method.

    Attributes:
        module, cls: module and name of the settings class, see `recon.base.method.Method`.
        streams: True if the method has `stream`, so that it can reconstruct during a scan.
        compared: True if a trade-off includes the method by default. False for methods that take many times as long as
            others.
        several: for a method that makes several volumes, the quantity in which the volumes differ.
        lengths: numbers of iterations or steps that a trade-off tries; None: only the default number.
        reference: True if the method can use an earlier volume of the same sample.
    """

    module: str
    cls: str
    streams: bool = False
    compared: bool = True
    several: Literal["", "times"] = ""
    lengths: Lengths | None = None
    reference: bool = False
