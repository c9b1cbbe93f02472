"""Hugging Face Hub: names of repositories, requests and their errors."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Generator
from typing import Any, NamedTuple

from mjlab.utils.errors import MjlabError, UserError

PREFIX = "hf:"
"""Start of the name of a repository, as in `hf:NAME/REPO`."""
_NAME = re.compile(rf"{PREFIX}([\w.-]+/[\w.-]+)(?:@(.+))?")
# Characters of an error of the client in a message.
_LONGEST = 400


class HubError(MjlabError, ConnectionError):
    """Error that the client of the Hub raised."""


class Repository(NamedTuple):
    """Repository of the Hub, and one of its revisions."""

    name: str
    """NAME/REPO."""
    revision: str | None
    """Branch, tag or commit. None: default branch."""


def repository(text: str) -> Repository:
    """Return the repository that `text` names.

    Raises:
        UserError: `text` is neither hf:NAME/REPO nor hf:NAME/REPO@REVISION.
    """
    found = _NAME.fullmatch(text)
    if found is None:
        raise UserError(
            f"Repository: expected hf:NAME/REPO or hf:NAME/REPO@REVISION, got {text!r}."
        )
    return Repository(found[1], found[2])


@contextlib.contextmanager
def asking_hub(request: str) -> Generator[Any]:
    """Yield the module `huggingface_hub` for a request, such as "hf:NAME/REPO", and name it in errors.

    Raises:
        UserError: the module is not installed.
        HubError: the client raised an error, also within the block.
    """
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise UserError(
            f"{request}: package huggingface_hub not found; install mjlab[hub] (in the checkout: "
            "`uv sync --extra hub`)."
        ) from error
    try:
        yield huggingface_hub
    except MjlabError:
        raise
    except Exception as error:
        # Errors of the disk are not those of the Hub. Errors of requests name no file.
        if isinstance(error, OSError) and error.filename:
            raise
        # The client raises many types, including those of its HTTP library.
        reason = " ".join(str(error).split())[:_LONGEST].rstrip(".") or type(error).__name__
        raise HubError(
            f"{request}: the Hugging Face Hub failed: {reason}; check the name, the network and the "
            "login (`hf auth login`, or HF_TOKEN)."
        ) from error


def download(text: str) -> str:
    """Return the folder of a repository in the cache of the client; what is there is not downloaded again.

    Raises:
        UserError, HubError: see `repository` and `asking_hub`.
    """
    name, revision = repository(text)
    with asking_hub(text) as hub:
        # Clips and pictures are for readers of the card.
        media = ["*.mp4", "*.gif", "*.webp", "*.png", "*.jpg"]
        return hub.snapshot_download(name, revision=revision, ignore_patterns=media)
