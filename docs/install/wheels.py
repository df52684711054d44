"""Fill a folder with every wheel that splatline needs, to install it on a computer without a network.

Run it in the folder of the sources, on a Linux computer that has a network and a Python with pip:

    python3 docs/install/wheels.py FOLDER                              # for computers like this one
    python3 docs/install/wheels.py FOLDER --python 3.13 --machine aarch64 --extra structure --extra txrm

On the other computer: pip install --no-index --find-links FOLDER --require-hashes -r FOLDER/requirements.txt
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from email import message_from_bytes
from pathlib import Path

from pip._vendor.packaging.markers import default_environment
from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PYTORCH = "https://download.pytorch.org/whl/"  # has an index for each build of torch: cpu, cu130
REQUIREMENTS, CHECKSUMS = "requirements.txt", "SHA256SUMS"
OF_CUDA = ("nvidia-", "cuda-")
ROUNDS = 5  # of downloads, until no wheel needs one that is missing


@dataclass(frozen=True)
class Wheel:
    """A wheel in the folder, with what its metadata say."""

    path: Path
    name: str
    version: str
    needs: tuple[Requirement, ...]

    @property
    def digest(self) -> str:
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


def wheel_of(path: Path) -> Wheel:
    with zipfile.ZipFile(path) as packed:
        name = next(each for each in packed.namelist() if each.endswith(".dist-info/METADATA"))
        stated = message_from_bytes(packed.read(name))
    needs = tuple(Requirement(each) for each in stated.get_all("Requires-Dist", []))
    return Wheel(path, canonicalize_name(stated["Name"]), stated["Version"], needs)


def environment_of(python: str, machine: str) -> dict[str, str]:
    """The values of environment markers on a Linux computer with this Python and processor."""
    return {
        **{name: str(value) for name, value in default_environment().items()},
        **{"python_version": python, "python_full_version": f"{python}.0", "platform_machine": machine},
        **{"sys_platform": "linux", "platform_system": "Linux", "os_name": "posix"},
    }


def platforms(machine: str, glibc: str) -> list[str]:
    """The tags of Linux wheels that run with this version of glibc, or a later one."""
    major, minor = map(int, glibc.split("."))
    old = {17: "manylinux2014", 12: "manylinux2010", 5: "manylinux1"}
    tags = [f"manylinux_{major}_{n}" for n in range(minor, 4, -1)]
    return [f"{tag}_{machine}" for tag in [*tags, *(name for n, name in old.items() if n <= minor)]] + [
        f"linux_{machine}"
    ]


def closure(
    wheels: Sequence[Wheel], wanted: Sequence[Requirement], environment: dict[str, str]
) -> tuple[dict[str, Wheel], list[str]]:
    """The wheels that `wanted` needs in this environment, and what it needs that is not among them.

    pip evaluates environment markers for the Python that runs it, which may be another one.
    """
    there = {wheel.name: wheel for wheel in wheels}
    reached, missing, seen = dict[str, Wheel](), list[str](), set[tuple[str, str]]()
    queue = list(wanted)
    while queue:
        need = queue.pop()
        wheel = there.get(canonicalize_name(need.name))
        if wheel is None or not need.specifier.contains(wheel.version, prereleases=True):
            missing.append(f"{need.name}{need.specifier}")
            continue
        reached[wheel.name] = wheel
        for extra in {"", *need.extras} - {known for name, known in seen if name == wheel.name}:
            seen.add((wheel.name, extra))
            values = environment | {"extra": extra}
            queue += [each for each in wheel.needs if each.marker is None or each.marker.evaluate(values)]
    return reached, sorted(set(missing))


def pip(*words: str) -> None:
    done = subprocess.run([sys.executable, "-m", "pip", *words], check=False)
    if done.returncode:
        sys.exit(f"Read pip's message above and run this again with an empty folder: pip {words[0]} failed.")


def local_packages(extras: Sequence[str]) -> list[Path]:
    """The folders of splatline and of the add-ons that these extras name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    known = project["optional-dependencies"]
    if unknown := sorted(set(extras) - set(known)):
        sys.exit(f"Choose --extra from {', '.join(known)}: {', '.join(unknown)} is not an extra. Nothing was written.")
    add_ons = [ROOT / "packages" / each for extra in extras for each in known[extra] if each.startswith("splatline-")]
    return [ROOT, *add_ons]


