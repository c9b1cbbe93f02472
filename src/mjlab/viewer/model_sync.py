"""Copy one environment of a batched simulation into the host model and data of a viewer."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np

VIEWER_MODEL_FIELDS = frozenset(
    (
        "qpos0",
        # Appearance and shape of geoms, materials and sites.
        *("geom_dataid", "geom_matid", "geom_rgba", "geom_size", "geom_rbound", "geom_aabb"),
        *("geom_pos", "geom_quat", "mat_rgba", "mat_texid", "mat_texrepeat", "mat_emission"),
        *("mat_specular", "mat_shininess", "mat_reflectance"),
        *("site_pos", "site_quat", "site_size", "site_rgba"),
        # Collision filters: geoms that an environment lacks must not show contacts.
        *("geom_contype", "geom_conaffinity"),
        # Frames and inertia of bodies, for inertia boxes and the center of mass.
        *("body_pos", "body_quat", "body_ipos", "body_iquat"),
        *("body_mass", "body_inertia", "body_subtreemass"),
        # Cameras and lights.
        *(
            "cam_pos",
            "cam_quat",
            "cam_fovy",
            "cam_intrinsic",
            "cam_pos0",
            "cam_poscom0",
            "cam_mat0",
        ),
        *("light_pos", "light_dir", "light_pos0", "light_poscom0", "light_dir0", "light_active"),
        *("light_castshadow", "light_ambient", "light_diffuse", "light_specular"),
        *("light_attenuation", "light_cutoff", "light_exponent"),
    )
)
"""Per-environment model fields that affect rendering; viewers copy only these."""

VIEWER_INERTIAL_FIELDS = frozenset({"body_mass", "body_ipos"})
"""Fields that move the center of mass, which MuJoCo's tracking camera follows."""

_STATE_FIELDS = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "time")


def host_model(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of `model` whose visual settings and randomized fields may be overwritten."""
    private = copy.copy(model)
    disable_model_sameframe_shortcuts(private)
    # The bounding volume hierarchy of the midphase is that of the compiled shapes.
    private.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return private


def disable_model_sameframe_shortcuts(model: mujoco.MjModel) -> None:
    """Make MuJoCo compute each geom, site and inertial frame of `model` from its local pose.

    The compiler marks frames that coincide with the body frame, and kinematics then ignores their
    position and rotation. Randomizing either invalidates the marks.
    """
    model.body_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.geom_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.site_sameframe[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def sync_model_fields(
    dst_model: mujoco.MjModel,
    sim_model: Any,
    fields: set[str] | frozenset[str],
    env_idx: int,
) -> None:
    """Copy those of `fields` that affect rendering from one environment into `dst_model`.

    Args:
        dst_model: Host model to write, a private copy made by `host_model`.
        sim_model: Batched model; each field has a leading environment dimension.
        fields: Names of the per-environment fields; those without effect on rendering are skipped.
        env_idx: Environment to copy.
    """
    for field in sorted(fields & VIEWER_MODEL_FIELDS):
        target = getattr(dst_model, field)
        target[:] = to_numpy(getattr(sim_model, field)[env_idx]).reshape(target.shape)


def copy_state(source: Any, env_idx: int, mj_data: mujoco.MjData) -> None:
    """Copy the state of one environment into `mj_data`, without computing derived quantities.

    Args:
        source: A `Simulation`, its `data`, or a plain `MjData`.
        env_idx: Environment to copy; ignored for a plain `MjData`.
        mj_data: Host data to write.
    """
    if hasattr(source, "copy_to_host"):
        source.copy_to_host(env_idx, mj_data)
        return
    single = isinstance(source, mujoco.MjData)
    for field in _STATE_FIELDS:
        value = getattr(source, field)
        row = value if single else to_numpy(value[env_idx])
        if field == "time":
            mj_data.time = float(row)
            continue
        target = getattr(mj_data, field)
        target[:] = np.reshape(row, target.shape)


def compute_poses(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Compute from qpos all quantities needed to render: frames, cameras, lights and tendons.

    A full `mj_forward` would also run collision and the solver, at a higher cost than rendering.
    """
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    mujoco.mj_flex(model, data)
    mujoco.mj_tendon(model, data)


def to_numpy(value: Any) -> np.ndarray:
    """Return a host array of a torch tensor or Warp array on any device, an array or a number."""
    if hasattr(value, "detach"):
        value = value.detach().cpu()
    if hasattr(value, "numpy"):
        value = value.numpy()
    return np.asarray(value)
