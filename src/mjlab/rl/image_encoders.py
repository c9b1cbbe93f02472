"""What networks with image encoders need beyond rsl_rl: settings that fit, and encoders shared."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Generator
from typing import Any

import torch

from mjlab.rl.rsl import TensorDict


def settle_image_settings(observations: TensorDict, cfg: dict[str, Any]) -> None:
    """Edit a runner's config, in place, where rsl_rl would fail on settings without effect.

    A network that sees images only has nothing to normalize, since images never are. A critic that
    shares the actor's encoders needs no settings for its own.
    """
    for model in ("actor", "critic", "student", "teacher"):
        groups = (cfg.get("obs_groups") or {}).get(model, ())
        known = [observations[name] for name in groups if name in observations]
        if cfg.get(model) and known and all(value.ndim == 4 for value in known):
            cfg[model]["obs_normalization"] = False
    if cfg["algorithm"].get("share_cnn_encoders"):
        cfg["critic"].setdefault("cnn_cfg", cfg["actor"].get("cnn_cfg"))


@contextlib.contextmanager
def shared_parameters_allowed() -> Generator[None]:
    """Let rsl_rl hand parameters of shared encoders to its optimizer twice; see `train_once`."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*duplicate parameters")
        yield


def train_once(optimizer: torch.optim.Optimizer) -> None:
    """Make `optimizer`, before its first step, change each parameter once a step.

    rsl_rl gives it the parameters of the actor and those of the critic, hence those of encoders
    that both share twice, and each step would move them twice by the same gradient.
    """
    for group in optimizer.param_groups:
        group["params"] = list(dict.fromkeys(group["params"]))
