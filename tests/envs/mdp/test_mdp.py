"""The public names are those of the interface."""

from __future__ import annotations

import subprocess
import sys

from mjlab.envs import mdp
from mjlab.envs.mdp import dr


def test_star_import_brings_what_is_public() -> None:
    namespace: dict[str, object] = {}
    exec("from mjlab.envs.mdp import *", namespace)
    for name in ("joint_pos_rel", "reset_joints_by_offset", "JointEffortActionCfg", "dr", "Entity"):
        assert name in namespace
    assert set(mdp.__all__) <= set(namespace)


def test_all_of_dr_is_callable() -> None:
    assert len(dr.__all__) == 55
    assert all(callable(getattr(dr, name)) for name in dr.__all__)


def test_terms_need_no_environment_viewer_or_engine() -> None:
    code = (
        "import sys, mjlab.envs.mdp\n"
        "loaded = [m for m in ('mjlab.envs.manager_based_rl_env', 'mjlab.viewer', 'warp', "
        "'mujoco_warp', 'mujoco.batch', 'rsl_rl') if m in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
