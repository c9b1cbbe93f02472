"""Bundles for tests: of the bundled policies, and of untrained ones."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np

# Observations of all kinds: sensors, gravity, history and clock, motions, objects, poses, scans, images.
BUNDLES = (
    "go1",
    "g1",
    "Mjlab-Cartpole-Swingup",
    "Mjlab-Tracking-Flat-Unitree-G1",
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Reach-Yam",
    "Mjlab-Velocity-Rough-Unitree-Go1",
    "Mjlab-Lift-Cube-Yam-Depth",
)
"""Bundled policies and stock tasks."""
STEPS = 45
"""Control steps of the traces: an episode of each bundle, and one that begins within."""


def load_program(folder: Path, name: str) -> ModuleType:
    """Import a program of a bundle, as its user does: with the folder on the path."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def write_demo(name: str, folder: Path, steps: int = STEPS) -> Path:
    """Write the bundle of the bundled policy `name`."""
    from mjlab.cli.policy_flags import parse_policy_flags
    from mjlab.scripts.demo import DEMOS
    from mjlab.scripts.deploy import DeployConfig, run_deploy

    demo = DEMOS[name]
    flags = ["--checkpoint-file", str(demo.policy), "--output", str(folder), "--steps", str(steps)]
    flags += [] if demo.profile is None else ["--profile", demo.profile]
    cfg = parse_policy_flags(DeployConfig, flags, demo.task, "deploy", purpose="evaluate")
    run_deploy(demo.task, cfg)
    return folder


def relative_targets(env: Any, agent: Any) -> None:
    """Let the arm follow targets relative to the measured positions."""
    from mjlab.envs.mdp.actions import RelativeJointPositionActionCfg

    action = env.actions["joint_pos"]
    env.actions["joint_pos"] = RelativeJointPositionActionCfg(
        entity_name=action.entity_name,
        actuator_names=action.actuator_names,
        scale=0.5,
        clip={".*": (-0.1, 0.2)},
        read_every_substep=False,
    )


_EDITS = {"Mjlab-Reach-Yam": relative_targets}


def write_random(
    task: str,
    folder: Path,
    edit: Callable[[Any, Any], None] | None = None,
    steps: int = STEPS,
) -> Path:
    """Write the bundle of an untrained policy of `task`; `edit` changes both configs in place."""
    from mjlab.deploy.bundle import write_bundle
    from mjlab.deploy.contract import Contract
    from mjlab.deploy.nominal import nominal_cfg
    from mjlab.rl import MjlabOnPolicyRunner
    from mjlab.rl.learners import acting_cfg
    from mjlab.runs.policy import make_env
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls

    evaluated, agent = load_env_cfg(task, evaluate=True), load_rl_cfg(task)
    edit = edit or _EDITS.get(task, lambda env, agent: None)
    edit(evaluated, agent)
    cfg, lacks = nominal_cfg(evaluated, agent.clip_actions)
    cfg.seed = 1
    env = make_env(task, cfg, "cpu", agent=agent)
    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    folder.mkdir()
    runner_cls(env, acting_cfg(agent), device="cpu").export_policy(str(folder / "policy.onnx"))
    contract = Contract(env.unwrapped, folder / "policy.onnx", lacks)
    write_bundle(contract, folder, {"task": task}, steps)
    env.close()
    return folder


def row_of(policy: Any, trace: dict[str, np.ndarray], k: int) -> tuple[dict, dict]:
    """Return measurements and commands of step `k`."""
    contract = policy.contract
    measured: dict[str, Any] = {
        entry["name"]: trace[f"measurement/{entry['name']}"][k]
        for entry in contract["measurements"]
    }
    measured["time"] = float(trace["time"][k])
    given = [entry["name"] for entry in contract["commands"] if entry["kind"] == "given"]
    return measured, {name: trace[f"command/{name}"][k] for name in given}


# Parity with the training environment.

TOLERANCE = 1e-5
"""Largest difference, as a fraction of the range of a term."""


def arrays_of(folder: Path) -> dict[str, np.ndarray]:
    """Return the golden trace of a bundle."""
    return dict(np.load(folder / "golden.npz"))


def differences(got: Any, expected: np.ndarray, spans: np.ndarray) -> float:
    """Return the largest difference in units of the range of the whole term."""
    return float(np.abs(np.asarray(got) - expected).max(initial=0.0) / max(np.ptp(spans), 1e-3))


def worst_differences(
    folder: Path, formulas: Mapping[str, Callable[..., Any]] = MappingProxyType({})
) -> dict[str, float]:
    """Return the largest difference of each array that the runtime computes, over the whole trace.

    `formulas` are those of custom terms, by `module:function`.
    """
    runtime = load_program(folder, "runtime")
    runtime.TERMS.update(formulas)
    policy = runtime.Policy.load(folder, limits=False)
    trace = arrays_of(folder)
    motions = {one["row"]: one["motion"] for one in policy.contract["golden"]["episodes"]}
    worst: dict[str, float] = {}
    for k in range(len(trace["time"])):
        if trace["first"][k]:
            policy.reset(motion=motions[k])
        policy.step(*row_of(policy, trace, k))
        pairs = {f"raw/{i}/{term}": value for (i, term), value in policy.values.items()}
        pairs |= {f"input/{i}": value[0] for i, value in policy.inputs.items()}
        pairs |= {"action": policy.action, "target": policy.target}
        for key, value in pairs.items():
            if key in trace:
                found = differences(value, trace[key][k], trace[key])
                worst[key] = max(worst.get(key, 0.0), found)
    return worst
