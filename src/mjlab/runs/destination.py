"""Destinations of published policies: a folder, or a repository of the Hugging Face Hub."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Protocol

from mjlab.runs.publication import MANIFEST_FILE, files_of
from mjlab.utils import hub
from mjlab.utils.errors import UserError
from mjlab.utils.os import files_in, inside


class Destination(Protocol):
    """Place of a published policy."""

    name: str
    """Name, as `play` takes it on this machine."""
    public_name: str
    """Name on the card: of folders, the last part."""
    parent: Path
    """Folder for the files while they are written."""

    def present(self) -> set[str]:
        """Return the files that are there, without hidden ones."""

    def published(self) -> set[str]:
        """Return the files of the policy that was published there before."""

    def write(self, folder: Path, superseded: set[str]) -> None:
        """Move or upload the files in `folder`, and remove the `superseded` ones."""


def destination(text: str, private: bool) -> Destination:
    """Return the destination that `text` names: a folder, hf:NAME/REPO or hf:NAME/REPO@BRANCH.

    Raises:
        UserError: not a folder, malformed name, no login, or the Hub's client is not installed.
    """
    if text.startswith(hub.PREFIX):
        return HubDestination(text, private)
    return FolderDestination(Path(text))


class FolderDestination:
    """Folder of this machine."""

    def __init__(self, folder: Path) -> None:
        if folder.exists() and not folder.is_dir():
            raise UserError(f"--to: expected a folder or hf:NAME/REPO, got the file {folder}.")
        self.name = str(folder)
        self.public_name = folder.resolve().name
        self.parent = folder.resolve().parent
        self._folder = folder

    def present(self) -> set[str]:
        return names_in(self._folder)

    def published(self) -> set[str]:
        return files_of(self._folder / MANIFEST_FILE)

    def write(self, folder: Path, superseded: set[str]) -> None:
        for name in superseded:
            inside(self._folder, name).unlink(missing_ok=True)
        for name in names_in(folder):
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            (folder / name).replace(path)


class HubDestination:
    """Repository of the Hugging Face Hub; created if it does not exist."""

    def __init__(self, text: str, private: bool) -> None:
        self.name = self.public_name = text
        self.parent = Path(tempfile.gettempdir())
        self._repository, self._branch = hub.repository(text)
        self._private = private
        with hub.asking_hub(text) as module:
            if module.get_token() is None:
                raise UserError(
                    f"{text}: expected a login at the Hugging Face Hub, found none; run `hf auth login`, "
                    "or set HF_TOKEN."
                )

    def present(self) -> set[str]:
        with hub.asking_hub(self.name) as module:
            from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError

            try:
                files = module.list_repo_files(self._repository, revision=self._branch)
            except (RepositoryNotFoundError, RevisionNotFoundError):
                return set()
        return {name for name in files if not _is_hidden(name)}

    def published(self) -> set[str]:
        with hub.asking_hub(self.name) as module:
            path = module.hf_hub_download(self._repository, MANIFEST_FILE, revision=self._branch)
        return files_of(Path(path))

    def write(self, folder: Path, superseded: set[str]) -> None:
        with hub.asking_hub(self.name) as module:
            api = module.HfApi()
            api.create_repo(self._repository, private=self._private or None, exist_ok=True)
            if self._branch is not None:
                api.create_branch(self._repository, branch=self._branch, exist_ok=True)
            api.upload_folder(
                repo_id=self._repository,
                folder_path=folder,
                revision=self._branch,
                commit_message="Publish a policy with mjlab",
                delete_patterns=sorted(superseded) or None,
            )


def names_in(folder: Path) -> set[str]:
    """Return the files in `folder` and below, without hidden ones, with `/` in their names."""
    names = {path.relative_to(folder).as_posix() for path in files_in(folder, "**/*")}
    return {name for name in names if not _is_hidden(name)}


def _is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in name.split("/"))