def fill(folder: Path, python: str, machine: str, glibc: str, extras: Sequence[str], torch_index: str) -> list[Wheel]:
    """Download all wheels into the folder, and write its checksums and its list of exact versions."""
    if folder.exists() and any(folder.iterdir()):
        sys.exit(f"Name a new or an empty folder: {folder} has files. Nothing was written.")
    sources = local_packages(extras)
    pip("wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), *map(str, sources))
    ours = [wheel_of(path) for path in sorted(folder.glob("*.whl"))]
    wanted = [
        Requirement(f"{each.name}[{','.join(extras)}]" if each.name == "splatline" else each.name) for each in ours
    ]
    for_target = [word for tag in platforms(machine, glibc) for word in ("--platform", tag)]
    download = [
        "download", "--dest", str(folder), "--find-links", str(folder), "--only-binary", ":all:",
        "--implementation", "cp", "--python-version", python, *for_target,
        "--constraint", str(ROOT / "constraints.txt"),
    ]  # fmt: skip
    # torch first, from its own index alone: its build decides whether gigabytes of CUDA follow.
    pip(*download, "--no-deps", "--index-url", torch_index, "torch")
    built = wheel_of(next(folder.glob("torch-*.whl")))
    if torch_index == PYTORCH + "cpu" and (
        cuda := [each.name for each in built.needs if each.name.startswith(OF_CUDA)]
    ):
        sys.exit(
            f"Remove the other places for wheels from pip's configuration: pip found {built.path.name}, which needs "
            f"{len(cuda)} packages of CUDA ({cuda[0]}, ...). Expected the build for processors. If you want CUDA, give "
            f"--torch-index {PYTORCH}cu130. The folder is not complete."
        )
    pins = [f"{built.name}=={built.version}"]
    first = [str(each.path) + (f"[{','.join(extras)}]" if extras and each.name == "splatline" else "") for each in ours]
    pip(*download, *pins, *first)
    environment = environment_of(python, machine)
    for _ in range(ROUNDS):
        reached, missing = closure([wheel_of(path) for path in folder.glob("*.whl")], wanted, environment)
        if not missing:
            break
        pip(*download, *pins, *missing)
    else:
        sys.exit(f"Tell the developers: pip did not bring {', '.join(missing)}. The folder is not complete.")
    wheels = [reached[name] for name in sorted(reached)]
    lines = [f"{each.name}=={each.version} --hash=sha256:{each.digest}\n" for each in wheels]
    (folder / REQUIREMENTS).write_text("".join(lines), encoding="utf-8")
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(folder.iterdir())]
    (folder / CHECKSUMS).write_text("".join(sums), encoding="utf-8")
    return wheels


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new or an empty folder")
    here = ".".join(platform.python_version_tuple()[:2])
    parser.add_argument(
        "--python", default=here, help="Python of the other computer. Default: of this one, %(default)s."
    )
    parser.add_argument("--machine", default=platform.machine(), help="its processor. Default: %(default)s.")
    parser.add_argument(
        "--glibc", default="2.28", help="its glibc (ldd --version), or an older one. Default: %(default)s."
    )
    parser.add_argument("--extra", action="append", default=[], help="an extra of docs/releases.md; may be repeated.")
    parser.add_argument(
        "--torch-index", default=PYTORCH + "cpu",
        help=f"where torch is downloaded from: its build for processors, for CUDA ({PYTORCH}cu130), or your mirror. "
        "Default: %(default)s.",
    )  # fmt: skip
    given = parser.parse_args(words)
    wheels = fill(given.folder, given.python, given.machine, given.glibc, given.extra, given.torch_index)
    size = sum(each.path.stat().st_size for each in wheels)
    print(
        f"{len(wheels)} wheels, {size / 1e6:.0f} MB, for Python {given.python} on Linux, {given.machine}. Copy "
        f"{given.folder} to the other computer. There, in a virtual environment:\n"
        f"  sha256sum --check --quiet {CHECKSUMS}     (in the folder)\n"
        f"  pip install --no-index --find-links FOLDER --require-hashes -r FOLDER/{REQUIREMENTS}"
    )


if __name__ == "__main__":
    main()
