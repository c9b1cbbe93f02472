"""Evidence for causes: the golden trace, the contract, and what plain MuJoCo makes of them.

Programs of a bundle may be rewritten by their user. `Evidence` computes with the originals that this
package writes, so that an edited program is compared with an unedited one.
"""

from __future__ import annotations

import copy
import importlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from mjlab.utils.errors import UserError

FILES = Path(__file__).parent / "files"
"""Folder of the original programs."""


@dataclass(frozen=True)
class Difference:
    """Values of one name that differ.

    Attributes:
        stage: Stage of the check.
        name: Name of the values, such as `raw/obs/joint_pos`.
        expected: Values of the trace, (K, n).
        got: Values of the bundle's programs, (K, n).
        tolerance: Largest difference that is none.
    """

    stage: str
    name: str
    expected: np.ndarray
    got: np.ndarray
    tolerance: float


@dataclass(frozen=True)
class Programs:
    """Imported programs of a folder."""

    runtime: ModuleType
    """`runtime.py`."""
    simulate: ModuleType
    """`simulate.py`, which uses this runtime."""

    @classmethod
    def load(cls, folder: Path) -> Programs:
        """Import the programs of `folder`; the originals for those that it lacks."""
        return cls(*_imported(folder, "runtime", "simulate"))


def _imported(folder: Path, *names: str) -> list[ModuleType]:
    """Import programs of `folder`, with the modules of its user beside them.

    They are forgotten afterwards, because other folders have modules of the same names.
    """
    folders = [str(folder.resolve()), str(FILES)]
    earlier = {name: sys.modules.pop(name) for name in names if name in sys.modules}
    sys.path[:0] = folders
    importlib.invalidate_caches()
    try:
        return [importlib.import_module(name) for name in names]
    finally:
        del sys.path[: len(folders)]
        for name, module in list(sys.modules.items()):
            if str(Path(getattr(module, "__file__", None) or "").parent) in folders:
                del sys.modules[name]
        sys.modules.update(earlier)


