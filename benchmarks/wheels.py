"""A folder of wheels for a machine without a network, in parts that fit through small doors.

    python benchmarks/wheels.py DIR --python 3.12 --jax 0.10.2     # with a network: fetch
    python benchmarks/wheels.py DIR --install                      # without one: install

The machine is a Linux x86-64 with jax for CUDA, flax, optax and chex already there, as NVIDIA's and
Google's images have them. The script fetches what else training needs, without orbax,
imageio-ffmpeg, tensorboardX, gymnasium and matplotlib, which `gpu.py` does without. Pip resolves
them and checks their digests. Wheels of more than 40 MiB are cut into parts.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import pathlib
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable
from typing import Any

# The machine may have no `packaging`; pip, without which nothing is installed, brings its own.
from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.specifiers import SpecifierSet

# What training and `gpu.py` import beyond the image.
NEEDED = (
    "mujoco>=3.17,<3.18",
    "mujoco-mjx>=3.17,<3.18",
    "pydantic>=2.12",
    "safetensors>=0.6",
    "filelock>=3.20",
    "tyro>=1.0",
    "rich>=14.0",
)
WARP = "warp-lang==1.18.0"
# What the image has, and what nothing here imports.
LEFT_OUT = frozenset(
    {
        *("chex", "flax", "jax", "jaxlib", "ml-dtypes", "numpy", "opt-einsum", "optax", "scipy"),
        *("gymnasium", "imageio", "imageio-ffmpeg", "matplotlib", "orbax-checkpoint"),
        *("tensorboardx",),
    }
)
# What the image has and training imports; `install` compares the versions.
OF_IMAGE = ("jax", "flax", "optax", "chex")
PYPROJECT = pathlib.Path(__file__).parents[1] / "pyproject.toml"
PART = 40 * 2**20
LIST = "wheels.json"


def platform_options(python: str) -> list[str]:
    """Pip's options for another machine than this one.

    Args:
      python: its version, such as `3.12`.
    """
    tags = [f"manylinux_2_{minor}_x86_64" for minor in (28, 27, 17)] + ["manylinux2014_x86_64"]
    platforms = [option for tag in tags for option in ("--platform", tag)]
    return ["--only-binary", ":all:", "--python-version", python, *platforms]


def resolve(python: str, jax: str, needed: Iterable[str]) -> list[dict[str, Any]]:
    """What pip would install beside that version of jax: metadata alone, nothing is downloaded."""
    with tempfile.TemporaryDirectory() as empty:
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--report", "-"]
        command += ["--ignore-installed", "--target", empty, *platform_options(python)]
        # Else pip compares what jax requires with the Python that runs here.
        command += ["--ignore-requires-python"]
        done = subprocess.run(
            [*command, f"jax=={jax}", *needed], capture_output=True, text=True, check=False
        )
    if done.returncode != 0:
        raise ValueError(f"pip cannot resolve the wheels: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)["install"]


def to_fetch(resolved: list[dict[str, Any]], python: str) -> list[str]:
    """Names and versions of what the image lacks.

    Args:
      resolved: from `resolve`.
      python: version on the other machine, such as `3.12`.

    Raises:
      ValueError: one of them does not run on that version of Python.
    """
    wanted = []
    for found in (x["metadata"] for x in resolved):
        if found["name"].lower().replace("_", "-") in LEFT_OUT:
            continue
        name, needs = f"{found['name']}=={found['version']}", found.get("requires_python", "")
        if not SpecifierSet(needs).contains(python):
            raise ValueError(f"{name} requires Python {needs}, and --python is {python}")
        wanted.append(name)
    return sorted(wanted)


def split(wheel: pathlib.Path, size: int = PART) -> list[pathlib.Path]:
    """Cuts a file into parts of at most `size` bytes, and removes it; smaller ones stay whole."""
    if wheel.stat().st_size <= size:
        return [wheel]
    parts = []
    with wheel.open("rb") as whole:
        while content := whole.read(size):
            part = wheel.with_name(f"{wheel.name}.part-{len(parts):03d}")
            part.write_bytes(content)
            parts.append(part)
    wheel.unlink()
    return parts


def join(folder: pathlib.Path, into: pathlib.Path) -> list[pathlib.Path]:
    """Copies the wheels of a folder into another one, those in parts whole again."""
    for wheel in sorted(folder.glob("*.whl")):
        shutil.copy(wheel, into)
    for part in sorted(folder.glob("*.whl.part-*")):
        name, _, number = part.name.rpartition(".part-")
        with (into / name).open("wb" if int(number) == 0 else "ab") as whole:
            whole.write(part.read_bytes())
    return sorted(into.glob("*.whl"))


def fetch(folder: pathlib.Path, python: str, jax: str, *, warp: bool) -> dict[str, int]:
    """Downloads the wheels.

    Returns:
      Bytes of each file, which `wheels.json` lists too.

    Raises:
      ValueError: the folder is not empty, or pip fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise ValueError(f"{folder} is not empty: give a new or empty folder")
    wanted = to_fetch(resolve(python, jax, [*NEEDED, *([WARP] if warp else [])]), python)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    command += ["--dest", str(folder), *platform_options(python), *wanted]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ValueError(f"pip cannot fetch the wheels: {done.stderr.strip().splitlines()[-1]}")
    files = [part for wheel in sorted(folder.glob("*.whl")) for part in split(wheel)]
    sizes = {file.name: file.stat().st_size for file in files}
    about = {"python": python, "jax": jax, "warp": warp, "bytes": sizes}
    (folder / LIST).write_text(json.dumps(about, indent=1) + "\n")
    return sizes


