"""Loads a configuration: combines a YAML file, BEAMLINE_* variables and --set overrides into one frozen Config, or
reports its faults.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydantic import ValidationError

from beamline.config.faults import faults
from beamline.config.models import Config as Config
from beamline.config.models import (
    FixedAngles,
    GoldenAngles,
    InterlacedAngles,
    RandomAngles,
)
from beamline.config.rehearsal import rehearsal
from beamline.config.section import Section
from beamline.config.tree import Override, Tree, explain, override, read
from beamline.core.errors import ConfigError
from beamline.core.files import SETTINGS, kind_of_data, text_in
from beamline.core.installed import config_folder as config_folder
from beamline.core.installed import version
from beamline.plan.plan import Place
from recon.base.findings import declared_at

AnySection = TypeVar("AnySection", bound=Section)

NO_LIVE = ("recon.live=false", "scan.decide=off")
"""Overrides of a run without a reconstruction."""

NO_DECISIONS = "The scan follows its plan, because it has no live reconstruction, which scan.decide {} needs."
"""Message to the operator of a run without a reconstruction, if the scan would otherwise make decisions."""


@dataclass(frozen=True, eq=False)
class ReadConfig:
    """A configuration in which each single value is legal. Also the place of each value, and the faults that concern
    several values together (place and sentence).
    """

    config: Config
    tree: Tree
    faults: Sequence[tuple[str, str]]


def load(
    path: str | Path,
    overrides: Iterable[Override] = (),
    environment: Mapping[str, str] | None = None,
    *,
    rehearse: bool = False,
    no_live: Callable[[str], None] | None = None,
) -> Config:
    """Read and validate a configuration file.

    Later sources replace earlier ones: defaults, the file, BEAMLINE_SECTION__KEY variables, then `section.key=value`
    overrides. File names in the file are relative to it; those in variables and overrides, to the working directory.

    Args:
        environment: environment variables; default: os.environ. rehearse: True: use the simulated counterpart of each
            device of a real instrument, see `rehearsal`. no_live: give this function for a run without a live
            reconstruction, whatever the file states. It gets a sentence on what the run does not do for this reason.

    Raises:
        ConfigError: the configuration has faults. The message lists each with file, line, key, the value found and the
            allowed values. Nothing has been started.
    """
    read = read_config(path, overrides, environment, rehearse=rehearse, no_live=no_live)
    _refuse(str(path), read.faults)
    return read.config


def read_config(
    path: str | Path,
    overrides: Iterable[Override] = (),
    environment: Mapping[str, str] | None = None,
    *,
    rehearse: bool = False,
    no_live: Callable[[str], None] | None = None,
) -> ReadConfig:
    """Read a configuration as `load` does, but return the faults that concern several values together. (`load` raises
    these, too.)

    Raises: ConfigError: single values are not legal. The message lists each with its place.
    """
    path = Path(path)
    tree = _read_file(path, "beamline config init")
    _locate(tree.data, path.parent)
    tree = override(tree, overrides, os.environ if environment is None else environment, takes_text)
    if no_live is not None:
        scan = tree.data.get("scan")
        if isinstance(scan, dict) and scan.get("decide") in ("ask", "do"):
            no_live(f"{path}: {NO_DECISIONS.format(scan['decide'])}")
        tree = override(tree, NO_LIVE, {}, takes_text)
    read = _checked(tree, str(path))
    if not rehearse or read.faults:
        return read
    return _checked(Tree(rehearsal(read.config), tree.origins), str(path))


def load_as(model: type[AnySection], path: Path, overrides: Iterable[str] = (), *, printed_by: str) -> AnySection:
    """Read and validate the configuration of another package, as `load` does for a scan. Environment variables do not
    override it. File names in the file are relative to it; those in overrides, to the working directory.

    Args:
        printed_by: the command that prints an example.
    """
    legal = model.model_json_schema()
    tree = _read_file(path, printed_by)
    _locate(tree.data, path.parent)
    tree = override(tree, overrides, {}, lambda keys: takes_text(keys, legal))
    _locate(tree.data, Path())
    try:
        return model.model_validate(tree.data)
    except ValidationError as error:
        _refuse(str(path), explain(error, tree, legal))
        raise


def _read_file(path: Path, printed_by: str) -> Tree:
    try:
        text = text_in(path, SETTINGS)
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; `{printed_by} > my.yaml` creates a configuration to edit.") from None
    except OSError as error:
        if (kind := kind_of_data(path)) is not None:
            raise ConfigError(
                f"{path} is {kind}, not a configuration: `beamline info {path}` shows what it contains. "
                "Nothing was started."
            ) from None
        raise ConfigError(f"{path} cannot be read: {error.strerror}. Nothing was started.") from None
    return read(text, str(path))


def takes_text(keys: Sequence[str], json_schema: Mapping[str, Any] | None = None) -> bool:
    """True if a key of the configuration accepts any text, and nothing else except null. `json_schema`: JSON
    schema of another configuration."""
    legal = declared_at(schema() if json_schema is None else json_schema, tuple(keys), None)
    kinds = {None if "enum" in each or "const" in each else each.get("type") for each in legal}
    return "string" in kinds and kinds <= {"string", "null"}


def changed(config: Config, overrides: Iterable[str]) -> Config:
    """The configuration with other values. The file and the environment are not read again. Raises ConfigError as
    `load` does."""
    name = "the configuration"
    return _validated(override(read(resolved_yaml(config), name), overrides, {}, takes_text), name)


def each_scan(config: Config) -> tuple[Config, ...]:
    """The configuration of each scan of a series (`scan.energies`, `scan.states`). For a single scan, the result
    contains only its own configuration.

    The n-th of N scans begins n / N of an angular step later, or has another random seed. So all scans together contain
    more angles.
    """
    scan, series = config.scan, config.series
    key = "scan.energy" if scan.states is None else "scan.state"
    configs = []
    for n, value in enumerate(series):
        words = ["scan.energies=null", override_of(key, value)]
        if isinstance(scan.angles, RandomAngles):
            words.append(override_of("scan.angles.seed", scan.angles.seed + n))
        elif isinstance(scan.angles, FixedAngles | InterlacedAngles | GoldenAngles):
            step = scan.angles.span_deg / scan.angles.views
            words.append(override_of("scan.angles.start_deg", scan.angles.start_deg + n / len(series) * step))
        if n and scan.states is not None and scan.states.references == "first":  # copies come before the projections
            words += [f"scan.{name}.at=start" for name in ("darks", "flats") if getattr(scan, name).at != Place.NONE]
        configs.append(changed(config, words))
    return tuple(configs) or (config,)


def override_of(key: str, value: object) -> str:
    """The override that sets a key to a plain value, a NumPy scalar or a path. Raises ConfigError for other types."""
    plain = value.item() if isinstance(value, np.generic) else str(value) if isinstance(value, Path) else value
    plain = list(plain) if isinstance(plain, tuple) else plain
    try:
        text = yaml.safe_dump(plain, default_flow_style=True, width=math.inf, allow_unicode=True)
    except yaml.YAMLError:
        raise ConfigError(
            f"{key}: {value!r} is not allowed; expected a number, a text, a list or a group. Nothing was started."
        ) from None
    return f"{key}={text.removesuffix('...' + chr(10)).strip()}"


def _validated(tree: Tree, name: str) -> Config:
    read = _checked(tree, name)
    _refuse(name, read.faults)
    return read.config


def _checked(tree: Tree, name: str) -> ReadConfig:
    _locate(tree.data, Path())
    try:
        config = Config.model_validate(tree.data)
    except ValidationError as error:
        _refuse(name, explain(error, tree, schema()))
        raise
    return ReadConfig(config, tree, [(tree.origin(keys), fault) for keys, fault in faults(config, config_folder())])


def _refuse(path: str, faults_found: Sequence[tuple[str, str]]) -> None:
    lines = [f"{place}: {fault}" for place, fault in faults_found]
    if len(lines) == 1:
        raise ConfigError(
            f"{lines[0]}{'' if lines[0].endswith('?') else '.'} Nothing was started.", faults_found
        ) from None
    if lines:
        whole = "".join(f"\n  {line}" for line in lines)
        raise ConfigError(f"{path} has {len(lines)} faults, nothing was started:{whole}", faults_found) from None


def resolved_yaml(config: Section) -> str:
    """The whole configuration as text, with every default filled in, and the version in the first line. `load` can read
    this text."""
    body = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=120)
    return f"# splatline {version()}\n{body}"


@cache
def schema() -> dict[str, Any]:
    """JSON schema of a configuration file."""
    return Config.model_json_schema()


def scene_mapping(config: Config) -> dict[str, Any]:
    """The simulated scene as plain values, read from its file if the configuration names one.

    Raises:
        ConfigError: the file does not exist, or is not a group of keys.
    """
    scene = config.simulation.scene if config.simulation else {}
    if isinstance(scene, dict):
        return scene
    path = config_folder() / scene  # an absolute path is not changed
    try:
        text = text_in(path, SETTINGS)
    except OSError as error:
        raise ConfigError(
            f"simulation.scene: {path} cannot be read ({error.strerror or error}). Nothing was started."
        ) from None
    return read(text, str(path)).data


def _locate(data: Any, folder: Path) -> None:
    """Make the file names in plain configuration values independent of the working directory. The values are changed in
    place."""
    if (scan := _group(data, "scan", "angles", "path")) is not None:
        scan["path"] = str((folder / scan["path"]).resolve())
    if (of_recon := _group(data, "recon", "reference")) is not None:
        of_recon["reference"] = str((folder / of_recon["reference"]).resolve())
    if (simulation := _group(data, "simulation", "scene")) is not None:
        scene_file, shipped = (folder / simulation["scene"]).resolve(), config_folder().resolve()
        # kept as a short name, so that the resolved configuration also works on another computer
        if scene_file.is_relative_to(shipped):
            simulation["scene"] = scene_file.relative_to(shipped).as_posix()
        elif scene_file.is_file():  # otherwise the name would count as that of a shipped file
            simulation["scene"] = str(scene_file)
    for key in ("file", "labels"):  # file of a volume in a scene inside the configuration
        if (phantom := _group(data, "simulation", "scene", "phantom", key)) is not None:
            phantom[key] = str((folder / phantom[key]).resolve())


def _group(data: Any, *path: str) -> dict[str, Any] | None:
    """The group with the key at the end of `path`, if the key holds text."""
    for name in path[:-1]:
        data = data.get(name) if isinstance(data, dict) else None
    return data if isinstance(data, dict) and isinstance(data.get(path[-1]), str) else None
