"""Names that release 1.1 offers, and that packages import from where they found them."""

from mjlab import MJLAB_SRC_PATH, TYRO_FLAGS
from mjlab.actuator.builtin_group import BuiltinActuatorType
from mjlab.asset_zoo.robots import G1_ACTION_SCALE, YAM_ACTION_SCALE
from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import DM_4310, DM_4340
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import get_assets
from mjlab.entity.data import EntityData
from mjlab.envs.mdp import quat_from_euler_xyz, quat_mul
from mjlab.envs.types import VecEnvObs, VecEnvStepReturn
from mjlab.scripts.csv_to_npz import run_sim
from mjlab.scripts.gcs import ensure_default_checkpoint, ensure_default_motion
from mjlab.scripts.play import get_wandb_checkpoint_path, load_env_cfg
from mjlab.tasks.registry import _REGISTRY
from mjlab.tasks.tracking.tracking_env_cfg import VELOCITY_RANGE
from mjlab.terrains.heightfield_terrains import _compute_flat_patches
from mjlab.utils.lab_api.math import (
    orthogonalize_perspective_depth,
    project_points,
    unproject_depth,
)
from mjlab.viewer.base import BaseViewer
from mjlab.viewer.native.keys import KEY_ENTER, KEY_KP_ADD, KEY_SPACE
from mjlab.viewer.native.viewer import (
    NativeMujocoViewer,
    PlotCfg,
    compute_viewports,
    make_empty_figure,
)
from mjlab.viewer.viser import ViserMujocoScene, get_body_name, is_fixed_body
from mjlab.viewer.viser.camera_viewer import ViserCameraViewer
from mjlab.viewer.viser.conversions import (
    create_primitive_mesh,
    group_geoms_by_visual_compat,
    merge_geoms,
    mujoco_mesh_to_trimesh,
    rotation_quat_from_vectors,
)

FUNCTIONS = (
    compute_viewports,
    create_primitive_mesh,
    ensure_default_checkpoint,
    ensure_default_motion,
    get_assets,
    get_body_name,
    get_wandb_checkpoint_path,
    group_geoms_by_visual_compat,
    is_fixed_body,
    load_env_cfg,
    make_empty_figure,
    merge_geoms,
    mujoco_mesh_to_trimesh,
    orthogonalize_perspective_depth,
    project_points,
    quat_from_euler_xyz,
    quat_mul,
    rotation_quat_from_vectors,
    run_sim,
    unproject_depth,
    ViserMujocoScene.create,
    _compute_flat_patches,
)
assert all(callable(function) for function in FUNCTIONS)
TYPES = (BuiltinActuatorType, PlotCfg, VecEnvObs, VecEnvStepReturn, ViserCameraViewer)

assert (MJLAB_SRC_PATH / "asset_zoo").is_dir()
assert TYRO_FLAGS
assert "Tasks11-Cart" not in _REGISTRY
assert ".*_elbow_joint" in G1_ACTION_SCALE
assert "joint1" in YAM_ACTION_SCALE
assert DM_4310.effort_limit < DM_4340.effort_limit
assert {"x", "y", "z", "roll", "pitch", "yaw"} == set(VELOCITY_RANGE)
assert (KEY_SPACE, KEY_ENTER, KEY_KP_ADD) == (32, 257, 334)
assert EntityData.ROOT_STATE_DIM == EntityData.ROOT_POSE_DIM + EntityData.ROOT_VEL_DIM == 13
assert 1.0 in BaseViewer.SPEED_MULTIPLIERS


class QuietViewer(NativeMujocoViewer):
    """Window whose model is read by its old name."""

    def geoms(self) -> int:
        return self.mjm.ngeom
