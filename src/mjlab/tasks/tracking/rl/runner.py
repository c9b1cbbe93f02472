"""Motion tracking runner, and export of the policy with its reference motions."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from rsl_rl.env import VecEnv

from mjlab.rl.exporter_utils import export_to_onnx
from mjlab.rl.runner import ExportingOnPolicyRunner
from mjlab.tasks.tracking.mdp.commands import MotionCommand
from mjlab.tasks.tracking.mdp.motion_sampling import HardSegmentSampler
from mjlab.tasks.tracking.motion_sources import full_artifact_name, record_motions
from mjlab.tasks.tracking.rl.reference_actor import ReferenceActor
from mjlab.utils.errors import check_exists
from mjlab.utils.logging import beside_results

if TYPE_CHECKING:
    from mjlab.tasks.tracking.mdp.motion_library import MotionLibrary

REFERENCE = (
    "joint_pos",
    "joint_vel",
    "body_pos_w",
    "body_quat_w",
    "body_lin_vel_w",
    "body_ang_vel_w",
)
"""Motion tensors returned by the exported policy, one row per frame."""
logger = logging.getLogger(__name__)
_FAILURES = "motion_failures"


class MotionTrackingOnPolicyRunner(ExportingOnPolicyRunner):
    """`MjlabOnPolicyRunner` that exports the policy with the reference at every checkpoint and
    copies the motions into the run folder.

    The command is a `MotionCommand`, or any term named `motion`. For custom classes, the motions
    are read from `motion` and `cfg.motion_file`; without these, the policy is exported alone.

    Checkpoints contain the failure statistics, so that adaptive sampling continues after a resume
    with any number of environments.
    """

    def __init__(
        self,
        env: VecEnv,
        train_cfg: dict,
        log_dir: str | None = None,
        device: str = "cpu",
        registry_name: str | None = None,
    ) -> None:
        """Build the networks and the algorithm.

        Args:
            env: Vectorized environment.
            train_cfg: `RslRlOnPolicyRunnerCfg` as a dict; modified in place here and by rsl_rl.
            log_dir: Run folder. None: write nothing.
            device: Device of the networks.
            registry_name: Weights & Biases artifact of the motion; runs logged there record its
                use.

        Raises:
            ValueError: no motion command found, or `ReferenceActor` cannot follow it.
        """
        super().__init__(env, train_cfg, log_dir, device)
        manager = self.env.unwrapped.command_manager
        terms = {name: manager.get_term(name) for name in manager.active_terms}
        name = next((n for n, term in terms.items() if isinstance(term, MotionCommand)), "motion")
        check_exists("motion command", name, terms)
        self.motion_command: Any = terms[name]
        actor = self.alg.get_policy()
        if isinstance(actor, ReferenceActor):
            actor.follow(self.env.unwrapped, self.motion_command)
        self._registry_name = registry_name
        self._is_marked = False

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint, and the policy as `<folder>/<folder's name>.onnx` beside it.

        The first call also copies the motions into the folder. Errors after the checkpoint is
        written are logged and do not stop training.

        Args:
            path: Path of the checkpoint.
            infos: Additional plain data, returned by `load`.

        Raises:
            CheckpointError: the checkpoint could not be written.
        """
        sampler = self._sampler
        if sampler is not None:
            infos = {**(infos or {}), _FAILURES: sampler.failed.cpu().clone()}
        super().save(path, infos)
        if not self._is_main_process:
            return
        folder = Path(path).resolve().parent
        with beside_results(f"record of the motions in {folder}"):
            self._save_motions(folder)

    def load_content(
        self,
        content: Mapping[str, Any],
        path: str | os.PathLike[str],
        *,
        load_cfg: dict | None = None,
        strict: bool = True,
    ) -> dict:
        """Load a checkpoint; a full load also restores failure statistics of matching size.

        Arguments, result and errors are those of `MjlabOnPolicyRunner.load_content`.
        """
        infos = super().load_content(content, path, load_cfg=load_cfg, strict=strict)
        sampler, failed = self._sampler, infos.get(_FAILURES)
        if load_cfg is None and sampler is not None and failed is not None:
            if failed.shape == sampler.failed.shape:
                sampler.failed.copy_(failed)
            else:
                logger.warning(
                    "Failure statistics reset: the checkpoint has %d segments, the motions have %d.",
                    len(failed), sampler.num_bins,
                )  # fmt: skip
        return infos

    def export_policy_to_onnx(
        self, path: str, filename: str = "policy.onnx", verbose: bool = False
    ) -> None:
        """Write the policy and the reference to `path`/`filename`; see `PolicyWithReference`."""
        # Custom commands may have no motion.
        motion = cast("MotionLibrary", getattr(self.motion_command, "motion", None))
        missing = [name for name in (*REFERENCE, "time_step_total") if not hasattr(motion, name)]
        if missing:
            logger.info("Policy exported without the motion: attributes %s are missing.", missing)
            super().export_policy_to_onnx(path, filename, verbose)
            return
        policy = self.alg.get_policy().as_onnx(verbose=verbose)
        exported = PolicyWithReference(policy, motion)
        limit = getattr(self.env, "clip_actions", None)
        export_to_onnx(exported, Path(path) / filename, verbose, limit)

    def onnx_metadata(self) -> dict[str, Any]:
        """Return the base metadata plus anchor, tracked bodies and motions of the reference."""
        command, metadata = self.motion_command, super().onnx_metadata()
        if hasattr(command.cfg, "anchor_body_name"):
            metadata["anchor_body_name"] = command.cfg.anchor_body_name
        if hasattr(command.cfg, "body_names"):
            metadata["body_names"] = list(command.cfg.body_names)
        if isinstance(command, MotionCommand):
            metadata |= {
                "motion_names": list(command.motion.names),
                "motion_starts": command.motion.starts.tolist(),
                "motion_lengths": command.motion.lengths.tolist(),
            }
        return metadata

    @property
    def _sampler(self) -> HardSegmentSampler | None:
        sampler = getattr(self.motion_command, "sampler", None)
        return sampler if isinstance(sampler, HardSegmentSampler) else None

    def _save_motions(self, folder: Path) -> None:
        command = self.motion_command
        if isinstance(command, MotionCommand):
            files = command.motion_files
        else:
            path = Path(getattr(command.cfg, "motion_file", ""))
            files = (path,) if path.is_file() else ()
        new = record_motions(files, folder, self._registry_name) if files else []
        if self.cfg.get("logger") != "wandb":
            return
        import wandb

        if wandb.run is None:
            return
        if self.cfg.get("upload_model", True):
            for path in new:
                wandb.save(str(path), base_path=str(folder))
        if self._registry_name is not None and not self._is_marked:
            self._is_marked = True
            wandb.run.use_artifact(full_artifact_name(self._registry_name))


