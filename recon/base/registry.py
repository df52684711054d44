"""Registry: entries of one kind by name: ours, and those that other installed packages add by entry points; loaded.

Their group is `splatline.KIND`, where KIND is method, correction, reader, volume_format, stage, wire, camera, check,
effect or command; the entry point's name is the name of the addition.
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
"""Names that packages beside this one add, and the package of each: folders of `packages/` in the repository."""
_LIKENESS = 0.65  # of 1: from which likeness on a name may have been meant

T = TypeVar("T")


def unknown(kind: str, name: object, legal: Iterable[str]) -> str:
    """The message for an unknown name, with the legal names and the nearest one; without a full stop.

    Args:
        kind: what the name is of, such as "method"; empty where the sentence goes on from that.
    """
    if str(name) in ADD_ONS:
        return f"{kind} {name!r} {add_on_missing(str(name))}".lstrip()
    names = list(legal)
    return f"{kind} {name!r} is unknown; legal: {', '.join(names) or 'none'}{did_you_mean(name, names)}".lstrip()


def add_on_missing(name: str) -> str:
    """Why an add-on of `ADD_ONS` is not there, and what to do, as the end of a sentence without a full stop."""
    for point in entry_points_announced():
        if point.name == name:
            why = "a warning says why it was left out"
            try:
                point.load()
            except (Exception, SystemExit) as error:
                why = _one_line(f"{type(error).__name__}: {error}")
            package = ADD_ONS[name] if point.dist is None else point.dist.name
            return f"is installed, but does not work ({point.value}: {why}): pip install --force-reinstall {package}"
    return f"needs a package that is not installed: pip install {ADD_ONS[name]}"


def did_you_mean(name: object, legal: Iterable[str]) -> str:
    """The nearest legal name as the end of a sentence, after a space; "" if none is near."""
    return f" (did you mean {near}?)" if (near := nearest(name, legal)) else ""


def nearest(name: object, legal: Iterable[str]) -> str:
    """The legal name that was probably meant; "" if none is near."""
    from difflib import get_close_matches  # here: only errors need it

    return next(iter(get_close_matches(str(name), list(legal), n=1, cutoff=_LIKENESS)), "")


@contextmanager
def signals_waiting() -> Iterator[None]:
    """Handlers of signals are called when the context ends. Python runs them in the main thread, so only it waits.

    An exception of a handler in the middle of an import leaves half of a library: numba and torch then fail until
    Python is started anew.
    """
    came = list[tuple[Any, Any]]()
    with ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            handlers = {s: handler for s in signal.valid_signals() if callable(handler := signal.getsignal(s))}
            stack.callback(lambda: [handlers[s](s, frame) for s, frame in came])  # at last
            for number, handler in handlers.items():
                stack.callback(signal.signal, number, handler)
                signal.signal(number, lambda s, frame: came.append((s, frame)))
        yield


class LibraryError(ImportError):
    """A library of others cannot be loaded."""


def loaded(module: str) -> Any:
    """The module, as `importlib.import_module`; its first import ends before a signal is handled.

    Raises:
        LibraryError: the import of another project's module failed.
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
    """The entries of a kind, by name: ours first, then those of other packages in the order of their names.

    Other packages are asked at the first use, so that programs without it start quickly.

    Args:
        kind: of its entries, as above.
        ours: our own.
        made: makes an entry from the name and the object of an entry point; ValueError if the object does not fit.
        reserved: names that no addition may have, beside ours.

    Raises (where a name is looked up):
        UnknownNameError: there is none of this name; the message has all names.
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
    """The dictionaries named `table` of the folders of a package, by folder in the order of their names."""
    folders = sorted(name for _, name, is_folder in iter_modules(import_module(package).__path__) if is_folder)
    return {folder: getattr(import_module(f"{package}.{folder}"), table, {}) for folder in folders}


def in_folders(package: str, table: str) -> dict[str, Any]:
    """The dictionaries named `table` of the folders of a package, joined in the order of the folders' names."""
    return {name: row for rows in tables_in_folders(package, table).values() for name, row in rows.items()}


def plugins(
    kind: str, taken: Collection[str], made: Callable[[str, Any], Any] = lambda name, found: found
) -> dict[str, Any]:
    """The additions of other packages to a registry, by name, in the order of the names.

    Args:
        kind: of the registry, as above.
        taken: names that the registry has itself.
        made: makes the registry's entry from a name and the loaded object; ValueError if the object does not fit.

    Warns:
        UserWarning: a plug-in is left out because its name is taken, it cannot be loaded, or it does not fit.
    """
    announced = sorted(point for point in entry_points_announced() if point.group == _PREFIX + kind)
    times, found = Counter(point.name for point in announced), dict[str, Any]()
    for point in announced:
        try:
            if point.name in taken or times[point.name] > 1:
                by = "splatline" if point.name in taken else "another plug-in"
                raise ValueError(f"the name is taken by {by}; expected another name")
            with signals_waiting(), redirect_stdout(sys.stderr):  # stdout is for results
                found[point.name] = made(point.name, point.load())
        except (Exception, SystemExit) as error:  # another package's fault must not stop a scan
            package = f" of the package {point.dist.name}" if point.dist is not None else ""
            told = f"{point.name!r}{package} ({point.value}) was left out: {type(error).__name__}: {error}"
            warnings.warn(
                f"The {kind.replace('_', ' ')} {_one_line(told)}. Mend or uninstall that package; all else works "
                "without it.",
                stacklevel=2,
            )
    return found


def _one_line(text: str) -> str:
    """The text without control characters, which would act on a terminal or begin a line of a log; not too long."""
    line = " ".join(text[:1000].split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


@cache
def entry_points_announced() -> tuple[EntryPoint, ...]:
    """Entry points of all installed packages; reading them takes a tenth of a second, once a process."""
    found = entry_points()
    return tuple(point for group in found.groups if group.startswith(_PREFIX) for point in found.select(group=group))


@dataclass(frozen=True)
class Lengths:
    """Numbers of iterations or steps that a comparison tries of a method.

    Attributes:
        setting: "iterations" or "steps".
        quick, full: of a short and of a long comparison. The first one is the baseline, about which others vary.
    """

    setting: Literal["iterations", "steps"]
    quick: tuple[int, ...]
    full: tuple[int, ...]


@dataclass(frozen=True)
class MethodEntry:
    """Where the settings class of a method is, and when it is compared with others.

    Attributes:
        module, cls: of its settings class, see `recon.base.method.Method`.
        streams: it has `stream`, so that its volume can grow while views arrive.
        compared: a trade-off tries it if no methods are named; False for methods that take many times as long.
        several: what its volumes are of, where it makes several.
        lengths: that a trade-off tries; None: the default.
    """

    module: str
    cls: str
    streams: bool = False
    compared: bool = True
    several: Literal["", "times"] = ""
    lengths: Lengths | None = None