def install(folder: pathlib.Path) -> int:
    """Installs the wheels of a folder with this Python; returns pip's exit status.

    Prints a warning for each package of the image whose version `pyproject.toml` does not allow.
    """
    with tempfile.TemporaryDirectory() as whole:
        wheels = join(folder, pathlib.Path(whole))
        if not wheels:
            print(f"error: {folder} holds no wheels: fetch them first", file=sys.stderr)
            return 2
        command = [sys.executable, "-m", "pip", "install", "--no-index", "--no-deps"]
        status = subprocess.run([*command, *map(str, wheels)], check=False).returncode
    for sentence in mismatches():
        print(f"warning: {sentence}", file=sys.stderr)
    return status


def mismatches(
    pyproject: pathlib.Path = PYPROJECT,
    installed: Callable[[str], str] = importlib.metadata.version,
) -> list[str]:
    """A sentence for each package of the image that `pyproject.toml` does not allow.

    Args:
      pyproject: the file.
      installed: the version of a package; raises `PackageNotFoundError` where it is missing.
    """
    listed = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]["dependencies"]
    found = []
    for requirement in map(Requirement, listed):
        if requirement.name not in OF_IMAGE:
            continue
        wanted = f"pyproject.toml asks for {requirement}"
        try:
            version = installed(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{requirement.name} is not installed, and {wanted}")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            found.append(f"{requirement.name} {version} is installed, and {wanted}")
    return found


def main() -> int:
    """Fetches or installs; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--python", default="3.12", help="version on the other machine")
    parser.add_argument("--jax", default="0.10.2", help="version on the other machine")
    parser.add_argument("--warp", action="store_true", help="with warp-lang, for mjx-warp")
    parser.add_argument("--install", action="store_true", help="install what was fetched")
    options = parser.parse_args()
    if options.install:
        return install(options.folder)
    try:
        sizes = fetch(options.folder, options.python, options.jax, warp=options.warp)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name, size in sizes.items():
        print(f"{size / 2**20:8.2f} MiB  {name}")
    print(f"{sum(sizes.values()) / 2**20:8.2f} MiB in {len(sizes)} files")
    return 0


if __name__ == "__main__":
    sys.exit(main())
