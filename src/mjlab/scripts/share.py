"""Write a page of a policy to share: `uv run mjlab share POLICY [flags]`."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mjlab.cli.devices import resolve_device
from mjlab.cli.flags import is_given
from mjlab.cli.policy_flags import (
    PolicyFlags,
    env_cfg_of,
    find_checkpoint,
    parse_policy_flags,
    report_policy,
)
from mjlab.deploy.commands import command_entry
from mjlab.deploy.measurements import Subject
from mjlab.rl.evaluation import reward_unit
from mjlab.runs import Checkpoint, Run
from mjlab.runs.evaluation import EVALUATION_FILE, evaluation_command, read_evaluation
from mjlab.runs.policy import agent_cfg_of, has_foreign_runner, make_env, make_policy
from mjlab.runs.publication import without_paths
from mjlab.runs.shared_page import SharedPage, learning_curves
from mjlab.scripts.demo import DEMOS
from mjlab.scripts.deploy import policy_of, recorded
from mjlab.scripts.evaluate import load_curricula_of
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import file_to_write, replacing
from mjlab.utils.processes import machine
from mjlab.utils.ranges import Count, Positive, Seed
from mjlab.utils.screen import shown
from mjlab.viewer.viser.recording import record_episodes

MAX_BYTES = 5_000_000
"""Size of a page that can be sent to anyone."""
# Commands of more components are drawn in the scene, if at all.
_MOST_COMPONENTS = 4


@dataclass
class ShareConfig(PolicyFlags):
    """Flags of `share`."""

    output: str = field(default="share.html", metadata=shown("record", "FILE"))
    """Page."""
    num_episodes: Count = field(default=2, metadata=shown("record", "N"))
    """Number of recorded episodes."""
    seconds: Positive = field(default=10.0, metadata=shown("record", "S"))
    """Longest duration of a recorded episode (s)."""
    fps: Positive = field(default=25.0, metadata=shown("record", "N"))
    """Recorded frames per second."""
    evaluation: str | None = field(default=None, metadata=shown("policy", "FILE"))
    """Result of `evaluate --output`. None: `evaluation.json` beside the policy."""
    seed: Seed | None = field(default=0, metadata=shown("run", "N"))
    """Seed of the recorded episodes."""


def command(argv: list[str], prog: str) -> None:
    """Run `share`."""
    target, *flags = argv
    task, implied = policy_of(target)
    if target in DEMOS:
        implied += ["--evaluation", str(DEMOS[target].evaluation)]
    flags = [*implied, *flags]
    cfg = parse_policy_flags(ShareConfig, flags, task, f"{prog} {target}", purpose="evaluate")
    if not is_given("--env.scene.num-envs", flags) and cfg.num_envs is None:
        cfg.num_envs = 1
    page = run_share(task, cfg)
    print(f"Wrote {page} ({page.stat().st_size / 1e6:.1f} MB): open it in a browser, or send it.")


def run_share(task: str, cfg: ShareConfig) -> Path:
    """Record a policy of `task`, write its page, and return the path.

    Raises:
        UserError, ValueError, OSError, CheckpointError: the request cannot be fulfilled.
    """
    output = file_to_write(cfg.output)
    if cfg.evaluation is not None and not Path(cfg.evaluation).is_file():
        raise UserError(
            f"--evaluation: expected a file of `evaluate --output`, got {cfg.evaluation}; not found."
        )
    checkpoint = find_checkpoint(task, cfg)
    if checkpoint is None:
        raise UserError(f"--agent: expected 'trained', got {cfg.agent!r}; a page needs a policy.")
    device = resolve_device(cfg.device)
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="evaluate")
    report_policy(task, checkpoint, cfg, env_cfg, "evaluate")
    agent = agent_cfg_of(task, checkpoint, cfg.profile)
    env = make_env(task, env_cfg, device, agent=agent)
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        load_curricula_of(task, env, checkpoint)
        names = _command_names(env.unwrapped)
        recording = record_episodes(
            env, policy, cfg.num_episodes, cfg.seconds, cfg.fps, print_notice
        )
        unit = reward_unit(env)
        recorded = {
            "recorded with": f"mjlab {version('mjlab')}, seed {cfg.seed}",
            "recorded on": f"{machine(device)}, {env.unwrapped.sim.capabilities.description}",
        }
    finally:
        env.close()
    beside = checkpoint.path.parent / EVALUATION_FILE
    run = Run(checkpoint.path.parent, task)
    profile = None if cfg.profile == run.profile else cfg.profile
    evaluation = read_evaluation(Path(cfg.evaluation or beside), task, checkpoint.path)
    if evaluation is None:
        how = evaluation_command(task, checkpoint.path, profile)
        print_notice(f"No evaluation, so the page has none; to add it:\n    {how}")
    page = SharedPage(
        task=task,
        origin={**_origin(task, run, checkpoint, cfg.profile), **recorded},
        recording=recording,
        reward_unit=unit,
        command_names=names,
        curves=learning_curves(run, agent.evaluation),
        evaluation=evaluation,
        # Readers of the page have other folders.
        evaluation_command=evaluation_command(
            task, Path(run.folder.name) / checkpoint.path.name, profile
        ),
        settings=without_paths(run.settings) if run.exists else {},
    ).html()
    if (size := len(page.encode())) > MAX_BYTES:
        print_notice(
            f"The page has {size / 1e6:.1f} MB, more than {MAX_BYTES / 1e6:g}; lower --num-episodes, "
            "--seconds or --fps, or the terrain's size."
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    with replacing(output) as file:
        file.write(page.encode())
    return output


def _origin(task: str, run: Run, checkpoint: Checkpoint, profile: str | None) -> dict[str, Any]:
    """Return what is recorded of a policy's training; None where it is not."""
    is_ours = checkpoint.path.suffix == ".pt" and not has_foreign_runner(task)
    started = run.started
    training = recorded(task, checkpoint)
    return {
        "profile": profile or "none",
        "learner": checkpoint.learner if is_ours else run.learner,
        "policy": checkpoint.path.name,
        "iterations": training["iteration"],
        "seed of training": training["seed"],
        "commit": training["commit"],
        "trained on": run.info.get("machine"),
        "trained at": None if started is None else f"{started:%Y-%m-%d %H:%M}",
    }


def _command_names(env: Any) -> dict[str, list[str]]:
    """Return names and units of the components of commands that a user gives, if they are few."""
    found = {}
    for name in env.command_manager.active_terms:
        entry = command_entry(Subject(env, next(iter(env.scene.entities), "")), name)
        if entry["kind"] != "given" or entry["size"] > _MOST_COMPONENTS:
            continue
        named = [f"{one['name']} ({one['unit']})" for one in entry["components"]]
        found[name] = named or [f"{name}.{i}" for i in range(entry["size"])]
    return found


def main() -> None:
    """Entry point of `mjlab share`."""
    from mjlab.cli.main import main as run

    run()
