"""The registry of reconstruction methods: one line a method. Adding one takes its file and its line here.

A line says where the method's class is, so that its name is known without loading its libraries.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib import import_module
from typing import Any, Literal

from recon.base.choices import AUTO
from recon.base.method import Method
from recon.base.registry import Registry


@dataclass(frozen=True)
class MethodEntry:
    """Where a method is.

    Attributes:
        module, cls: of its settings class, see `recon.base.method.Method`.
        streams: it has `stream`, so that its volume can grow while views arrive.
        compared: a trade-off tries it if no methods are named; False for methods that take many times as long.
        emission: it is compared where the sample emits, whatever `compared` says.
        several: what its volumes are of, where it makes several.
    """

    module: str
    cls: str
    streams: bool = False
    compared: bool = True
    emission: bool = False
    several: Literal["", "times", "materials"] = ""


REGISTRY: dict[str, MethodEntry] = {
    "r2": MethodEntry("recon.splatting.r2", "R2", streams=True),
    "r2-published": MethodEntry("recon.splatting.published", "R2Published", streams=True, compared=False),
    "fbp": MethodEntry("recon.voxels.direct", "Fbp"),
    "sirt": MethodEntry("recon.voxels.methods.sirt", "Sirt"),
    "sart": MethodEntry("recon.voxels.methods.sart", "Sart"),
    "cgls": MethodEntry("recon.voxels.methods.cgls", "Cgls"),
    "mlem": MethodEntry("recon.voxels.methods.mlem", "Mlem", compared=False, emission=True),
    "osem": MethodEntry("recon.voxels.methods.mlem", "Osem", compared=False, emission=True),
    "asd-pocs": MethodEntry("recon.voxels.methods.asd_pocs", "AsdPocs"),
    "fista-tv": MethodEntry("recon.voxels.methods.fista_tv", "FistaTv"),
    "os-sirt-tv": MethodEntry("recon.voxels.methods.os_sirt_tv", "OsSirtTv"),
    "pnp-dct": MethodEntry("recon.voxels.methods.pnp_dct", "PnpDct"),
    "series": MethodEntry("recon.joint_methods", "TimeSeries", compared=False, several="times"),
    "materials": MethodEntry("recon.joint_methods", "EnergySeries", compared=False, several="materials"),
    "naf": MethodEntry("recon.fields.methods", "NAF", compared=False),
    "intratomo": MethodEntry("recon.fields.methods", "IntraTomo", compared=False),
    "sax-nerf": MethodEntry("recon.fields.methods", "SaxNerf", compared=False),
}

DEFAULT = "r2"  # The default method

IN_TIME = "series"  # The method of volumes in time

BASELINE = "fbp"  # Reports compare all methods with this one


def _made(name: str, method: type[Method]) -> MethodEntry:
    """The line of another package's method."""
    if method.name != name:
        raise ValueError(f"its class calls itself {method.name!r}; expected the entry point's name")
    entry = MethodEntry(method.__module__, method.__name__, hasattr(method, "stream"))
    if getattr(import_module(entry.module), entry.cls, None) is not method:
        raise ValueError(f"its class {method.__qualname__} is not at the top of the module {entry.module}")
    _ = method(), method.label, method.traits.direct  # every setting has a default
    return entry


METHODS = Registry("method", REGISTRY, _made, reserved=(AUTO,))
"""All methods, with those of other packages."""


def names() -> tuple[str, ...]:
    """Names of all methods; loads no module of ours."""
    return tuple(METHODS)


def names_of_one_volume() -> tuple[str, ...]:
    """Names of the methods that make one volume of all views, as rows of a table do; loads no module of ours."""
    return tuple(name for name, entry in METHODS.items() if not entry.several)


def names_of_one_scan() -> tuple[str, ...]:
    """Names of the methods that take one scan; loads no module of ours."""
    return tuple(name for name, entry in METHODS.items() if entry.several != "materials")


def names_compared(emission: bool = False) -> tuple[str, ...]:
    """Names of the methods that a trade-off tries by default, more where the sample emits; loads no module of ours."""
    return tuple(name for name, entry in REGISTRY.items() if entry.compared or (emission and entry.emission))


def streams(name: str) -> bool:
    """Whether a method's volume can grow while views arrive; loads nothing.

    Raises:
        ValueError: for an unknown name.
    """
    return METHODS[name].streams


def by_name(name: str) -> type[Method]:
    """The settings class of a method.

    Raises:
        ValueError: for an unknown name.
    """
    entry = METHODS[name]
    return getattr(import_module(entry.module), entry.cls)


def taking(field: str) -> tuple[str, ...]:
    """Names of the methods that have a setting, such as "iterations", or "fit.loss" within another one."""
    return tuple(name for name in METHODS if has_setting(by_name(name), field))


def has_setting(method: type[Method], field: str) -> bool:
    """Whether the settings class has this field; "fit.loss" is the field of the default value of `fit`."""
    value: Any = method()
    *outer, last = field.split(".")
    for name in outer:
        value = getattr(value, name, None)
    return value is not None and last in {f.name for f in fields(value)}


def build(method: type[Method], settings: Mapping[str, Any]) -> Method:
    """A method with these settings, by name as in `taking`; other settings have their defaults.

    Raises:
        ValueError: the method lacks the setting, or refuses the value.
    """
    for name in settings:
        if not has_setting(method, name):
            owners = ", ".join(taking(name)) or "no method"
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
    return replace(
        method, **flat, **{name: with_settings(getattr(method, name), inner) for name, inner in nested.items()}
    )


def with_trait(trait: str) -> tuple[str, ...]:
    """Names of the methods with a trait, a field of `recon.base.method.Traits`."""
    return tuple(name for name in METHODS if getattr(by_name(name).traits, trait))
