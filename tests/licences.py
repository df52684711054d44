"""Writes docs/licences.md: the licences of all installed packages, from their metadata.

python -m tests.licences        # in an environment with all extras

"""

import fnmatch
import re
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "licences.md"

ADD_ONS = ("areadetector", "cluster", "emission", "models", "neural", "spectral", "structure", "tango")
FOR_USERS = ("gpu", "epics", "bluesky", "nifti", "txrm", "zarr", *ADD_ONS)

# The metadata of these packages name no licence or only a family; these are from their licence files.
READ = {
    "bluesky": "BSD-3-Clause",
    "hdf5plugin": "MIT",  # its plug-ins: BSD, MIT, Apache-2.0, Zlib and that of bzip2
    "historydict": "BSD-3-Clause",
    "mongoquery": "Unlicense",
    "pyusb": "BSD-3-Clause",
}

# Installed on other systems, or with other builds, than those with which the page is written.
ELSEWHERE = {
    "colorama": ("BSD-3-Clause", "Windows: click"),
    "nvidia-*": ("NVIDIA's own", "CUDA builds of torch; never needed"),
    "cuda-*": ("NVIDIA's own", "CUDA builds of torch; never needed"),
}

_CLASSES = {
    "BSD License": "BSD",
    "MIT License": "MIT",
    "MIT No Attribution License (MIT-0)": "MIT-0",
    "Apache Software License": "Apache-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "ISC License (ISCL)": "ISC",
    "The Unlicense (Unlicense)": "Unlicense",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
}


def key(name: str) -> str:
    """The normalised name of a distribution, as the index compares names."""
    return str(canonicalize_name(name))


def licence(package: Distribution) -> str:
    """The licence as an SPDX expression if the metadata give one; "" if they give nothing short enough to be a name.

    Each field is looked for first: where the package importlib_metadata is installed, a missing one raises KeyError.
    """
    said = package.metadata
    if key(said["Name"]) in READ:
        return READ[key(said["Name"])]
    if expression := "License-Expression" in said and said["License-Expression"]:
        return str(expression)
    classes = [line.split(" :: ")[-1] for line in said.get_all("Classifier") or () if line.startswith("License :: ")]
    if named := [_CLASSES.get(name, name) for name in classes if name != "OSI Approved"]:
        return " AND ".join(named)
    text = str(("License" in said and said["License"]) or "").strip()
    return text if len(text) < 60 and "\n" not in text else ""


def wanted(extra: str | None) -> list[Requirement]:
    """The requirements of an extra in pyproject.toml; None: of every installation."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] if extra is None else project["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def brought(requirements: Iterable[Requirement]) -> dict[str, Distribution]:
    """The distributions that requirements bring in this environment, with their own requirements, by name.

    Distributions that are not installed are left out.
    """
    got: dict[str, Distribution] = {}
    to_do, done = list(requirements), set[tuple[str, frozenset[str]]]()
    while to_do:
        requirement = to_do.pop()
        name = key(requirement.name)
        if name == "splatline" or (name, frozenset(requirement.extras)) in done:
            continue
        done.add((name, frozenset(requirement.extras)))
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        got[name] = package
        to_do += _required(package, requirement.extras)
    return got


def _required(package: Distribution, extras: set[str]) -> Iterator[Requirement]:
    for line in package.requires or ():
        requirement = Requirement(line)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in ("", *extras)):
            yield requirement


def gpl(words: str) -> bool:
    """Whether a licence is GPL or AGPL (not LGPL), without an exception and without an alternative."""
    return (
        re.search(r"(?<!L)GPL|(?<!Lesser )General Public", words) is not None
        and " WITH " not in words
        and " OR " not in words
    )


def rows() -> dict[str, str]:
    """The licence of each package that the page names, by name."""
    lines = re.findall(r"(?m)^\| ([^|]+?) \| ([^|]+?) \|", PAGE.read_text(encoding="utf-8"))
    return {name: words for name, words in lines if name not in ("package", "---")}


def row_of(name: str, named: Iterable[str]) -> str | None:
    """The name of the row for a package (it may end in a star); None: there is no row."""
    return next((row for row in named if fnmatch.fnmatch(name, row)), None)


def page() -> str:
    """The page as Markdown."""
    users = {extra: brought(wanted(extra)) for extra in FOR_USERS}
    base = brought(wanted(None))
    parts = [
        "# Licences",
        "This page lists the licence of each package that is installed together with splatline.",
        "splatline itself is under BSD-3-Clause. Its wheel contains one file of another project, uPlot 1.6.32 (MIT),\n"
        "together with its licence. [Dependencies](decisions/dependencies.md) says what splatline needs each\n"
        "package for.",
        "Some libraries have other licences than these packages. The wheels of numpy and scipy contain libgfortran,\n"
        "and those of torch contain libgomp. Both libraries are under the GPL, with an exception that allows any\n"
        "program to use them. pyusb loads libusb from the system (LGPL). The driver for DCAM cameras loads the\n"
        "library of the vendor. The wheels of splatline contain neither libusb nor the library of the vendor.",
        "`python -m tests.licences` writes this page from the metadata of the installed packages, including the\n"
        "packages that they require. A test fails if an installed package has no row, or if a package that users\n"
        "install is under the GPL. Packages for tests and docs are not listed, because no user needs them.",
        "## Every installation",
        _table(dict.fromkeys(base, ""), base),
        "## Extras for users",
        _section(users, set(base)),
        "## On other systems, and with other builds of torch",
        _lines((name, words, why) for name, (words, why) in ELSEWHERE.items()),
    ]
    return "\n\n".join(parts) + "\n"


def _section(extras: dict[str, dict[str, Distribution]], before: set[str]) -> str:
    """The additional packages that extras bring, with the names of these extras."""
    packages = {name: package for each in extras.values() for name, package in each.items() if name not in before}
    by = {name: ", ".join(f"`{extra}`" for extra, each in extras.items() if name in each) for name in packages}
    return _table(by, packages)


def _table(why: dict[str, str], packages: dict[str, Distribution]) -> str:
    return _lines((name, licence(packages[name]), why[name]) for name in sorted(packages))


def _lines(cells: Iterable[tuple[str, str, str]]) -> str:
    lines = list(cells)
    last = any(why for *_, why in lines)
    head = "| package | licence | brought by |\n|---|---|---|" if last else "| package | licence |\n|---|---|"
    return "\n".join([head, *("| " + " | ".join(line if last else line[:2]) + " |" for line in lines)])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8", newline="\n")
