"""The registry of reconstruction methods: one line a method, here or in the folder of its feature.

A line says where the method's class is, so that its name is known without loading its libraries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from typing import Any

from recon.base.choices import AUTO
from recon.base.declared_types import is_of_type, refusal, types_of
from recon.base.method import Method
from recon.base.registry import Lengths, MethodEntry, Registry, in_folders, loaded, unknown

REGISTRY: dict[str, MethodEntry] = {
    "r2": MethodEntry(
        "recon.splatting.r2",
        "R2",
        streams=True,
        lengths=Lengths("steps", (250, 60, 125, 500), (1000, 125, 250, 500, 2000)),
    ),
    "fbp": MethodEntry("recon.voxels.direct", "Fbp"),
    "fista-tv": MethodEntry("recon.voxels.methods", "FistaTv", lengths=Lengths("iterations", (60, 5), (60, 5, 10, 20))),
    "os-sirt-tv": MethodEntry(
        "recon.voxels.methods", "OsSirtTv", lengths=Lengths("iterations", (60, 5), (60, 5, 10, 20))
    ),
    "pnp-dct": MethodEntry("recon.voxels.methods", "PnpDct", lengths=Lengths("iterations", (35,), (35, 15, 70))),
    **in_folders("recon.features", "METHODS"),
}

_CANDIDATES: dict[str, float] = {"fbp": 0, "fista-tv": 1, "pnp-dct": 2, "r2": 3}
_CANDIDATES |= in_folders("recon.features", "CANDIDATES")
CANDIDATES = tuple(sorted(_CANDIDATES, key=lambda name: _CANDIDATES[name]))
"""Names of the methods that `auto` tries, the simplest and cheapest first."""

DEFAULT = "r2"  # The default method

IN_TIME = next((name for name, entry in REGISTRY.items() if entry.several == "times"), None)
"""The method of volumes in time; None: this installation has none."""

BASELINE = "fbp"  # Reports compare all methods with this one


def _made(name: str, method: type[Method]) -> MethodEntry:
    """The line of another package's method."""
    if not issubclass(method, Method):
        raise ValueError("its class has no kind of recon.base.method_kinds as a base")
    if method.name != name:
        raise ValueError(f"its class calls itself {method.name!r}; expected the entry point's name")
    entry = MethodEntry(method.__module__, method.__name__, hasattr(method, "stream"))
    if getattr(import_module(entry.module), entry.cls, None) is not method:
        raise ValueError(f"its class {method.__qualname__} is not at the top of the module {entry.module}")
    _ = method(), method.label  # every setting has a default
    return entry


METHODS = Registry("method", REGISTRY, _made, reserved=(AUTO,))
"""All methods, with those of other packages."""


def names() -> tuple[str, ...]:
    """Names of all methods; imports no module of this project."""
    return tuple(METHODS)


def names_of_one_volume() -> tuple[str, ...]:
    """Names of the methods that make one volume of all views, as rows of a table do; imports no module of this
    project."""
    return tuple(name for name, entry in METHODS.items() if not entry.several)


def names_compared() -> tuple[str, ...]:
    """Names of the methods that a trade-off tries by default; imports no module of this project."""
    return tuple(name for name, entry in REGISTRY.items() if entry.compared)


def streams(name: str) -> bool:
    """Whether a method's volume can grow while views arrive, which AUTO does not promise; imports nothing.

    Raises:
        ValueError: for an unknown name.
    """
    return name != AUTO and METHODS[name].streams


def by_name(name: str) -> type[Method]:
    """The settings class of a method.

    Raises:
        ValueError: for an unknown name.
    """
    entry = METHODS[name]
    return getattr(loaded(entry.module), entry.cls)


def taking(field: str) -> tuple[str, ...]:
    """Names of the methods that have a setting, such as "iterations", or "fit.loss" of a nested one."""
    return names_where(lambda method: has_setting(method, field))


def has_setting(method: type[Method], field: str) -> bool:
    """Whether the settings class has this field; "fit.loss" is the field of the default value of `fit`."""
    value: Any = method()
    *outer, last = field.split(".")
    for name in outer:
        value = getattr(value, name, None)
    return value is not None and last in {f.name for f in fields(value)}


def setting_names(method: Any) -> list[str]:
    """Names of all settings of a method, by path as in `taking`."""
    names = []
    for each in fields(method):
        value = getattr(method, each.name)
        names += [f"{each.name}.{inner}" for inner in setting_names(value)] if is_dataclass(value) else [each.name]
    return names


def build(method: type[Method], settings: Mapping[str, Any]) -> Method:
    """A method with these settings, by name as in `taking`; other settings have their defaults.

    Raises:
        ValueError: the method lacks the setting, or refuses the value.
    """
    for name in settings:
        if not has_setting(method, name):
            if not (owners := ", ".join(taking(name))):
                raise ValueError(unknown(f"setting of {method.name}", name, setting_names(method())))
            raise ValueError(f"method {method.name!r} has no setting {name!r} ({owners} has)")
    found: Method = with_settings(method(), settings)
    return found


def with_settings(method: Any, settings: Mapping[str, Any]) -> Any:
    """A method, or a part of its settings, with these changed, by name as in `taking`."""
    flat = {name: setting for name, setting in settings.items() if "." not in name}
    nested: dict[str, dict[str, Any]] = {}
    for name, setting in settings.items():
        if "." in name:
            outer, inner = name.split(".", 1)
            nested.setdefault(outer, {})[inner] = setting
    kinds = types_of(method.__class__)
    for name, value in flat.items():
        if not is_of_type(value, kinds.get(name, Any)):
            raise ValueError(refusal(name, value, kinds[name]))
    return replace(
        method, **flat, **{name: with_settings(getattr(method, name), inner) for name, inner in nested.items()}
    )


def names_where(holds: Callable[[type[Method]], object]) -> tuple[str, ...]:
    """Names of the methods of which this holds."""
    return tuple(name for name in METHODS if holds(by_name(name)))


def accepting(argument: str) -> tuple[str, ...]:
    """Names of the methods that accept an argument, see `Method.takes`."""
    return names_where(lambda method: argument in method.takes)
