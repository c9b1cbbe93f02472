"""Publish a policy for others: `uv run mjlab publish POLICY --to FOLDER|hf:NAME/REPO [flags]`."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from mjlab.cli.devices import resolve_device
from mjlab.cli.flags import parse_flags
from mjlab.cli.policy_flags import PolicyFlags, env_cfg_of, parse_policy_flags, task_and_policy
from mjlab.cli.record import VideoCfg, write_clip
from mjlab.deploy.bundle import origin
from mjlab.runs import Checkpoint, Run, resolve_checkpoint
from mjlab.runs.card import write_card
from mjlab.runs.destination import Destination, destination, names_in
from mjlab.runs.evaluation import EVALUATION_FILE, evaluation_command
from mjlab.runs.policy import agent_cfg_of, export_policy, make_env
from mjlab.runs.publication import (
    CLIP_FILE,
    MANIFEST_FILE,
    clean_metadata,
    write_checkpoint,
    write_manifest,
    write_records,
)
from mjlab.runs.run import POLICY_FILE
from mjlab.scripts.deploy import recorded
from mjlab.utils.errors import UserError
from mjlab.utils.logging import beside_results, print_list, print_notice
from mjlab.utils.signals import raising_interrupted
from mjlab.utils.string import command_line

_CLIP = VideoCfg(width=640, height=360)


@dataclass
class PublishConfig:
    """Flags of `mjlab publish`."""

    to: str | None = None
    """Destination: a folder, hf:NAME/REPO or hf:NAME/REPO@BRANCH of the Hugging Face Hub."""
    overwrite: bool = False
    """Replace what was published there before, and files of the same names; other files stay."""
    license: str | None = None
    """License of the policy, an identifier of the Hub such as apache-2.0. None: none is stated."""
    private: bool = False
    """Create a private repository. An existing one stays as it is."""
    clip: bool = True
    """Record a clip of the policy."""
    device: str | None = None
    """Torch device of the clip. None: a GPU if available."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab publish`."""
    source, *flags = argv
    cfg = parse_flags(PublishConfig, PublishConfig(), flags, f"{prog} {source}")
    task, policy = task_and_policy(source)
    run_publish(task, resolve_checkpoint(policy, task), cfg)


def run_publish(task: str, checkpoint: Checkpoint, cfg: PublishConfig) -> None:
    """Publish the policy of `task` in `checkpoint`, in the settings of its run.

    Raises:
        UserError, ValueError, OSError, CheckpointError, HubError: the request cannot be fulfilled.
    """
    if cfg.to is None:
        raise UserError("--to: expected a folder or hf:NAME/REPO, got none.")
    if Path(cfg.to).resolve() == checkpoint.path.parent.resolve():
        raise UserError(f"--to: expected another folder than that of the policy, got {cfg.to}.")
    place = destination(cfg.to, cfg.private)
    earlier = _earlier_files(place, cfg)
    place.parent.mkdir(parents=True, exist_ok=True)
    with (
        raising_interrupted(),
        tempfile.TemporaryDirectory(dir=place.parent, prefix=".publish-") as temporary,
    ):
        folder = Path(temporary) / checkpoint.path.parent.resolve().name
        folder.mkdir()
        _write(task, checkpoint, folder, place.public_name, cfg)
        names = names_in(folder)
        size = sum((folder / name).stat().st_size for name in names)
        place.write(folder, earlier - names)
    print(f"Published {place.name} ({size / 1e6:.1f} MB): {', '.join(sorted(names))}")
    print(f"Next:\n    {command_line(['uv', 'run', 'mjlab', 'play', place.name])}")


def _earlier_files(place: Destination, cfg: PublishConfig) -> set[str]:
    """Return the files of the policy that was published at `place` before.

    Raises:
        UserError: there are files, and `cfg.overwrite` is False.
    """
    present = place.present()
    if present and not cfg.overwrite:
        listed = ", ".join(sorted(present)[:5]) + (", ..." if len(present) > 5 else "")
        raise UserError(
            f"--to: expected an empty or new place, got {place.name} with {listed}; use another one, or "
            "--overwrite."
        )
    return place.published() & present if MANIFEST_FILE in present else set()


def _write(task: str, checkpoint: Checkpoint, folder: Path, name: str, cfg: PublishConfig) -> None:
    """Write all files of the policy into `folder`."""
    device = resolve_device(cfg.device)
    run = Run(checkpoint.path.parent, task)
    paths = write_records(checkpoint, task, folder)
    print_list("Paths of this machine, of which the names are published:", paths)
    write_checkpoint(checkpoint, folder)
    if not (folder / EVALUATION_FILE).is_file():
        command = evaluation_command(task, checkpoint.path, run.profile)
        print_notice(
            f"{checkpoint} is not evaluated, and the card says so. To measure it: {command}"
        )
    flags = parse_policy_flags(
        PolicyFlags, ["--checkpoint-file", str(checkpoint)], task, "publish", purpose="evaluate"
    )
    _export(task, checkpoint, flags, folder / POLICY_FILE)
    if cfg.clip:
        with beside_results("clip"):
            env_cfg = env_cfg_of(task, flags, checkpoint, purpose="play")
            video = replace(_CLIP, profile=flags.profile)
            write_clip(task, env_cfg, checkpoint, folder / CLIP_FILE, device, video)
    source_of = origin(task, flags.profile, checkpoint.path, **recorded(task, checkpoint))
    write_card(folder, name, source_of, cfg.license)
    write_manifest(folder, source_of)


def _export(task: str, checkpoint: Checkpoint, flags: PolicyFlags, path: Path) -> None:
    """Write the network and the metadata of the task as evaluated."""
    env_cfg = env_cfg_of(task, flags, checkpoint, purpose="evaluate")
    env_cfg.scene.num_envs = 1
    agent = agent_cfg_of(task, checkpoint, flags.profile)
    env = make_env(task, env_cfg, "cpu", agent=agent)
    try:
        export_policy(task, env, checkpoint, path, flags.profile)
    finally:
        env.close()
    clean_metadata(path)


def main() -> None:
    """Entry point of `mjlab publish`."""
    from mjlab.cli.main import main as run

    run()
