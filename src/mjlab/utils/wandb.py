"""Weights & Biases: login check, run tags."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from mjlab.utils.errors import UserError

_VARIABLE = "WANDB_TAGS"


def check_wandb_login(purpose: str, *, records: bool = False) -> None:
    """Raise UserError without a login, where wandb would prompt for a key or fail later.

    Args:
        purpose: Request that needs the login, for the message.
        records: The request records a run, also possible offline.
    """
    if os.environ.get("WANDB_API_KEY"):
        return
    import wandb

    # Tests of packages replace wandb by a few of its functions.
    if not hasattr(wandb, "setup") or wandb.setup().settings.mode != "online":
        return
    try:
        # Credentials in ~/.netrc, in settings files or as identity token.
        has_login = wandb.login(prompt=False, verify=False)
    except TypeError:
        # Versions of wandb that always prompt.
        return
    if not has_login:
        otherwise = (
            "; WANDB_MODE=offline records without an account, and --agent.logger tensorboard does "
            "without Weights & Biases"
        )
        raise UserError(
            f"{purpose}: expected a login at Weights & Biases, found none; run `wandb login` or set "
            f"WANDB_API_KEY{otherwise if records else ''}."
        )


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
