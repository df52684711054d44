"""Damaged, altered and malicious inputs, made at random from good ones: scan files, and YAML by its values."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

Rng = np.random.Generator
NUMBERS = (-1, 0, 1, 2, 3, 20, 63, 64, 2**31, -(2**31), 2**62, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324)
ARRAYS: tuple[Any, ...] = (
    np.float64(np.nan), np.int64(-5), np.zeros(0), np.zeros((0, 4, 4)), np.zeros((3, 3)), np.arange(7),
    np.full(40, 1e308),
    np.full(40, np.inf), b"text", "ä" * 300, b"\xff\xfe", np.zeros(4, bool), np.zeros(4, complex),
    np.zeros(4, [("a", "i4"), ("b", "f8")]), np.array([b"a", b"b"]), h5py.Empty("f8"), np.full(30, 2**63, np.uint64),
    np.float32(1e38), np.full((30, 2, 2), 7, np.int8),
)  # fmt: skip
SCALARS = (
    "!!bool x", "!!timestamp x", "!!int x", "!!float x", "!!binary x", "!!null x", "!!set {a}",
    "!!omap [a]", "!!pairs [a]", "!!merge x", "!!python/object:os.system x", "!!str [a]", "!!seq x", "!!map x", "!x y",
    "!<tag:yaml.org,2002:int> ''",
    "1e308", "-1e308", "1e-308", ".nan", ".inf", "-.inf", "0", "-1", "''", "[]", "{}", "~", "2024-01-01", "2024-13-45",
    "1:30", "0x10", "0b2", "yes", "&a [*a]", "{<<: {a: 1}}", "{<<: x}", "{? [a] : b}", "{? {a: b} : c}", "9" * 400,
    "1e999", "/dev/zero", ".", "/", "../..", "'a\\0b'", "|2\n  a", "*nobody", "[[[[[[1]]]]]]", "{x: !!bool y}",
    "!!timestamp 2024-99-99", "!!timestamp ''", "!!bool ''", "!!int ''", "!!float ''", "!!int '0b'", "!!int '-'",
    "!!float '.'", "!!int '1:x'", "2024-01-01T99:00:00Z",
)  # fmt: skip


def _objects(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visit(names.append)
    return names


def _some(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


def flip_bits(path: Path, rng: Rng) -> str:
    content = bytearray(path.read_bytes())
    places = rng.integers(
        len(content) if rng.random() < 0.5 else min(40_000, len(content)), size=int(rng.integers(1, 9))
    )
    for place in places:
        content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)
    return f"bits at {places.tolist()}"


def cut(path: Path, rng: Rng) -> str:
    size = int(rng.integers(path.stat().st_size))
    os.truncate(path, size)
    return f"cut to {size}"


def change_value(path: Path, rng: Rng) -> str:
    with h5py.File(path, "r+") as file:
        names = [name for name in _objects(file) if isinstance(file[name], h5py.Dataset) and file[name].ndim < 3]
        name, said = _some(rng, names), _some(rng, NUMBERS)
        item = file[name]
        if item.dtype.kind not in "iuf":
            return f"{name} left"
        if item.dtype.kind in "iu":
            limits = np.iinfo(item.dtype)
            said = int(min(max(said, limits.min), limits.max)) if np.isfinite(said) else limits.max
        where: Any = ... if item.ndim == 0 or rng.random() < 0.2 or not len(item) else int(rng.integers(len(item)))
        with np.errstate(over="ignore"):
            item[where] = said
    return f"{name}[{where}] = {said}"


def change_array(path: Path, rng: Rng) -> str:
    with h5py.File(path, "r+") as file:
        names = [name for name in _objects(file) if isinstance(file[name], h5py.Dataset)]
        name, number = _some(rng, names), int(rng.integers(len(ARRAYS) + 2))
        attributes = dict(file[name].attrs)
        del file[name]
        if number < len(ARRAYS):
            file[name] = ARRAYS[number]
            said = repr(ARRAYS[number])[:40]
        else:
            shape = ((10**9,), (2**40, 2, 2))[number - len(ARRAYS)]
            file.create_dataset(name, shape, "f8", chunks=tuple(min(n, 64) for n in shape))
            said = str(shape)
        for key, value in attributes.items():
            with suppress(TypeError):
                file[name].attrs[key] = value
    return f"{name} becomes {said}"


def change_attribute(path: Path, rng: Rng) -> str:
    with h5py.File(path, "r+") as file:
        items = ["/", *_objects(file)]
        names = [name for name in items if len(file[name].attrs)]
        item = file[_some(rng, names)]
        key, value = _some(rng, list(item.attrs)), _some(rng, [*ARRAYS, "degree", "parsec", None])
        if value is None:
            del item.attrs[key]
        else:
            item.attrs[key] = value
        return f"{item.name}@{key} = {str(value)[:40]}"


def change_link(path: Path, rng: Rng) -> str:
    """Circles, links to nowhere, to other objects, to devices and pipes."""
    pipe = path.with_name("pipe")
    if hasattr(os, "mkfifo") and not pipe.exists():
        os.mkfifo(pipe)
    with h5py.File(path, "r+") as file:
        names = _objects(file)
        name, other = _some(rng, names), _some(rng, ["/", *names])
        links = (
            None, h5py.SoftLink(f"/{name}"), h5py.SoftLink(f"/{other}"), h5py.SoftLink("/nowhere"),
            h5py.ExternalLink("pipe", "/a"), h5py.ExternalLink("/dev/zero", "/a"),
            h5py.ExternalLink("missing.h5", "/a"),
            h5py.ExternalLink(path.name, f"/{other}"), h5py.ExternalLink(".", "/"), "hard",
        )  # fmt: skip
        link = _some(rng, links)
        target = file[other]
        del file[name]
        if link == "hard":
            parent = file.require_group(name.rpartition("/")[0] or "/")
            parent[name.rpartition("/")[2]] = target
        elif link is not None:
            file[name] = link
        said = getattr(link, "path", link)
    return f"{name} -> {type(link).__name__} {getattr(link, 'filename', '')} {said} {other}"


def deepen(path: Path, rng: Rng) -> str:
    """Groups in groups, more than Python's own depth, or very many beside each other."""
    with h5py.File(path, "r+") as file:
        group = file["/entry"] if "entry" in file and rng.random() < 0.5 else file["/"]
        if rng.random() < 0.5:
            for _ in range(1500):
                group = group.create_group("g")
        else:
            for n in range(3000):
                group.create_group(f"g{n}/instrument")
    return "groups"


FILE: tuple[Callable[[Path, Rng], str], ...] = (
    flip_bits, flip_bits, cut, change_value, change_value, change_value, change_array, change_array, change_attribute,
    change_link, change_link, deepen,
)  # fmt: skip


def mutate_file(path: Path, rng: Rng) -> str:
    """Change a scan file in place; what was done."""
    return _some(rng, FILE)(path, rng)


def mutate_yaml(text: str, rng: Rng) -> tuple[str, str]:
    """Another text, in which one value is something else; and what was done."""
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
            places.append((value, key))
            walk(value[key])

    data = yaml.safe_load(text)
    walk(data)
    holder, key = _some(rng, places)
    said = str(_some(rng, SCALARS))
    holder[key] = "PUT-HERE"
    changed = yaml.safe_dump(data, sort_keys=False, width=10_000).replace("PUT-HERE", said)
    if rng.random() < 0.1:
        at = int(rng.integers(len(changed)))
        changed = changed[:at] + str(_some(rng, list("{}[]:,&*!|>'\"%@`#\t\0\n?-"))) + changed[at:]
    return changed, f"{key}: {said}"
