"""Phantoms: the sample that a scene's mapping names; a kind's module is imported when it is named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from simulators.beam import Beam
from simulators.mapping import SceneError, build, choose, items, keys, named
from simulators.sample import Sample

Builder = Callable[[str, Mapping[str, Any], Beam], Sample]


def build_sample(where: str, entry: Any, beam: Beam) -> Sample:
    """The sample of a scene.

    Args:
        where: path of the entry, for messages.
        beam: what decides how materials attenuate.

    Raises:
        SceneError: an unknown kind, a wrong value, or a sample that cannot be built.
    """
    kind, rest = named(where, list(_BUILDERS), entry)
    return _BUILDERS[kind](f"{where} ({kind})", rest, beam)


def _battery(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.battery import Battery
    from simulators.phantom import Phantom

    settings = build(Battery, where, mapping)
    try:
        return Phantom.of(settings.solids())
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def _solids(where: str, mapping: Mapping[str, Any], beam: Beam) -> Sample:
    from simulators.phantom import Phantom
    from simulators.solids import SOLIDS

    mapping = keys(where, mapping, legal=("solids",), needed=("solids",))
    return Phantom.of([choose(f"{where}.solids[{i}]", SOLIDS, entry) for i, entry in items(where, "solids", mapping)])


_BUILDERS: Mapping[str, Builder] = {"battery": _battery, "solids": _solids}
