"""Reinforcement learning: rsl_rl adapter, configs, runner, evaluation and export.

Names are imported on first use, so that `mjlab.rl.config`, read by task configs and command
lines, does not import torch.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

# GitPython, imported by rsl_rl's logger, fails at import if `git` is not installed.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

if TYPE_CHECKING:
    from mjlab.rl.config import EvaluationCfg as EvaluationCfg
    from mjlab.rl.config import RslRlBaseRunnerCfg as RslRlBaseRunnerCfg
    from mjlab.rl.config import RslRlModelCfg as RslRlModelCfg
    from mjlab.rl.config import RslRlOnPolicyRunnerCfg as RslRlOnPolicyRunnerCfg
    from mjlab.rl.config import RslRlPpoAlgorithmCfg as RslRlPpoAlgorithmCfg
    from mjlab.rl.gymnasium_vector import gymnasium_env as gymnasium_env
    from mjlab.rl.runner import MjlabOnPolicyRunner as MjlabOnPolicyRunner
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper as RslRlVecEnvWrapper
    from mjlab.rl.vector_checks import check_vector_env as check_vector_env

_HOMES = {
    "EvaluationCfg": "mjlab.rl.config",
    "MjlabOnPolicyRunner": "mjlab.rl.runner",
    "RslRlBaseRunnerCfg": "mjlab.rl.config",
    "RslRlModelCfg": "mjlab.rl.config",
    "RslRlOnPolicyRunnerCfg": "mjlab.rl.config",
    "RslRlPpoAlgorithmCfg": "mjlab.rl.config",
    "RslRlVecEnvWrapper": "mjlab.rl.vecenv_wrapper",
}
# Not for `import *`: Gymnasium is an optional dependency.
_WITH_GYMNASIUM = {
    "check_vector_env": "mjlab.rl.vector_checks",
    "gymnasium_env": "mjlab.rl.gymnasium_vector",
}
__all__ = sorted(_HOMES)

__getattr__ = lazy_names(__name__, {**_HOMES, **_WITH_GYMNASIUM})
