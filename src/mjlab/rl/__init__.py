"""Learning: the adapter to rsl_rl, its configs, the runner, evaluation and export.

Names are imported when they are first used, so that `mjlab.rl.config`, which task configs and
command lines read, comes without torch.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

# GitPython, which rsl_rl's logger imports, fails at import where there is no `git` to run.
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
# Not for `import *`, because Gymnasium need not be there.
_WITH_GYMNASIUM = {
    "check_vector_env": "mjlab.rl.vector_checks",
    "gymnasium_env": "mjlab.rl.gymnasium_vector",
}
__all__ = sorted(_HOMES)

__getattr__ = lazy_names(__name__, {**_HOMES, **_WITH_GYMNASIUM})
