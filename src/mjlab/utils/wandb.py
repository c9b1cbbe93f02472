"""Tags of Weights & Biases runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence

_VARIABLE = "WANDB_TAGS"


def add_wandb_tags(tags: Sequence[str]) -> None:
    """Add tags to the live run, or, where there is none, to those the next run starts with.

    Empty tags, which wandb refuses, are left out.
    """
    # Whoever has a live run has imported wandb; importing it here would only cost time.
    run = getattr(sys.modules.get("wandb"), "run", None)
    if run is not None:
        run.tags = _merged(run.tags or (), tags)
        return
    merged = _merged(os.environ.get(_VARIABLE, "").split(","), tags)
    if merged:
        os.environ[_VARIABLE] = ",".join(merged)
    else:
        # To wandb a variable that is set to nothing is one empty tag.
        os.environ.pop(_VARIABLE, None)


def _merged(present: Iterable[str], new: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(tag for tag in (*present, *new) if tag))
