"""The registry of reconstruction methods: one line for each method, here or in the folder of its feature.

A line gives the module and the name of the method's class. So the names of methods are known without loading their
libraries.
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
"""Name of the method that makes volumes at several times; None: this installation has none."""

WITH_REFERENCE = next((name for name, entry in REGISTRY.items() if entry.reference), None)
"""Name of the method that uses an earlier volume of the same sample; None: this installation has none."""

BASELINE = "fbp"  # Reports compare all methods with this one


def _entry(name: str, method: type[Method]) -> MethodEntry:
    """The registry's line for a method of another package."""
    if not issubclass(method, Method):
        raise ValueError("the class must derive from one of the classes in recon.base.method_kinds")
    if method.name != name:
        raise ValueError(f"the `name` of the method's class is {method.name!r}; expected the name of the entry point")
    entry = MethodEntry(method.__module__, method.__name__, hasattr(method, "stream"))
    if getattr(import_module(entry.module), entry.cls, None) is not method:
        raise ValueError(
            f"the class {method.__qualname__} must be defined at the top level of the module {entry.module}"
        )
    _ = method(), method.label  # every setting has a default
    return entry


METHODS = Registry("method", REGISTRY, _entry, reserved=(AUTO,))
"""The registry of all methods, including those of other packages."""


def names() -> tuple[str, ...]:
    """Names of all methods; imports no module of this project."""
    return tuple(METHODS)


def names_of_one_volume() -> tuple[str, ...]:
    """Names of the methods that make one volume from all projections; imports no module of this project."""
    return tuple(name for name, entry in METHODS.items() if not entry.several)


def names_of_trials() -> tuple[str, ...]:
    """Names of the methods that make one volume and need nothing but the projections, so that a trial can compare these
    methods."""
    return tuple(name for name, entry in METHODS.items() if not (entry.several or entry.reference))


def names_compared() -> tuple[str, ...]:
    """Names of the methods that a trade-off tries by default; imports no module of this project."""
    return tuple(name for name, entry in REGISTRY.items() if entry.compared)


def streams(name: str) -> bool:
    """Whether a method can reconstruct during the scan; False for AUTO. The function imports no module of this project.

    Raises:
        ValueError: the name is unknown.
    """
    return name != AUTO and METHODS[name].streams


def by_name(name: str) -> type[Method]:
    """The settings class of a method.

    Raises:
        ValueError: the name is unknown.
    """
    entry = METHODS[name]
    return getattr(loaded(entry.module), entry.cls)


def taking(field: str) -> tuple[str, ...]:
    """Names of the methods that have this setting, such as "iterations" or the nested "fit.loss"."""
    return names_where(lambda method: has_setting(method, field))


def has_setting(method: type[Method], field: str) -> bool:
    """Whether the settings class has this field. "fit.loss" means the field `loss` in the default value of `fit`."""
    value: Any = method()
    *outer, last = field.split(".")
    for name in outer:
        value = getattr(value, name, None)
    return value is not None and last in {f.name for f in fields(value)}


def setting_names(method: Any) -> list[str]:
    """Names of all settings of a method; nested ones as paths, see `taking`."""
    names = []
    for each in fields(method):
        value = getattr(method, each.name)
        names += [f"{each.name}.{inner}" for inner in setting_names(value)] if is_dataclass(value) else [each.name]
    return names


def build(method: type[Method], settings: Mapping[str, Any]) -> Method:
    """A method with these settings, which are named as in `taking`. Other settings have their defaults.

    Raises:
        ValueError: the method does not have the setting, or the value is not allowed.
    """
    for name in settings:
        if not has_setting(method, name):
            if not (owners := ", ".join(taking(name))):
                raise ValueError(unknown(f"setting of {method.name}", name, setting_names(method())))
            raise ValueError(
                f"method {method.name!r} has no setting {name!r}; methods that have this setting: {owners}"
            )
    built: Method = with_settings(method(), settings)
    return built


def with_settings(method: Any, settings: Mapping[str, Any]) -> Any:
    """A method, or a part of its settings, with these settings changed. The settings are named as in `taking`."""
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
    """Names of the methods for which this condition is true."""
    return tuple(name for name in METHODS if holds(by_name(name)))


def accepting(argument: str) -> tuple[str, ...]:
    """Names of the methods that accept an argument, see `Method.takes`."""
    return names_where(lambda method: argument in method.takes)
