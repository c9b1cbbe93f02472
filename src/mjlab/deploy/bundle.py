"""The folder of a deployed policy: network, contract, scene, golden trace and programs to read."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.deploy.contract import Contract
from mjlab.deploy.efferent import write_manifest
from mjlab.deploy.evidence import FILES
from mjlab.deploy.golden import record, write_csv
from mjlab.deploy.readme import readme
from mjlab.deploy.unitree import phase_note, write_unitree
from mjlab.rl.exporter_utils import OnnxPolicy, attach_metadata_to_onnx, get_base_metadata
from mjlab.scene import Scene, SceneCfg

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

PROGRAMS = ("runtime.py", "runtime.hpp", "simulate.py")
"""Programs copied into every bundle."""


@dataclass(frozen=True)
class Bundle:
    """A written bundle."""

    folder: Path
    """Folder."""
    contract: dict[str, Any]
    """Content of `contract.json`."""
    notes: list[str]
    """Sentences to print: missing measurements, unknown terms, and other obstacles to a robot."""


def write_bundle(contract: Contract, folder: Path, source: Mapping[str, Any], steps: int) -> Bundle:
    """Write everything but the network into `folder`, which holds `policy.onnx`.

    Args:
        contract: Contract of the policy in `folder`, in a nominal environment.
        folder: Folder of the bundle.
        source: Origin of the policy, for the contract.
        steps: Number of control steps of the golden trace.
    """
    env = contract.subject.env
    policy = folder / "policy.onnx"
    _update_metadata(env, policy)
    write_scene(env, folder / "scene")
    _write_robot(contract, folder / "robot")
    arrays, episodes = record(contract, OnnxPolicy(policy), steps)
    golden = {
        "file": "golden.npz",
        "table": "golden.csv",
        "steps": steps,
        "episodes": episodes,
    }
    content = contract.as_dict(source, golden)
    text = json.dumps(content, indent=1, allow_nan=False)
    (folder / "contract.json").write_text(text + "\n", encoding="utf-8")
    arrays_of: Any = arrays
    np.savez_compressed(folder / "golden.npz", **arrays_of)
    write_csv(folder / "golden.csv", content, arrays)
    _write_motion(contract, folder)
    for name in PROGRAMS:
        shutil.copyfile(FILES / name, folder / name)
    write_manifest(content, folder)
    notes = _notes(content)
    if (why := write_unitree(content, folder)) is not None:
        notes.append(why)
    else:
        if _is_go1(env):
            notes.append("A Go1 speaks unitree_legged_sdk (UDP), which Unitree's programs do not.")
        if (note := phase_note(content)) is not None:
            notes.append(note)
    (folder / "README.md").write_text(readme(content, notes), encoding="utf-8")
    return Bundle(folder, content, notes)


def origin(task: str, profile: str | None, checkpoint: Path, **known: Any) -> dict[str, Any]:
    """Return the origin of a policy for the contract; `known` is what its run, or its README, records."""
    return {
        "task": task,
        "profile": profile,
        "run": checkpoint.parent.resolve().name,
        "checkpoint": checkpoint.name,
        **known,
        "package": f"mjlab {version('mjlab')}",
        "package_commit": _commit(),
        "mujoco": mujoco.__version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _is_go1(env: ManagerBasedRlEnv) -> bool:
    """Return True if the robot is the bundled Go1, which has the joint names of a Go2."""
    return any("go1" in Path(entity.spec.modelname).stem for entity in env.scene.entities.values())


def _commit() -> str | None:
    """Return the commit of the package's source; None if it is not a checkout."""
    package = Path(__file__).resolve().parents[1]
    command = ["git", "rev-parse", "--show-toplevel", "HEAD"]
    try:
        done = subprocess.run(
            command, cwd=package, capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return None
    top, commit = done.stdout.split("\n")[:2]
    # An installed package may lie within the checkout of something else.
    return commit if Path(top) / "src" / "mjlab" == package else None


def _update_metadata(env: ManagerBasedRlEnv, policy: Path) -> None:
    """Write the settings of the evaluated task into the file; training may have eased them."""
    model_groups = OnnxPolicy(policy).metadata.get("observation_group")
    groups = model_groups.split(",") if model_groups else None
    metadata = dict(get_base_metadata(env, "", groups))
    del metadata["run_path"]
    attach_metadata_to_onnx(str(policy), metadata)


# Models.


def write_scene(env: ManagerBasedRlEnv, folder: Path) -> None:
    """Write the scene of `env` with its physics options, and the numbers that XML rounds."""
    options: Any = SimpleNamespace(opt=env.scene.spec.option)
    env.cfg.sim.mujoco.apply(options)
    env.scene.write(folder)
    written = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    exact: Any = rounded_fields(env.sim.mj_model, written)
    np.savez_compressed(folder / "exact.npz", **exact)


def rounded_fields(model: mujoco.MjModel, written: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the numbers of `model` that differ in `written`, by field; `opt.` before options."""
    fields = {}
    for prefix, one, other in (("", model, written), ("opt.", model.opt, written.opt)):
        for name in dir(one):
            if name.startswith("_"):
                continue
            value, there = getattr(one, name), getattr(other, name)
            if isinstance(value, float):
                value, there = np.array(value), np.array(there)
            if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
                continue
            if value.shape == there.shape and not np.array_equal(value, there):
                fields[prefix + name] = value.copy()
    return fields


def _write_robot(contract: Contract, folder: Path) -> None:
    env, robot = contract.subject.env, contract.subject.robot
    scene = Scene(SceneCfg(entities={robot: env.cfg.scene.entities[robot]}), "cpu")
    scene.write(folder)
    (folder / "scene.xml").replace(folder / "robot.xml")


# Motions.


def _write_motion(contract: Contract, folder: Path) -> None:
    """Write the reference of a motion command, in the fields that controllers of motions read."""
    env = contract.subject.env
    for name in env.command_manager.active_terms:
        term: Any = env.command_manager.get_term(name)
        if hasattr(term, "motion_arrays"):
            # Without compression: runtime.hpp reads it without a library.
            np.savez(folder / "motion.npz", **term.motion_arrays())


def _notes(content: Mapping[str, Any]) -> list[str]:
    """Return what the user should know about a contract."""
    notes = [
        f"Robots do not measure {one['measurement']}, which {one['term']} needs ({one['why']})."
        for one in content["unmeasured"]
    ]
    notes += [
        f"The runtime does not know {term['function']} of the term {term['name']}: add to runtime.py, with "
        f"its formula or the value as the measurement {term['inputs'][0]}: "
        f"`TERMS[{term['function']!r}] = lambda inputs, term: inputs[0]`."
        for observation in content["observations"]
        for term in observation["terms"]
        if term["kind"] == "custom"
    ]
    free = [one["name"] for one in content["joints"] if one["is_actuated"] and not one["kd"]]
    if free:
        notes.append(
            f"Faults leave joints without torque, not damped: {', '.join(free)} (kd 0, as motors driven by "
            "effort have); brake them in your program while `targets.is_damping`."
        )
    notes += [
        f"The runtime does not know the action {action['name']} ({action['class']})."
        for action in content["actions"]
        if action["kind"] == "custom"
    ]
    return notes
