"""Debug visualizer for `MjvScene`, used by the native window and the offscreen renderer."""

from __future__ import annotations

import logging

import mujoco
import numpy as np

from mjlab.viewer.debug_visualizer import MIN_LENGTH, Color, DebugVisualizer, pose_ghost
from mjlab.viewer.model_sync import compute_poses

log = logging.getLogger(__name__)

_SHAPES = {
    shape: int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"))
    for shape in ("arrow", "box", "cylinder", "ellipsoid", "sphere")
}


class MujocoNativeDebugVisualizer(DebugVisualizer):
    """Debug visualizer that appends geoms to a MuJoCo scene.

    A scene has a maximum number of geoms. Further geoms are dropped, with one warning.
    """

    def __init__(
        self,
        scn: mujoco.MjvScene,
        mj_model: mujoco.MjModel,
        env_idx: int = 0,
        show_all_envs: bool = False,
    ):
        self.scn = scn
        self.mj_model = mj_model
        self.env_idx = env_idx
        self.show_all_envs = show_all_envs
        self._first_geom = scn.ngeom
        self._warned_full = False
        self._ghost_data: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}
        self._ghost_option = mujoco.MjvOption()
        self._ghost_option.flags[mujoco.mjtVisFlag.mjVIS_TRANSPARENT] = True
        # Hide sites and tendons of ghosts: they clutter the view.
        self._ghost_option.sitegroup[:] = 0
        self._ghost_option.tendongroup[:] = 0

    @property
    def meansize(self) -> float:
        return float(self.mj_model.stat.meansize)

    def begin(self, env_idx: int, show_all_envs: bool) -> None:
        """Start a frame: append to the current geoms of the scene, for these environments."""
        self.env_idx = env_idx
        self.show_all_envs = show_all_envs
        self._first_geom = self.scn.ngeom

    def clear(self) -> None:
        self.scn.ngeom = self._first_geom

    def add_ghost_mesh(
        self,
        qpos: np.ndarray,
        model: mujoco.MjModel,
        mocap_pos: np.ndarray | None = None,
        mocap_quat: np.ndarray | None = None,
        alpha: float = 0.5,
        label: str | None = None,
    ) -> None:
        # Keep a reference to the model, so that another model cannot reuse its id.
        _, data = self._ghost_data.setdefault(id(model), (model, mujoco.MjData(model)))
        pose_ghost(data, qpos, mocap_pos, mocap_quat)
        compute_poses(model, data)
        first = self.scn.ngeom
        if self._is_full():
            return
        add_moving_geoms(self.scn, model, data, self._ghost_option)
        for index in range(first, self.scn.ngeom):
            self.scn.geoms[index].rgba[3] = alpha
            self.scn.geoms[index].category = int(mujoco.mjtCatBit.mjCAT_DECOR)

    def _is_full(self) -> bool:
        """Return True, with a warning the first time, if the scene has no room for a geom."""
        full = self.scn.ngeom >= self.scn.maxgeom
        if full and not self._warned_full:
            self._warned_full = True
            log.warning(
                "The scene is full (%d geoms) and some debug drawings are left out; draw fewer "
                "environments or fewer items.",
                self.scn.maxgeom,
            )
        return full

    def _place(
        self, shape: str, center: np.ndarray, size: np.ndarray, mat: np.ndarray, color: Color
    ) -> None:
        if self._is_full():
            return
        geom = self.scn.geoms[self.scn.ngeom]
        self.scn.ngeom += 1
        vectors = (np.asarray(value, dtype=np.float64).ravel() for value in (size, center, mat))
        mujoco.mjv_initGeom(geom, _SHAPES[shape], *vectors, np.asarray(color, dtype=np.float32))
        geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)

    def _connect(
        self, shape: str, start: np.ndarray, end: np.ndarray, radius: float, color: Color
    ) -> None:
        start = np.asarray(start, dtype=np.float64).reshape(3)
        end = np.asarray(end, dtype=np.float64).reshape(3)
        if np.linalg.norm(end - start) < MIN_LENGTH:
            return
        before = self.scn.ngeom
        self._place(shape, np.zeros(3), np.zeros(3), np.eye(3), color)
        if self.scn.ngeom > before:
            mujoco.mjv_connector(self.scn.geoms[before], _SHAPES[shape], radius, start, end)


def add_moving_geoms(
    scn: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    option: mujoco.MjvOption,
) -> None:
    """Append the geoms of the moving bodies of `model`, posed by `data`, to a scene."""
    category = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
    mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), category, scn)
