"""Write what a robot needs to run a policy: `uv run mjlab deploy RUN|CHECKPOINT [flags]`."""

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
)
from mjlab.deploy.bundle import Bundle, origin, write_bundle
from mjlab.deploy.contract import Contract
from mjlab.deploy.nominal import nominal_cfg
from mjlab.runs import Checkpoint, Run
from mjlab.runs.policy import agent_cfg_of, has_foreign_runner, load_runner, make_env
from mjlab.scripts.demo import DEMOS
from mjlab.tasks.registry import list_tasks
from mjlab.utils.errors import UserError
from mjlab.utils.ranges import Count
from mjlab.utils.screen import shown


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
    task, path, defaults = policy_of(target, flags)
    flags = ["--checkpoint-file", str(path), *defaults, *flags]
    cfg = parse_policy_flags(DeployConfig, flags, task, f"{prog} {target}", purpose="evaluate")
    bundle = run_deploy(task, cfg)
    print(f"Wrote {bundle.folder}.")
    for note in bundle.notes:
        print(f"  {note}")


def policy_of(target: str, flags: list[str]) -> tuple[str, Path, list[str]]:
    """Return task and path of the policy that `target` names, and flags that it implies.

    Raises:
        UserError: the policy or its task was not found.
    """
    if target in DEMOS:
        demo = DEMOS[target]
        profile = [] if demo.profile is None else ["--profile", demo.profile]
        return demo.task, demo.policy, profile
    path = Path(target)
    if not path.exists():
        raise UserError(
            f"Policy {target!r}: expected a run folder, a checkpoint (.pt), an exported policy (.onnx) "
            f"or one of {', '.join(DEMOS)}; not found."
        )
    folder = path if path.is_dir() else path.parent
    task = Run(folder).task
    if task is None and path.suffix == ".pt":
        task = Checkpoint(path).task
    if task not in list_tasks():
        raise UserError(
            f"Policy {target!r} task: expected a registered task in {folder / 'run.json'}, got {task!r}; "
            "install the package of the task."
        )
    return task, path, []


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
            _export(task, env, checkpoint, made, cfg.profile)
            contract = Contract(env.unwrapped, made / "policy.onnx", lacks)
            is_ours = checkpoint.path.suffix == ".pt" and not has_foreign_runner(task)
            run = Run(checkpoint.path.parent)
            source = origin(
                task,
                cfg.profile,
                checkpoint.path,
                iteration=checkpoint.iteration if is_ours else None,
                seed=run.seed,
                commit=run.commit,
            )
            bundle = write_bundle(contract, made, source, cfg.steps)
            if folder.exists():
                shutil.rmtree(folder)
            made.replace(folder)
    finally:
        env.close()
    return Bundle(folder, bundle.contract, bundle.notes)


def _export(task: str, env: Any, checkpoint: Checkpoint, folder: Path, profile: str | None) -> None:
    """Write `policy.onnx`, and let the curricula of the run set the ranges of `env`."""
    if checkpoint.path.suffix == ".onnx":
        from mjlab.rl.exporter_utils import load_onnx_policy
        from mjlab.tasks.registry import load_env_cfg

        load_onnx_policy(checkpoint.path, env, "cpu", load_env_cfg(task, profile=profile))
        shutil.copyfile(checkpoint.path, folder / "policy.onnx")
        return
    runner = load_runner(task, env, checkpoint, "cpu", profile)
    if runner.export_policy(str(folder / "policy.onnx")) is None:
        raise UserError(f"Policy {checkpoint}: exporting it as ONNX failed, see above.")
    if not has_foreign_runner(task):
        from mjlab.rl.checkpoint import curricula_of
        from mjlab.rl.evaluation import load_curricula

        if (state := curricula_of(checkpoint.content)) is not None:
            load_curricula(env, state)


def main() -> None:
    """Entry point of `mjlab deploy`."""
    from mjlab.cli.main import main as run

    run()
