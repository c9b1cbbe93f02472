"""Scripted arm: inverse kinematics on the host, for one environment."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from mjlab.envs import ManagerBasedRlEnv

OPEN, SHUT = 0.036, -0.3
_ARM = 6


class ScriptedArm:
    """Moves the site between the fingers of the first environment along straight lines."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self.env, self.model = env, env.sim.mj_model
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site("robot/grasp_site").id
        self.home = env.scene["robot"].data.default_joint_pos[0].double().numpy()
        self.scale = env.action_manager.get_term("joint_pos")._scale[0].double().numpy()
        self.joints = self.home.copy()

    def go(self, position: tuple[float, float, float], grip: float, steps: int, down: bool) -> None:
        """Move to a position, optionally with the hand pointing down, with the fingers at `grip`."""
        start, end = self.joints, self._solve(np.array(position), down)
        for step in range(steps):
            share = min(1.0, (step + 1) / (0.7 * steps))
            self.joints = (1 - share) * start + share * end
            self.env.step(self._action(self.joints, grip))

    def _solve(self, position: np.ndarray, down: bool) -> np.ndarray:
        joints = self.joints.copy()
        low, high = self.model.jnt_range[:_ARM].T
        jacobian = np.zeros((6, self.model.nv))
        for _ in range(150):
            self._pose(joints)
            mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self.site)
            out_of_hand = self.data.site_xmat[self.site].reshape(3, 3)[:, 2]
            turn = np.cross(out_of_hand, [0.0, 0.0, -1.0]) if down else np.zeros(3)
            error = np.concatenate((position - self.data.site_xpos[self.site], 0.3 * turn))
            weighted = jacobian[:, :_ARM] * np.repeat([1.0, 0.3 * down], 3)[:, None]
            damped = weighted @ weighted.T + 1e-4 * np.eye(6)
            change = weighted.T @ np.linalg.solve(damped, error)
            joints[:_ARM] = np.clip(joints[:_ARM] + np.clip(change, -0.1, 0.1), low, high)
        return joints

    def _action(self, joints: np.ndarray, grip: float) -> torch.Tensor:
        # Position gains are low, so the command compensates for gravity.
        self._pose(joints)
        stiffness = self.model.actuator_gainprm[:_ARM, 0]
        target = np.append(joints[:_ARM] + self.data.qfrc_bias[:_ARM] / stiffness, grip)
        action = torch.as_tensor((target - self.home[:7]) / self.scale, dtype=torch.float32)
        return action.to(self.env.device).expand(self.env.num_envs, -1)

    def _pose(self, joints: np.ndarray) -> None:
        self.data.qpos[: len(joints)] = joints
        self.data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self.data)