class PolicyWithReference(torch.nn.Module):
    """Exported module: (obs, time_step) -> actions and the reference at that time step.

    | input | shape | | output | shape |
    | --- | --- | --- | --- | --- |
    | `obs` | (N, observations) | | `actions` | (N, nj), the mean; the normalizer is inside |
    | `time_step` | (N, 1) | | `joint_pos`, `joint_vel` | (N, nj) |
    | | | | `body_pos_w`, `body_lin_vel_w`, `body_ang_vel_w` | (N, K, 3) |
    | | | | `body_quat_w` | (N, K, 4) |

    The time step is a frame index over all motions in sequence, truncated to an integer and clamped
    to the last frame. Bodies are the tracked ones; positions do not include environment origins.
    """

    def __init__(self, policy: Any, motion: MotionLibrary) -> None:
        """Wrap the module returned by rsl_rl's `as_onnx`, with copies of the motion tensors.

        Raises:
            ValueError: the policy has inputs other than `obs`.
        """
        super().__init__()
        self.policy = policy
        if list(policy.input_names) != ["obs"]:
            raise ValueError(
                "PolicyWithReference policy: expected the single input 'obs', got "
                f"{list(policy.input_names)}."
            )
        for name in REFERENCE:
            self.register_buffer(name, getattr(motion, name).detach().cpu().clone())
        self.last_frame = motion.time_step_total - 1

    @property
    def input_names(self) -> list[str]:
        """Names of the ONNX inputs."""
        return ["obs", "time_step"]

    @property
    def output_names(self) -> list[str]:
        """Names of the ONNX outputs."""
        return ["actions", *REFERENCE]

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return example inputs for tracing."""
        return (*self.policy.get_dummy_inputs(), torch.zeros(1, 1))

    def forward(self, obs: torch.Tensor, time_step: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the actions and the reference frame."""
        frame = time_step.long().squeeze(-1).clamp(0, self.last_frame)
        return (self.policy(obs), *(getattr(self, name)[frame] for name in REFERENCE))
