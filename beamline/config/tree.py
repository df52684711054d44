"""Configuration text: merges YAML, --set and BEAMLINE_* variables into one tree, records the origin of each value, and
reports faults.

A fault is a finding of pydantic, with file and line, the key, its value and the legal values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import yaml
from pydantic import ValidationError

from beamline.core.errors import ConfigError
from recon.base.findings import KeyPath, Schema, faults_of

ENVIRONMENT_PREFIX = "BEAMLINE_"
_NOTHING = ("", "null", "~")
YAML_FAULTS = (ValueError, ArithmeticError, LookupError, TypeError, AttributeError)
"""Errors that PyYAML raises in addition to its YAMLError, for example for a 13th month, a number of 5000 digits, or
`!!bool x`."""

_LONGEST, _MOST, _DEEPEST, _DIGITS = 2**18, 20_000, 64, 500
"""Limits for a YAML text: number of characters, of values (counted as often as aliases repeat them), of nested groups,
and of digits of a number."""
_TOO_MUCH = (
    f"the settings are too large: at most {_LONGEST} characters, {_MOST} values, {_DEEPEST} groups inside each other "
    f"and {_DIGITS} digits in a number are allowed. Nothing was started."
)
_QUOTED = re.compile(r"""(?m)"(?:\\.|[^"\\])*"|'[^']*'|(?:^|(?<=\s))#.*$""")  # and the same for remarks
# one bracket after the other; PyYAML needs a second for a thousand of them
_BRACKETS = re.compile(rf"(?:[\[{{]\s*){{{_DEEPEST}}}")
_TAGGED = "text that begins with ! or = needs quotes"
_NO_SPACE = re.compile(r"[\s-]*[\w.]+:[^\s:/\\]")


RENAMED: Mapping[KeyPath, str] = {
    ("scan", "wide_views"): "offset_views",
    ("scan", "wish"): "target",
    ("scan", "without_watchdog"): "on_watchdog_loss",
}
"""Names of keys in the last version, which are still accepted, and their present names."""


