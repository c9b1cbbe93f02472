"""Weights & Biases run tags."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence

_VARIABLE = "WANDB_TAGS"


def add_wandb_tags(tags: Sequence[str]) -> None:
    """Add tags to the active run, or else to the tags of the next run.

    Empty tags are omitted, because wandb rejects them.
    """
    # An active run implies that wandb is already imported; importing it here would only cost time.
    run = getattr(sys.modules.get("wandb"), "run", None)
    if run is not None:
        run.tags = _merged(run.tags or (), tags)
        return
    merged = _merged(os.environ.get(_VARIABLE, "").split(","), tags)
    if merged:
        os.environ[_VARIABLE] = ",".join(merged)
    else:
        # wandb reads an empty variable as one empty tag.
        os.environ.pop(_VARIABLE, None)


def _merged(present: Iterable[str], new: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(tag for tag in (*present, *new) if tag))
