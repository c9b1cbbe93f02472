"""Policies of others: ZIP archives and repositories of the Hugging Face Hub."""

from __future__ import annotations

import atexit
import shutil
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from mjlab.utils import hub
from mjlab.utils.errors import UserError
from mjlab.utils.os import checkpoint_number, inside

# Start of the names of folders for unpacked archives.
_UNPACKED = "mjlab_policy_"


def local_policy(source: Path | str) -> Path:
    """Return the file or folder of a policy on this machine.

    Args:
        source: `hf:NAME/REPO` or `hf:NAME/REPO@REVISION`, downloaded to the cache of the Hub's client;
            a ZIP archive, unpacked until the process ends; or a path, returned as it is.

    Raises:
        UserError: the archive is damaged, hostile or holds no policy; or see `hub.download`.
        HubError: the download failed.
    """
    text = source.as_posix() if isinstance(source, Path) else source
    if text.startswith(hub.PREFIX):
        return Path(hub.download(text))
    path = Path(source)
    is_archive = path.suffix.lower() == ".zip" and path.is_file()
    return _unpacked(path) if is_archive else path


def is_fetched(path: Path) -> bool:
    """Return True for a path that `local_policy` unpacked or downloaded, so that nothing is kept there."""
    # The second is the name of a repository in the cache of the client.
    return any(part.startswith((_UNPACKED, "models--")) for part in path.parts)


def _unpacked(path: Path) -> Path:
    target = Path(tempfile.mkdtemp(prefix=_UNPACKED))
    atexit.register(shutil.rmtree, target, ignore_errors=True)
    try:
        with zipfile.ZipFile(path) as archive:
            _extract(archive, target)
            return target / _folder_of_policy(archive, path)
    # `zipfile` raises RuntimeError for archives with a password.
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise UserError(
            f"{path}: expected a ZIP archive, got one that is damaged or encrypted: {error}."
        ) from error


def _extract(archive: zipfile.ZipFile, target: Path) -> None:
    """Extract `archive` into `target`.

    Raises:
        UserError: a name leads out of `target`, or the files are larger than the free space.
    """
    for name in archive.namelist():
        inside(target, name.removesuffix("/"))
    size = sum(entry.file_size for entry in archive.infolist())
    if size > (free := shutil.disk_usage(target).free):
        raise UserError(
            f"{archive.filename}: expected at most {free:,} bytes, the free space of {target.parent}, "
            f"got {size:,}."
        )
    # Links are written as files with the path that they lead to.
    archive.extractall(target)


def _folder_of_policy(archive: zipfile.ZipFile, path: Path) -> PurePosixPath:
    """Return the folder of the only policy in `archive`, or of the one nearest to its root."""
    policies = [PurePosixPath(name) for name in archive.namelist() if _is_policy(name)]
    depths = [len(policy.parts) for policy in policies]
    nearest = {policy.parent for policy in policies if len(policy.parts) == min(depths)}
    if len(nearest) != 1:
        found = ", ".join(sorted(map(str, nearest))) or "none"
        raise UserError(f"{path}: expected one folder with model_<n>.pt or .onnx, got {found}.")
    return nearest.pop()


def _is_policy(name: str) -> bool:
    path = PurePosixPath(name)
    return path.suffix == ".onnx" or checkpoint_number(path.name) is not None