class _Loader(yaml.SafeLoader):
    """Loader for plain values. A date is read as text, because it may be the name of a sample."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in forms if not tag.endswith(":timestamp")]
    for first, forms in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


class _FastLoader(getattr(yaml, "CSafeLoader", _Loader)):  # type: ignore[misc]
    """The same loader from libyaml, which is twenty times as fast. It accepts some text that `_Loader` does not (tabs),
    and its messages about faults are less detailed. Text with tabs or faults is therefore read with `_Loader`.
    """

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


@dataclass(frozen=True)
class Tree:
    """Plain values, and for each key path its origin ("my.yaml:12", "--set scan.period_s=0.2", ...)."""

    data: dict[str, Any]
    origins: Mapping[KeyPath, str]

    def origin(self, path: KeyPath) -> str:
        """The origin of the value at `path`, or of the nearest enclosing group."""
        while path not in self.origins and path:
            path = path[:-1]
        return self.origins[path]


def read(text: str, name: str) -> Tree:
    """Parse YAML with safe types only.

    Raises:
        ConfigError: bad syntax, a key given twice, or a top level that is not a group of keys; with file and line.
    """
    known = _read(text, name)
    return Tree(deepcopy(known.data), known.origins)


# cached, because the rows of a table name the same configuration, and configurations name the same scene
@lru_cache(maxsize=4)
def _read(text: str, name: str) -> Tree:
    data, origins = _parsed(text, name)
    if data is None:
        raise ConfigError(
            f"{name}: the file is empty; `beamline config init` prints a complete example. Nothing was started."
        )
    if not isinstance(data, dict):
        raise ConfigError(
            f"{name}:1: the file has no `key: value` lines; `beamline config init` prints a complete example."
        )
    for old, new in RENAMED.items():
        group = data.get(old[0])
        if isinstance(group, dict) and old[1] in group and new not in group:
            group[new] = group.pop(old[1])
            now = old[0], new
            origins = {(*now, *path[2:]) if path[:2] == old else path: place for path, place in origins.items()}
    return Tree(data, origins)


def _present_name(path: KeyPath) -> KeyPath:
    """The path with the present name of its key."""
    return (path[0], RENAMED[path]) if path in RENAMED else path


def _parsed(text: str, name: str) -> tuple[Any, dict[KeyPath, str]]:
    """The values in a YAML text, and the place of each value."""
    origins: dict[KeyPath, str] = {}
    with yaml_faults(text, name) as loader:
        try:
            node = yaml.compose(text, loader)
        except yaml.YAMLError:
            node = yaml.compose(text, _Loader)
        if node is None:
            return None, origins
        _locate(node, (), name, origins)
        return yaml.SafeLoader("").construct_document(node), origins


@contextmanager
def yaml_faults(text: str, name: str) -> Iterator[type[Any]]:
    """A context for reading YAML, which gives the loader to use. It raises ConfigError for faults of the text, and also
    for text that would take longer than a second to read.
    """
    if len(text) > _LONGEST or _BRACKETS.search(text):
        raise ConfigError(f"{name}: {_TOO_MUCH}")
    try:
        yield _fitting_loader(text, name)
    except RecursionError:
        raise ConfigError(
            f"{name}: a list or a group contains itself through a YAML alias (*). Write the contents out instead of "
            "the alias. Nothing was started."
        ) from None
    except (yaml.YAMLError, *YAML_FAULTS) as error:
        line, what = _line_and_fault(error, text)
        place, fault = f"{name}:{line}" if line and "\n" in text else name, f"this is not YAML ({what})"
        raise ConfigError(f"{place}: {fault}. Nothing was started.", [(place, fault)]) from None


def _fitting_loader(text: str, name: str) -> type[Any]:
    """The fast loader, if the text has no fault. Otherwise raises the error of `yaml_faults`."""
    if "\t" not in text:
        with suppress(yaml.YAMLError, *YAML_FAULTS):
            return _refuse_too_much(text, name, _FastLoader)
    return _refuse_too_much(text, name, _Loader)


def _refuse_too_much(text: str, name: str, loader: type[Any]) -> type[Any]:
    depth = 0
    for n, event in enumerate(yaml.parse(text, loader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if n > _MOST or depth > _DEEPEST:
            raise ConfigError(f"{name}:{event.start_mark.line + 1 if event.start_mark else 1}: {_TOO_MUCH}")
    return loader


def _line_and_fault(error: Exception, text: str) -> tuple[int, str]:
    """The line of a fault in YAML (0: not known), and a description of the fault for somebody who does not know
    YAML."""
    mark, context = getattr(error, "problem_mark", None), getattr(error, "context_mark", None)
    problem = str(getattr(error, "problem", None) or " ".join(str(error).split()) or type(error).__name__)
    if isinstance(error, yaml.reader.ReaderError):
        position = error.position
        code = ord(text[position])
        return text.count("\n", 0, position) + 1, f"the character U+{code:04X} is not allowed in text; remove it"
    if mark is None:
        return 0, problem if isinstance(error, yaml.YAMLError) else _TAGGED
    lines = [*text.split("\n"), ""]
    this, above = lines[mark.line], next((each for each in lines[: mark.line][::-1] if each.strip()), "")
    opened = text[context.index : context.index + 1] if context else ""
    bare = _QUOTED.sub("", text)
    is_open = opened in ("[", "{") and sum(map(bare.count, "[{")) > sum(map(bare.count, "]}"))
    is_quote = opened in ("'", '"') and "scalar" in str(getattr(error, "context", ""))
    quoted = [
        each
        for each in _QUOTED.finditer(text[: mark.index])
        if each[0][0] != "#" and not text[each.end() : mark.index].strip(" ")
    ]
    of_key = "mapping values" in problem or "expected ':'" in problem
    deeper = len(this) - len(this.lstrip()) > len(above) - len(above.lstrip())
    first_character = this[mark.column :][:1]
    faults = (
        (is_quote and "end of stream" in problem, f"the {opened} of this line is never closed"),
        (is_open, f"the {opened} of this line is never closed"),
        ("'\\t'" in problem and not this[: mark.column].strip(), "this line begins with a tab; indent it with spaces"),
        (quoted, "text follows after the closing quote; to write a quote inside quoted text, write the quote twice"),
        ("cannot start any token" in problem, f"a value begins with {first_character!r}; put it in quotes"),
        ("escape" in problem, "in double quotes, a backslash starts a special character; use single quotes"),
        (opened in ("*", "&") or "alias" in problem, "text that begins with * or & needs quotes"),
        (this[mark.column :][:1] in ("!", "=") or "tag" in problem, _TAGGED),
        ("unhashable" in problem, "a key of this line is a list or a group; keys must be text"),
        ("another document" in problem, "a second YAML document begins here; the settings must be a single document"),
        (of_key and _NO_SPACE.match(this), "a space is missing after the colon of this line"),
        (of_key and _NO_SPACE.match(above), "a space is missing after the colon of the line above"),
        (of_key and ": " in this[: mark.column], "a colon is missing, or a value that contains a colon needs quotes"),
        (
            of_key and deeper and ": " in above,
            "this line is indented deeper than the one above, which already has a value",
        ),
        (of_key, "a colon is missing after a key of this line or the one above"),
        (
            "<block end>" in problem,
            "the indentation of this line does not match the indentation of any group above this line",
        ),
    )
    position = context if (is_open or is_quote) and context else mark
    return position.line + 1, next((sentence for holds, sentence in faults if holds), problem)


def _locate(node: yaml.Node, path: KeyPath, name: str, origins: dict[KeyPath, str]) -> None:
    """Record the place of each value below a node."""
    place = f"{name}:{node.start_mark.line + 1}"
    origins.setdefault(path, place)
    if len(origins) > _MOST or (node.tag.endswith((":int", ":float")) and len(node.value) > _DIGITS):
        raise ConfigError(f"{place}: {_TOO_MUCH}")
    of_keys = isinstance(node, yaml.MappingNode)
    for index, item in enumerate([] if isinstance(node, yaml.ScalarNode) else node.value):
        key, child = item if of_keys else (item, item)
        keys, line = (*path, str(key.value) if of_keys else index), key.start_mark.line + 1
        if keys in origins:
            full, before = ".".join(map(str, keys)), origins[keys].rpartition(":")[2]
            fault = f"{full} appears twice (also in line {before}); remove one of the two lines"
            raise ConfigError(f"{name}:{line}: {fault}. Nothing was started.", [(f"{name}:{line}", fault)])
        origins[keys] = f"{name}:{line}"
        _locate(child, keys, name, origins)


Override = str | tuple[str, str]
"""The text `section.key=value`, and the place where it was given (if it was not given with --set)."""


def override(
    tree: Tree,
    overrides: Iterable[Override],
    environment: Mapping[str, str],
    is_text: Callable[[Sequence[str]], bool] = lambda keys: False,
) -> Tree:
    """The tree after it was overridden by BEAMLINE_SECTION__KEY variables, and then by `section.key=value`.

    A value is read as YAML. The value of a text key is used literally, unless it has the quotes of YAML. A variable
    without a double underscore is ignored.

    Args:
        is_text: True if the key of this path takes text.

    Raises:
        ConfigError: an override without `=`, or with a value that is not YAML.
    """
    changes: list[tuple[list[str], str, str]] = []
    for name, value in sorted(environment.items()):
        if name.startswith(ENVIRONMENT_PREFIX) and "__" in name:
            changes.append((name.removeprefix(ENVIRONMENT_PREFIX).lower().split("__"), value, name))
    for stated in overrides:
        word, place = (stated, f"--set {stated}") if isinstance(stated, str) else stated
        key, equals, value = word.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"{place}: expected section.key=value, such as --set scan.period_s=0.2")
        changes.append((key.strip().split("."), value, place))
    data, origins = deepcopy(tree.data), dict(tree.origins)
    for keys, text, origin in changes:
        keys = [*map(str, _present_name(tuple(keys[:2]))), *keys[2:]]
        plain = text.strip()[:1] not in ("'", '"') and text.strip() not in _NOTHING and is_text(keys)
        group, path = data, tuple(keys)
        for key in keys[:-1]:
            if not isinstance(group.get(key), dict):
                group[key] = {}
            group = group[key]
        group[keys[-1]] = text.strip() if plain else _parsed(text, origin)[0]
        origins = {known: place for known, place in origins.items() if known[: len(path)] != path} | {path: origin}
    return Tree(data, origins)


_OWN_VIEWS = (
    "This key is not needed: every reconstruction of at least 25 projections compares its projections with the volume"
)
REMOVED = {
    "monitor.model": _OWN_VIEWS,
    "monitor.policy.model": _OWN_VIEWS,
    "monitor.dark.light": "Use references.light_in_darks instead: darks count as exposed to the beam if their "
    "intensity is at least this fraction of the intensity of the flats",
    "recon.stop_when": "Use `scan.decide: do` with `scan.target: {quality_db: 0.5}` instead: the scan ends when all "
    "remaining projections together would improve the PSNR by at most 0.5 dB",
    "scan.return_views": "This key is not needed: the check `opposite` finds motion of the sample by comparing "
    "projections 180° apart",
}
"""Keys of 1.0.0 that were removed, each with a sentence on its replacement."""
_ADVICE = "A configuration for real devices runs unchanged with simulated devices: `beamline scan CONFIG --rehearse`"


def explain(error: ValidationError, tree: Tree, schema: Schema) -> list[tuple[str, str]]:
    """Place and message of each fault, in the order of the model's keys; one fault per key.

    Args:
        schema: the model's JSON schema, from which the legal keys and values are read.
    """
    own_faults = faults_of(error.errors(include_url=False), tree.data, schema, former=REMOVED, advice=_ADVICE)
    return [(tree.origin(fault.key), fault.sentence) for fault in own_faults]
