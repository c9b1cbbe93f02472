"""Weights & Biases: requests and their errors, login check, run tags."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Generator, Sequence
from typing import Any

from mjlab.utils.errors import MjlabError, UserError

_VARIABLE = "WANDB_TAGS"
# Characters of an error of wandb in a message.
_LONGEST = 400


class WandbError(MjlabError, ConnectionError):
    """Error that wandb raised, or lack of its package."""


@contextlib.contextmanager
def asking_wandb(request: str, *, records: bool = False) -> Generator[Any]:
    """Yield the module `wandb` for a request, such as "Run 'a/b/c'", and name it in errors.

    Args:
        request: Request, for messages.
        records: The request records a run, also possible offline.

    Raises:
        UserError: no login, where wandb would prompt for a key or fail later.
        WandbError: wandb is not installed, or raised an error, also within the block.
    """
    try:
        import wandb

        if not _has_login(wandb):
            otherwise = (
                "; WANDB_MODE=offline records without an account, and --agent.logger tensorboard does "
                "without Weights & Biases"
            )
            raise UserError(
                f"{request}: expected a login at Weights & Biases, found none; run `wandb login` or set "
                f"WANDB_API_KEY{otherwise if records else ''}."
            )
        yield wandb
    except MjlabError:
        raise
    except Exception as error:
        # Errors of the disk are not those of the service. Errors of connections name no file.
        if isinstance(error, OSError) and (error.filename or error.errno == errno.ENOSPC):
            raise
        # wandb raises many error types, including those of its dependencies.
        reason = " ".join(str(error).split())[:_LONGEST].rstrip(".") or type(error).__name__
        raise WandbError(
            f"{request}: Weights & Biases failed: {reason}; check the name, the network and the login "
            "(`wandb login`), or use files of this machine."
        ) from error


def check_wandb_login(purpose: str, *, records: bool = False) -> None:
    """Raise the errors of `asking_wandb` that need no request."""
    with asking_wandb(purpose, records=records):
        pass


def _has_login(wandb: Any) -> bool:
    if os.environ.get("WANDB_API_KEY"):
        return True
    # Tests of packages replace wandb by a few of its functions.
    if not hasattr(wandb, "setup") or wandb.setup().settings.mode != "online":
        return True
    try:
        # Credentials in ~/.netrc, in settings files or as identity token.
        return bool(wandb.login(prompt=False, verify=False))
    except TypeError:
        # Versions of wandb that always prompt.
        return True


def add_wandb_tags(tags: Sequence[str]) -> None:
    """Add tags to the active run, or else to the tags of the next run.

    Empty tags are omitted, because wandb rejects them.
    """
    # An active run implies that wandb is already imported; importing it here would only cost time.
    run = getattr(sys.modules.get("wandb"), "run", None)
    present = os.environ.get(_VARIABLE, "").split(",") if run is None else run.tags or ()
    merged = tuple(dict.fromkeys(tag for tag in (*present, *tags) if tag))
    if run is not None:
        run.tags = merged
    elif merged:
        os.environ[_VARIABLE] = ",".join(merged)
    else:
        # wandb reads an empty variable as one empty tag.
        os.environ.pop(_VARIABLE, None)
