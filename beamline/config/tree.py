"""Configuration text: YAML, --set and BEAMLINE_* variables as one tree, with the origin of each value."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import yaml

from beamline.core.errors import ConfigError
from beamline.core.files import YAML_FAULTS

KeyPath = tuple[str | int, ...]
ENVIRONMENT_PREFIX = "BEAMLINE_"
_MOST_VALUES, _MOST_DIGITS = 100_000, 1000
_NOTHING = ("", "null", "~")


@dataclass(frozen=True)
class Tree:
    """Plain values, and for each key path its origin ("my.yaml:12", "--set scan.period_s=0.2", ...)."""

    data: dict[str, Any]
    origins: Mapping[KeyPath, str]

    def origin(self, path: KeyPath) -> str:
        """The origin of the value at `path`, or of the nearest group around it."""
        while path not in self.origins and path:
            path = path[:-1]
        return self.origins[path]


def read(text: str, name: str) -> Tree:
    """Parse YAML with safe types only.

    Raises:
        ConfigError: bad syntax, a key said twice, or a top level that is no group of keys; with file and line.
    """
    data, origins = _parsed(text, name)
    if data is None:
        raise ConfigError(f"{name}: is empty; `beamline config init` prints a complete example. Nothing was started.")
    if not isinstance(data, dict):
        raise ConfigError(f"{name}:1: holds no `key: value` lines; `beamline config init` prints a complete example.")
    return Tree(data, origins)


def _parsed(text: str, name: str) -> tuple[Any, dict[KeyPath, str]]:
    """The values in a YAML text, and the place of each."""
    origins: dict[KeyPath, str] = {}
    loader = None
    try:
        loader = yaml.SafeLoader(text)  # refuses control characters
        node = loader.get_single_node()
        if node is None:
            return None, origins
        origins[()] = f"{name}:{_line(node)}"
        _walk(node, (), name, origins)
        return loader.construct_document(node), origins
    except yaml.MarkedYAMLError as error:
        colon = error.problem is not None and "expected ':'" in error.problem  # which is missed at the next line
        mark = (error.context_mark if colon else None) or error.problem_mark or error.context_mark
        where = f"{name}:{mark.line + 1}" if mark and "\n" in text else name
        what = ", ".join(part for part in (error.context, error.problem) if part)
        what = "a colon is missing after a key" if colon else what
        raise ConfigError(f"{where}: this is not YAML ({what}). Nothing was started.") from None
    except (yaml.YAMLError, *YAML_FAULTS) as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{name}: this is not YAML ({what}). Nothing was started.") from None
    except RecursionError:
        raise ConfigError(f"{name}: a value contains itself or is nested too deeply. Nothing was started.") from None
    finally:
        if loader is not None:
            loader.dispose()


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


def _walk(node: yaml.Node, path: KeyPath, name: str, origins: dict[KeyPath, str]) -> None:
    if len(origins) > _MOST_VALUES:  # aliases of aliases can turn a few lines into billions of values
        raise ConfigError(f"{name} holds more than {_MOST_VALUES} values: it is no configuration. Nothing was started.")
    if isinstance(node, yaml.ScalarNode):
        if "\0" in node.value:
            raise ConfigError(f"{name}:{_line(node)}: a text holds a NUL character. Nothing was started.")
        # Python neither reads nor writes very long numbers.
        if node.tag.endswith(":int") and len(node.value) > _MOST_DIGITS:
            raise ConfigError(f"{name}:{_line(node)}: a number has {len(node.value)} digits. Nothing was started.")
    if isinstance(node, yaml.SequenceNode):
        for index, child in enumerate(node.value):
            origins[(*path, index)] = f"{name}:{_line(child)}"
            _walk(child, (*path, index), name, origins)
    if not isinstance(node, yaml.MappingNode):
        return
    seen: dict[str, int] = {}
    for key, child in node.value:
        word = str(key.value)
        if word in seen:
            full = ".".join(map(str, (*path, word)))
            raise ConfigError(
                f"{name}:{_line(key)}: {full} appears twice (also in line {seen[word]}); keep one. Nothing was started."
            )
        seen[word] = _line(key)
        origins[(*path, word)] = f"{name}:{_line(key)}"
        _walk(child, (*path, word), name, origins)


def override(
    tree: Tree,
    overrides: Iterable[str],
    environment: Mapping[str, str],
    is_text: Callable[[Sequence[str]], bool] = lambda keys: False,
) -> Tree:
    """The tree with BEAMLINE_SECTION__KEY variables and then `section.key=value` overrides put over it.

    Values are YAML; those of text keys are the text as it stands, where it is not quoted as YAML. A variable without a
    double underscore is ignored.

    Args:
        is_text: whether the key of this path takes text.

    Raises:
        ConfigError: an override without `=`, or with a value that is not YAML.
    """
    changes: list[tuple[list[str], str, str]] = []
    for name, value in sorted(environment.items()):
        if name.startswith(ENVIRONMENT_PREFIX) and "__" in name:
            changes.append((name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"), value, name))
    for word in overrides:
        key, equals, value = word.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {word}: expected section.key=value, such as --set scan.period_s=0.2")
        changes.append((key.strip().split("."), value, f"--set {word}"))
    data, origins = deepcopy(tree.data), dict(tree.origins)
    for keys, text, origin in changes:
        _put(data, keys, _value(keys, text, origin, is_text))
        path = tuple(keys)
        origins = {known: where for known, where in origins.items() if known[: len(path)] != path} | {path: origin}
    return Tree(data, origins)


def _value(keys: list[str], text: str, origin: str, is_text: Callable[[Sequence[str]], bool]) -> Any:
    try:
        value = _parsed(text, origin)[0]
    except ConfigError:
        if text.lstrip()[:1] in ("'", '"') or not is_text(keys):
            raise
        return text.strip()
    quoted = isinstance(value, str) and text.strip()[:1] in ("'", '"') and text.strip()[-1:] == text.strip()[:1]
    if quoted or value == text.strip() or text.strip() in _NOTHING or not is_text(keys):
        return value
    return text.strip()  # with what YAML takes for a comment, a folded line, a number or a group


def _put(data: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        if not isinstance(data.get(key), dict):
            data[key] = {}
        data = data[key]
    data[keys[-1]] = value