class Evidence:
    """Trace and contract of a bundle.

    Attributes:
        folder: Bundle.
        contract: Content of `contract.json`.
        trace: Arrays of the golden trace, or of a log, (K, ...).
        first: Rows that start an episode, (K,).
        originals: Programs as this package writes them.
        found: Values of the checked program, by name, (K, n).
        memo: Results that several causes use, by name.
    """

    def __init__(self, folder: Path, trace: Mapping[str, np.ndarray] | None = None) -> None:
        """Read a bundle; `trace` replaces its golden trace.

        Raises:
            UserError: `folder` is not a bundle.
        """
        self.folder = folder
        if not (folder / "contract.json").exists():
            raise UserError(
                f"{folder}: expected a bundle with contract.json; use `uv run mjlab deploy`."
            )
        self.contract = json.loads((folder / "contract.json").read_text(encoding="utf-8"))
        golden = folder / self.contract["golden"]["file"]
        self.trace = dict(np.load(golden) if trace is None else trace)
        self.first = self.trace["first"].astype(bool)
        self.originals = Programs.load(FILES)
        self._add_formulas()
        self.found: dict[str, np.ndarray] = {}
        self.memo: dict[str, Any] = {}

    def _add_formulas(self) -> None:
        """Give the original runtime the formulas that `runtime.py` of the folder adds.

        Raises:
            UserError: that runtime, needed for a term of the user's own, cannot be imported.
        """
        known = self.originals.runtime.TERMS
        if all(one["kind"] in known or one["function"] in known for one in self.terms.values()):
            return
        try:
            (runtime,) = _imported(self.folder, "runtime")
            added = getattr(runtime, "TERMS", {})
        except Exception as error:
            raise UserError(
                f"{self.folder}/runtime.py raises {type(error).__name__}: {error}"
            ) from error
        known.update({kind: formula for kind, formula in added.items() if kind not in known})

    def policy(self) -> Any:
        """Return the policy of the original runtime, without limits.

        Raises:
            UserError: a term or an action has no formula.
        """
        try:
            return self.originals.runtime.Policy.load(self.folder, limits=False)
        except ValueError as error:
            raise UserError(f"{self.folder}/runtime.py: {error}") from error

    # Contract.

    @cached_property
    def terms(self) -> dict[tuple[str, str], dict[str, Any]]:
        """Entry of each term, by (input, name)."""
        return {
            (one["input"], term["name"]): term
            for one in self.contract["observations"]
            for term in one["terms"]
        }

    @property
    def has_physics(self) -> bool:
        """True if `simulate.py` knows the laws of all actuators."""
        names = {joint["scene_name"] for joint in self.contract["joints"]}
        laws = (one["law"] for one in self.contract["actuators"] if one["joint"] in names)
        return "custom" not in laws

    @cached_property
    def joint_names(self) -> list[str]:
        """Names of the joints, in the order of `joint_pos`."""
        return [joint["name"] for joint in self.contract["joints"]]

    @cached_property
    def target_joints(self) -> list[str]:
        """Joint of each target."""
        return [joint for action in self.contract["actions"] for joint in action["joints"]]

    def values(self, name: str) -> np.ndarray:
        """Return a measurement, or a command as `command/<name>`, (K, size)."""
        key = name if name.startswith("command/") else f"measurement/{name}"
        return flat(self.trace[key])

    def command(self, k: int) -> dict[str, np.ndarray]:
        """Return the given commands of row `k`."""
        given = (one["name"] for one in self.contract["commands"] if one["kind"] == "given")
        return {name: self.trace[f"command/{name}"][k] for name in given}

    def measured(self, k: int) -> dict[str, Any]:
        """Return the measurements of row `k`, and `time`."""
        names = (one["name"] for one in self.contract["measurements"])
        values: dict[str, Any] = {name: self.trace[f"measurement/{name}"][k] for name in names}
        return {**values, "time": float(self.trace["time"][k])}

    def motion(self, k: int) -> int:
        """Return the motion that starts in row `k`."""
        if "motion" in self.trace:
            return int(self.trace["motion"][k])
        episodes = self.contract["golden"]["episodes"]
        return next((one["motion"] for one in episodes if one["row"] == k), 0)

    def state(self, k: int) -> dict[str, np.ndarray]:
        """Return the physics state of row `k`."""
        return {
            key.removeprefix("state/"): values[k]
            for key, values in self.trace.items()
            if key.startswith("state/")
        }

    @cached_property
    def torques(self) -> np.ndarray:
        """Torques at the joints: forces of the actuators times their gears, (K, nu)."""
        torques = self.trace["actuator_force"].astype(float)
        gears = self.model.actuator_gear[: torques.shape[1], 0]
        torques[:, : len(gears)] *= gears
        return torques

    def previous(self, values: np.ndarray, steps: int = 1) -> np.ndarray:
        """Return the rows `steps` earlier; NaN where the episode was younger."""
        moved = np.full(values.shape, np.nan)
        for k in range(len(values)):
            begin, there = k - self.age[k], k - steps
            if begin <= there < len(values) and self.age[there] == self.age[k] - steps:
                moved[k] = values[there]
        return moved

    @cached_property
    def age(self) -> np.ndarray:
        """Steps since the start of the episode, (K,)."""
        rows = np.arange(len(self.first))
        return rows - np.maximum.accumulate(np.where(self.first, rows, 0))

    # Kinematics in plain MuJoCo.

    @property
    def has_states(self) -> bool:
        """True if the trace has physics states; a log has none."""
        return "state/qpos" in self.trace

    @cached_property
    def model(self) -> mujoco.MjModel:
        """Model of the folder's scene."""
        return self.originals.simulate.load_model(self.folder)

    @cached_property
    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Orientation (K, B, 4) and velocity (angular, linear; body axes; K, B, 6) of all bodies."""
        data, count = mujoco.MjData(self.model), self.model.nbody
        quats = np.zeros((len(self.first), count, 4))
        velocities = np.zeros((len(self.first), count, 6))
        kind = mujoco.mjtObj.mjOBJ_XBODY
        for k in range(len(self.first)):
            data.qpos[:], data.qvel[:] = self.trace["state/qpos"][k], self.trace["state/qvel"][k]
            mujoco.mj_fwdPosition(self.model, data)
            mujoco.mj_fwdVelocity(self.model, data)
            quats[k] = data.xquat
            for body in range(count):
                mujoco.mj_objectVelocity(self.model, data, kind, body, velocities[k, body], 1)
        return quats, velocities

    @cached_property
    def root_rotation(self) -> np.ndarray:
        """Rotation of the root, (K, 3, 3); without states, that of its measured quaternion."""
        if not self.has_states:
            name = self.contract["limits"]["tilt_from"]
            shape = (len(self.first), 3, 3)
            is_known = name is not None and f"measurement/{name}" in self.trace
            return rotations(self.values(name)) if is_known else np.full(shape, np.nan)
        body = self.model.body(self.contract["robot"]["root_body"]).id
        return rotations(self.bodies[0][:, body])

    # Formulas and network.

    def evaluate(
        self,
        term: Mapping[str, Any],
        change: Callable[[str, np.ndarray], np.ndarray] | None = None,
    ) -> np.ndarray | None:
        """Return the value of a term from the measurements of the trace, (K, size).

        None: its formula or an input is not known.

        Args:
            term: Entry of the term.
            change: Function of name and values of an input, which returns changed values.
        """
        formulas = self.originals.runtime.TERMS
        formula = formulas.get(term["kind"]) or formulas.get(term["function"])
        names = term["inputs"]
        keys = [n if n.startswith("command/") else f"measurement/{n}" for n in names]
        if formula is None or not names or not all(key in self.trace for key in keys):
            return None
        inputs = [self.values(name).astype(float) for name in names]
        if change is not None:
            inputs = [change(name, values) for name, values in zip(names, inputs, strict=True)]
        arrays = {k: term[k] and np.array(term[k]) for k in ("offset", "scale")}
        entry = {**term, **arrays}
        rows = [np.ravel(formula(list(row), entry)) for row in zip(*inputs, strict=True)]
        return np.array(rows)

    def answers(
        self, change: Callable[[np.ndarray], np.ndarray] | None = None, memory: str = "kept"
    ) -> np.ndarray:
        """Return the answers of the folder's network to the inputs of the trace, (K, A).

        Args:
            change: Function applied to an input.
            memory: `kept`, `cleared` before each step, or `not reset` at starts.
        """
        policy = self.policy()
        rows = []
        for k, is_first in enumerate(self.first):
            if (is_first and memory != "not reset") or memory == "cleared" or k == 0:
                policy.reset(self.motion(k))
            for entry in self.contract["policy"]["inputs"]:
                key = f"input/{entry['name']}"
                if key in self.trace:
                    value = self.trace[key][k]
                    policy.inputs[entry["name"]][0] = value if change is None else change(value)
            if "time_step" in policy.inputs:
                policy.add_commands({}, self.command(k))
            rows.append(policy.infer(policy.inputs).copy())
        return np.array(rows)

    @cached_property
    def normalizer(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Mean and standard deviation inside the network; None without."""
        import onnx
        from onnx import numpy_helper

        graph = onnx.load(str(self.folder / self.contract["policy"]["file"])).graph
        constants = {one.name: numpy_helper.to_array(one).ravel() for one in graph.initializer}
        names = {one.name for one in graph.input}
        for node in graph.node:
            if node.op_type == "Sub" and node.input[0] in names and node.input[1] in constants:
                (output,) = node.output
                for other in graph.node:
                    if other.op_type == "Div" and other.input[0] == output:
                        return constants[node.input[1]], constants[other.input[1]]
        return None

    # Physics.

    def physics(
        self,
        contract: Mapping[str, Any] | None = None,
        model: mujoco.MjModel | None = None,
        simulation: Callable[..., Any] | None = None,
    ) -> dict[str, np.ndarray]:
        """Return what one control step does from each state of the trace, with its targets.

        Args:
            contract: Contract. None: that of the folder.
            model: Model. None: that of the folder.
            simulation: Class like `Simulation` of `simulate.py`. None: the original.
        """
        contract = self.contract if contract is None else contract
        make = self.originals.simulate.Simulation if simulation is None else simulation
        body = make(contract, copy.copy(self.model) if model is None else model)
        policy = self.originals.runtime.Policy(contract, None, self.folder, limits=False)
        found: dict[str, list] = {}
        for k in range(len(self.first)):
            targets = self.golden_targets(policy.commanded(policy.default.copy()), k)
            for name, value in one_step(self, body, targets, k).items():
                found.setdefault(name, []).append(value)
        return {name: np.array(rows) for name, rows in found.items()}

    def golden_targets(self, targets: Any, k: int) -> Any:
        """Return `targets` with the values of row `k` of the trace."""
        fields = {
            name: getattr(targets, name).copy() for name in ("position", "velocity", "effort")
        }
        places = {"joint_velocity": "velocity", "joint_effort": "effort"}
        target = self.trace["target"][k]
        for action in self.contract["actions"]:
            values = target[action["target_start"] : action["target_stop"]]
            index = [self.joint_names.index(name) for name in action["joints"]]
            fields[places.get(action["kind"], "position")][index] = values
        return replace(targets, **fields)


