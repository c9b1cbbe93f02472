"""Write what a robot needs to run a policy: `uv run mjlab deploy POLICY [flags]`."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjlab.cli.policy_flags import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    parse_policy_flags,
    report_policy,
    task_and_policy,
)
from mjlab.deploy.bundle import Bundle, origin, write_bundle
from mjlab.deploy.contract import Contract
from mjlab.deploy.nominal import nominal_cfg
from mjlab.runs import Checkpoint, Run
from mjlab.runs.policy import agent_cfg_of, export_policy, has_foreign_runner, make_env
from mjlab.scripts.demo import DEMOS, demo_of
from mjlab.scripts.evaluate import load_curricula_of
from mjlab.utils.errors import UserError
from mjlab.utils.ranges import Count
from mjlab.utils.screen import shown
from mjlab.utils.signals import raising_interrupted


@dataclass
class DeployConfig(PolicyFlags):
    """Flags of `deploy`."""

    output: str = field(default="bundle", metadata=shown("run", "DIR"))
    """Output folder. Must be new or empty."""
    overwrite: bool = field(default=False, metadata=shown("run"))
    """Replace an earlier bundle."""
    steps: Count = field(default=400, metadata=shown("run", "N"))
    """Control steps of the golden trace."""


def command(argv: list[str], prog: str) -> None:
    """Run `deploy`."""
    target, *flags = argv
    task, implied = policy_of(target)
    flags = [*implied, *flags]
    cfg = parse_policy_flags(DeployConfig, flags, task, f"{prog} {target}", purpose="evaluate")
    bundle = run_deploy(task, cfg)
    print(f"Wrote {bundle.folder}.")
    for note in bundle.notes:
        print(f"  {note}")


def policy_of(target: str) -> tuple[str, list[str]]:
    """Return the task of the policy that `target` names, and the flags that select the policy.

    Raises:
        UserError: the policy or its task was not found.
    """
    if target not in DEMOS:
        task, policy = task_and_policy(target)
        return task, ["--checkpoint-file", str(policy)]
    demo = DEMOS[target]
    profile = [] if demo.profile is None else ["--profile", demo.profile]
    return demo.task, ["--checkpoint-file", str(demo.policy), *profile]


def run_deploy(task: str, cfg: DeployConfig) -> Bundle:
    """Write the bundle of a policy of `task`.

    Raises:
        UserError, ValueError, OSError, CheckpointError: the request cannot be fulfilled.
    """
    folder = Path(cfg.output)
    if folder.exists() and any(folder.iterdir()):
        # Anything else is not deleted.
        is_bundle = (folder / "contract.json").is_file()
        if not (cfg.overwrite and is_bundle):
            cure = ", or --overwrite" if is_bundle else ""
            raise UserError(f"--output: folder {folder} is not empty; use another folder{cure}.")
    checkpoint = find_checkpoint(task, cfg)
    if checkpoint is None:
        raise UserError(f"--agent: expected 'trained', got {cfg.agent!r}; a bundle needs a policy.")
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="evaluate")
    report_policy(task, checkpoint, cfg, env_cfg, "evaluate")
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    nominal, lacks = nominal_cfg(env_cfg, agent.clip_actions)
    nominal.seed = 1 if cfg.seed is None else cfg.seed
    folder.parent.mkdir(parents=True, exist_ok=True)
    env = make_env(task, nominal, "cpu", agent=agent)
    try:
        # Written beside the target and renamed, so that a folder never holds half a bundle.
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".deploy-") as temporary:
            made = Path(temporary) / "bundle"
            made.mkdir()
            with raising_interrupted():
                export_policy(task, env, checkpoint, made / "policy.onnx", cfg.profile)
                load_curricula_of(task, env, checkpoint)
                contract = Contract(env.unwrapped, made / "policy.onnx", lacks)
                source = origin(task, cfg.profile, checkpoint.path, **recorded(task, checkpoint))
                bundle = write_bundle(contract, made, source, cfg.steps)
            if folder.exists():
                shutil.rmtree(folder)
            made.replace(folder)
    finally:
        env.close()
    return Bundle(folder, bundle.contract, bundle.notes)


def recorded(task: str, checkpoint: Checkpoint) -> dict[str, Any]:
    """Return what is recorded of the training: by the run, or of a bundled policy by its entry."""
    if (demo := demo_of(checkpoint.path)) is not None:
        return {key: getattr(demo, key) for key in ("run", "iteration", "seed", "commit")}
    run = Run(checkpoint.path.parent)
    is_ours = checkpoint.path.suffix == ".pt" and not has_foreign_runner(task)
    iteration = checkpoint.iteration if is_ours else None
    return {"iteration": iteration, "seed": run.seed, "commit": run.commit}


def main() -> None:
    """Entry point of `mjlab deploy`."""
    from mjlab.cli.main import main as run

    run()
