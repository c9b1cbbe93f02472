"""Weights & Biases run tags."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

_VARIABLE = "WANDB_TAGS"


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
