"""Judges of episodes by their states alone: the same for the environment and for plain MuJoCo."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjlab.deploy.evidence import Programs, rotations
from mjlab.deploy.stress import has_fallen
from mjlab.deploy.usual_terms import is_velocity


@dataclass(frozen=True)
class Outcome:
    """Outcome of an episode."""

    succeeds: bool
    error: float
    """Error in the unit of the judge; NaN if it does not count."""


@dataclass(frozen=True)
class Start:
    """Start of an episode."""

    state: dict[str, np.ndarray]
    """State, by field."""
    motion: int = 0
    """Motion played."""
    frame: int = 0
    """Frame observed first, among those of all motions."""
    length: int = 10**9
    """Control steps until the motion ends."""


class Judge(ABC):
    """Judge of the episodes of a task."""

    quantity: str
    """Error, with its unit."""

    def __init__(self, contract: Mapping[str, Any], model: mujoco.MjModel) -> None:
        self.contract, self.model, self.data = contract, model, mujoco.MjData(model)

    @abstractmethod
    def outcome(
        self,
        start: Start,
        qpos: np.ndarray,
        qvel: np.ndarray,
        commands: Mapping[str, np.ndarray],
    ) -> Outcome:
        """Return the outcome of an episode.

        Args:
            start: Start.
            qpos: Positions after each of T control steps, (T, nq).
            qvel: Velocities, (T, nv).
            commands: Given commands of each step, by name, (T, size).
        """

    def pose(self, qpos: np.ndarray) -> mujoco.MjData:
        """Return the poses of all bodies and sites at `qpos` (nq,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        return self.data


class VelocityJudge(Judge):
    """A robot with a velocity command succeeds if it does not fall."""

    quantity = "velocity error (m/s)"

    def outcome(
        self, start: Start, qpos: np.ndarray, qvel: np.ndarray, commands: Mapping[str, np.ndarray]
    ) -> Outcome:
        """Return the outcome; the error is the mean difference of the horizontal velocity."""
        name = next(one["name"] for one in self.contract["commands"] if is_velocity(one))
        joint = int(self.model.body(self.contract["robot"]["root_body"]).jntadr[0])
        q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
        matrices = rotations(qpos[:, q + 3 : q + 7])
        if has_fallen(self.contract, qpos[:, q + 2], matrices[:, 2, 2]).any():
            return Outcome(False, math.nan)
        measured = np.einsum("tji,tj->ti", matrices, qvel[:, v : v + 3])[:, :2]
        difference = measured - commands[name][:, :2]
        return Outcome(True, float(np.linalg.norm(difference, axis=1).mean()))


class PoseJudge(Judge):
    """An arm with a goal pose succeeds if its frame is there in the last step."""

    quantity = "position error at the end (m)"

    def __init__(
        self, contract: Mapping[str, Any], model: mujoco.MjModel, cfg: Any, frame: tuple[str, str]
    ) -> None:
        """Keep the command's config, for its tolerances, and type and name of its frame."""
        super().__init__(contract, model)
        self.cfg, self.frame = cfg, frame

    def outcome(
        self, start: Start, qpos: np.ndarray, qvel: np.ndarray, commands: Mapping[str, np.ndarray]
    ) -> Outcome:
        """Return the outcome."""
        (goal,) = (rows[-1] for rows in commands.values())
        data = self.pose(qpos[-1])
        root = data.body(self.contract["robot"]["root_body"])
        frame = getattr(data, self.frame[0])(self.frame[1])
        turn = root.xmat.reshape(3, 3).T
        away = float(np.linalg.norm(turn @ (frame.xpos - root.xpos) - goal[:3]))
        (matrix,) = rotations(goal[None, 3:])
        cosine = (np.trace(matrix.T @ turn @ frame.xmat.reshape(3, 3)) - 1.0) / 2.0
        angle = math.acos(min(1.0, max(-1.0, cosine)))
        there = away < self.cfg.position_tolerance and angle < self.cfg.orientation_tolerance
        return Outcome(there, away)


class GoalJudge(Judge):
    """An arm with a goal for an object succeeds if the object is there in the last step."""

    quantity = "distance from the goal at the end (m)"

    def __init__(
        self, contract: Mapping[str, Any], model: mujoco.MjModel, body: str, threshold: float
    ) -> None:
        """Keep the body of the object, and the distance (m) that counts as there."""
        super().__init__(contract, model)
        self.body, self.threshold = body, threshold

    def outcome(
        self, start: Start, qpos: np.ndarray, qvel: np.ndarray, commands: Mapping[str, np.ndarray]
    ) -> Outcome:
        """Return the outcome."""
        (goal,) = (rows[-1] for rows in commands.values())
        away = float(np.linalg.norm(self.pose(qpos[-1]).body(self.body).xpos - goal))
        return Outcome(away < self.threshold, away)


class MotionJudge(Judge):
    """A robot that tracks a motion succeeds if no failure of its task ends the episode."""

    quantity = "joint position error (rad)"
    _KNOWN = ("bad_anchor_pos_z_only", "bad_anchor_ori", "bad_motion_body_pos_z_only")

    def __init__(
        self,
        contract: Mapping[str, Any],
        model: mujoco.MjModel,
        folder: Path,
        bodies: tuple[str, ...],
    ) -> None:
        """Read the motion; `bodies` are those of failures without names.

        Raises:
            ValueError: the task ends episodes by another rule.
        """
        super().__init__(contract, model)
        (self.command,) = (one for one in contract["commands"] if one["kind"] == "motion")
        self.motion, self.bodies = dict(np.load(folder / self.command["file"])), bodies
        failures = [one for one in contract["terminations"] if not one["is_time_out"]]
        self.rules = [(one["function"].rpartition(":")[2], one["params"]) for one in failures]
        unknown = {name for name, _ in self.rules} - {*self._KNOWN}
        if unknown:
            raise ValueError(f"Termination: expected one of {list(self._KNOWN)}, got {unknown}.")

    def outcome(
        self, start: Start, qpos: np.ndarray, qvel: np.ndarray, commands: Mapping[str, np.ndarray]
    ) -> Outcome:
        """Return the outcome; the error is the mean difference of the joint positions."""
        names = [joint["scene_name"] for joint in self.contract["joints"]]
        columns = [int(self.model.joint(name).qposadr[0]) for name in names]
        errors = []
        for t, q in enumerate(qpos[: start.length], start.frame):
            if self._fails(t, self.pose(q)):
                return Outcome(False, math.nan)
            errors.append(np.abs(q[columns] - self.motion["joint_pos"][t]).mean())
        return Outcome(True, float(np.mean(errors)))

    def _fails(self, t: int, data: mujoco.MjData) -> bool:
        """Return True if the robot is too far from frame `t`."""
        places, quats = self.motion["body_pos_w"][t], self.motion["body_quat_w"][t]
        names, anchor = self.command["bodies"], self.command["anchor"]
        entity = self.contract["robot"]["entity"]

        def below(body: str) -> float:
            return places[names.index(body), 2] - data.body(f"{entity}/{body}").xpos[2]

        for rule, params in self.rules:
            if rule == "bad_anchor_pos_z_only":
                far = abs(below(anchor))
            elif rule == "bad_anchor_ori":
                (reference,) = rotations(quats[None, names.index(anchor)])
                far = abs(reference[2, 2] - data.body(f"{entity}/{anchor}").xmat[8])
            else:
                far = max(abs(below(body)) for body in params.get("body_names") or self.bodies)
            if far > params["threshold"]:
                return True
        return False


def judge_of(env: Any, contract: Mapping[str, Any], folder: Path) -> Judge:
    """Return the judge of a task, by its commands.

    Raises:
        SystemExit: no judge knows the task.
    """
    model = Programs.load(folder).simulate.load_model(folder)
    manager = env.command_manager
    for entry in contract["commands"]:
        command = manager.get_term(entry["name"])
        if is_velocity(entry):
            return VelocityJudge(contract, model)
        if entry["kind"] == "motion":
            return MotionJudge(contract, model, folder, command.body_names)
        if hasattr(command.cfg, "position_tolerance"):
            kind = command.frame.frame_type
            name = getattr(env.sim.mj_model, kind)(command.frame.element).name
            return PoseJudge(contract, model, command.cfg, (kind, name))
        if hasattr(command.cfg, "success_threshold"):
            index = int(env.scene[command.cfg.entity_name].indexing.root_body_id)
            body = env.sim.mj_model.body(index).name
            return GoalJudge(contract, model, body, command.cfg.success_threshold)
    raise SystemExit("Expected a command of a velocity, a pose, a goal or a motion.")
