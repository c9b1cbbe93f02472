"""Fetch a build of torch into `wheels/`, where `uv run` finds it: `make train TORCH=cpu`.

The build comes from the folders and indexes that uv is told to look in (`UV_FIND_LINKS`, `UV_INDEX`,
`uv.toml`) or, if none of them has it, from the index of uv's `--torch-backend`.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
import tomllib
import urllib.parse
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WHEELS = ROOT / "wheels"
# `uv run` sets the variable.
UV = os.environ.get("UV", "uv")
# Of wheels for this Python and machine.
TAGS = ("-cp{}{}-".format(*sys.version_info), platform.machine())


def main(build: str) -> None:
    """Fetch torch's `build`, such as `cpu`, unless it is there, and resolve the project with it."""
    if sys.platform != "linux":
        print(f"TORCH={build}: ignored; torch has no CUDA by default on this platform.")
        return
    version = pinned_version()
    if any(is_for_this_python(path.name) for path in WHEELS.glob(f"torch-{version}+{build}-*.whl")):
        return
    found = find(f"torch=={version}+{build}", "-qq")
    found = found or find(f"torch=={version}", "-q", "--torch-backend", build)
    if found is None:
        sys.exit(
            f"TORCH={build}: expected torch {version} for this build, Python and machine, found none; "
            "set UV_FIND_LINKS to a folder with its wheel, or UV_INDEX to an index."
        )
    fetch(*found)
    # The lock file keeps the build that it has.
    subprocess.run([UV, "lock", "-q", "--upgrade-package", "torch"], cwd=ROOT, check=True)


def pinned_version() -> str:
    """Return the version of torch that the project is resolved with."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    constraints = project["tool"]["uv"]["constraint-dependencies"]
    return next(text.removeprefix("torch==") for text in constraints if text.startswith("torch=="))


def find(requirement: str, *flags: str) -> tuple[str, str] | None:
    """Return URL and SHA-256 of the wheel that uv resolves `requirement` to, None if it finds none."""
    command = [UV, "pip", "compile", "--no-deps", "--no-header", "--format", "pylock.toml"]
    command += ["--python", sys.executable, *flags, "-"]
    # Not the project's own folder of wheels, which may have an older build.
    done = subprocess.run(
        command, cwd=ROOT.parent, input=requirement, stdout=subprocess.PIPE, text=True, check=False
    )
    wheels = [
        wheel
        for package in tomllib.loads(done.stdout).get("packages", ())
        for wheel in package.get("wheels", ())
        if is_for_this_python(name_of(wheel["url"]))
    ]
    return (wheels[0]["url"], wheels[0]["hashes"]["sha256"]) if wheels else None


def is_for_this_python(name: str) -> bool:
    """Return True if a wheel has the tags of this Python and machine."""
    return all(tag in name for tag in TAGS)


def name_of(url: str) -> str:
    """Return the file name in a URL."""
    return urllib.parse.unquote(url.rpartition("/")[2])


def fetch(url: str, sha256: str) -> None:
    """Write the wheel at `url` to the folder, in place of others of torch."""
    print(f"Fetching {url}", flush=True)
    with urllib.request.urlopen(url) as response:
        content = response.read()
    if (received := hashlib.sha256(content).hexdigest()) != sha256:
        sys.exit(f"{url}: expected SHA-256 {sha256}, got {received}.")
    for old in WHEELS.glob("torch-*.whl"):
        old.unlink()
    part = WHEELS / "torch.part"
    part.write_bytes(content)
    part.rename(WHEELS / name_of(url))


if __name__ == "__main__":
    main(sys.argv[1])