def one_step(evidence: Evidence, simulation: Any, targets: Any, k: int) -> dict[str, np.ndarray]:
    """Return controls, torques and the state after one control step from the state of row `k`.

    Args:
        evidence: Evidence.
        simulation: Object like `Simulation` of `simulate.py`.
        targets: Motor commands.
        k: Row.
    """
    found: dict[str, np.ndarray] = {}
    data, model = simulation.data, simulation.model
    # Once by single physics steps, for what holds within; once as a whole, as the program does it.
    simulation.set_state(**evidence.state(k))
    simulation.apply(targets)
    after = {"after/qpos": data.qpos.copy(), "after/qvel": data.qvel.copy()}
    for name, value in simulation.measure().items():
        if name != "time":
            after[f"next/{name}"] = np.ravel(value).astype(float)
    simulation.set_state(**evidence.state(k))
    for _ in range(simulation.contract["rates"]["decimation"]):
        q, v = data.qpos[simulation.qpos].copy(), data.qvel[simulation.qvel].copy()
        simulation.write_controls(targets)
        mujoco.mj_step(model, data)
    found["ctrl"], found["actuator_force"] = data.ctrl.copy(), data.actuator_force.copy()
    torque = targets.kp * (targets.position - q) + targets.kd * (targets.velocity - v)
    limits = [joint["effort"] for joint in simulation.contract["joints"]]
    limit = np.array([np.inf if one is None else one for one in limits])
    motor = np.clip(torque + targets.effort, -limit, limit)
    motor = [motor[j] if j >= 0 else np.nan for j in simulation.joint_of]
    found["motor_torque"] = np.array(motor)
    return {**found, **after}


# Arrays.


def flat(values: np.ndarray) -> np.ndarray:
    """Return (K, ...) as (K, n)."""
    return values.reshape(len(values), -1)


def rotations(quats: np.ndarray) -> np.ndarray:
    """Return the matrices of quaternions (w, x, y, z), (K, 4) to (K, 3, 3)."""
    w, x, y, z = quats.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)
