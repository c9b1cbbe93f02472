"""Neural network actuators."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.actuator.actuator import ActuatorCmd
from mjlab.actuator.dc_actuator import DcMotorActuator, DcMotorActuatorCfg, dc_motor_clip
from mjlab.utils.buffers import CircularBuffer
from mjlab.utils.errors import WrongStateError, check_count, check_one_of
from mjlab.utils.indexing import EnvIds

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity.entity import Entity


@dataclass(kw_only=True)
class LearnedMlpActuatorCfg(DcMotorActuatorCfg):
    """Network actuator, see `LearnedMlpActuator`."""

    stiffness: float = 0.0
    """Not used: the network includes the controller."""
    damping: float = 0.0
    """Not used."""
    network_file: str
    """TorchScript file of the network. Load only files you trust: TorchScript is code."""
    pos_scale: float
    """Factor on position errors (rad or m) at the network's input."""
    vel_scale: float
    """Factor on velocities (rad/s or m/s) at the network's input."""
    torque_scale: float
    """Factor on the network's output, giving a force (N m or N)."""
    input_order: Literal["pos_vel", "vel_pos"] = "pos_vel"
    """Order of the input blocks."""
    history_length: int = 3
    """Number H of substeps in the network input, including the current one."""

    def validate(self) -> None:
        """See `ActuatorCfg`."""
        super().validate()
        check_one_of(self._label("input_order"), self.input_order, ("pos_vel", "vel_pos"))
        check_count(self._label("history_length"), self.history_length)

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> LearnedMlpActuator:
        """See `ActuatorCfg`."""
        return LearnedMlpActuator(self, entity, target_ids, target_names)


class LearnedMlpActuator(DcMotorActuator[LearnedMlpActuatorCfg]):
    """Force = dc_motor_clip(torque_scale * network(inputs)).

    With e = p* - l, the inputs of a joint are [pos_scale (e_t, .., e_{t-H+1}), vel_scale (l'_t, ..,
    l'_{t-H+1})], newest first, with blocks swapped for `input_order="vel_pos"`. The network input has
    one row per joint and environment, (N n, 2 H); its output is (N n, 1) or (N n,). The first values
    after a reset fill the whole history. Velocity and effort targets are not used.
    """

    _transient = {"network"}

    def __init__(
        self,
        cfg: LearnedMlpActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """See `Actuator`. Raises `FileNotFoundError` if the network file does not exist."""
        super().__init__(cfg, entity, target_ids, target_names)
        if not Path(cfg.network_file).is_file():
            raise FileNotFoundError(
                f"{type(cfg).__name__} for {cfg.target_names_expr}: network_file "
                f"{cfg.network_file!r} not found; save one with "
                "torch.jit.script(network).save(path)."
            )
        self.network: Any = None
        """TorchScript network. None before `initialize`."""
        self._history: CircularBuffer | None = None

    def initialize(self, mj_model: mujoco.MjModel, model: Any, data: Any, device: str) -> None:
        """See `DcMotorActuator`; also loads the network and checks its shapes.

        Raises:
            ValueError: the file is not TorchScript, or the network does not map (N n, 2 H) to
                (N n, 1).
        """
        super().initialize(mj_model, model, data, device)
        try:
            with warnings.catch_warnings():
                # Torch deprecates TorchScript, but existing network files use it.
                warnings.simplefilter("ignore", DeprecationWarning)
                self.network = torch.jit.load(self.cfg.network_file, map_location=device).eval()
        except RuntimeError as error:
            raise ValueError(
                f"network_file: expected a TorchScript file, got {self.cfg.network_file!r}; save "
                f"the network with torch.jit.script(network).save(path). ({error})"
            ) from error
        self._check_network()
        num_envs, num_targets = self.stiffness.shape
        self._history = CircularBuffer(self.cfg.history_length, num_envs, device)
        # The first append allocates the buffer; the reset marks all histories as empty.
        self._history.append(
            torch.zeros(num_envs, 2, num_targets, dtype=torch.float32, device=device)
        )
        self._history.reset()

    def compute(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Append command and feedback to the histories and return the forces, (N, n)."""
        self._buffer.append(self._frame(cmd))
        return self._force(cmd)

    def compute_after_reset(self, cmd: ActuatorCmd, env_ids: torch.Tensor | slice) -> torch.Tensor:
        """See `Actuator`. Fills the histories of `env_ids`; other histories are unchanged."""
        self._buffer.backfill(self._frame(cmd), env_ids)
        return self._force(cmd)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Reset delay buffers and histories of `env_ids`."""
        super().reset(env_ids)
        self._buffer.reset(env_ids)

    @property
    def _buffer(self) -> CircularBuffer:
        if self._history is None:
            raise WrongStateError(
                f"LearnedMlpActuator for {self._target_names} is not initialized."
            )
        return self._history

    def _frame(self, cmd: ActuatorCmd) -> torch.Tensor:
        """Return one substep of inputs, (N, 2, n)."""
        blocks = [
            self.cfg.pos_scale * (cmd.position_target - cmd.pos),
            self.cfg.vel_scale * cmd.vel,
        ]
        if self.cfg.input_order == "vel_pos":
            blocks.reverse()
        return torch.stack(blocks, dim=1)

    def _force(self, cmd: ActuatorCmd) -> torch.Tensor:
        # (N, H, 2, n), oldest first, to one row per joint, newest first.
        frames = self._buffer.buffer.flip(1).permute(0, 3, 2, 1)
        inputs = frames.reshape(-1, 2 * self.cfg.history_length)
        with torch.no_grad():
            output = self.network(inputs)
        force = self.cfg.torque_scale * output.reshape(cmd.pos.shape)
        return dc_motor_clip(
            force, self.saturation_effort, self.velocity_limit_motor, self.force_limit, cmd.vel
        )

    def _check_network(self) -> None:
        """Raise `ValueError` unless the network maps (N n, 2 H) to (N n, 1)."""
        num_rows, num_inputs = self.stiffness.numel(), 2 * self.cfg.history_length
        inputs = torch.zeros(
            num_rows, num_inputs, dtype=torch.float32, device=self.stiffness.device
        )
        message = (
            f"Network {self.cfg.network_file!r}: expected inputs ({num_rows}, {num_inputs}) (one row "
            f"per joint, 2 x history_length={self.cfg.history_length}) and outputs ({num_rows}, 1), got"
        )
        try:
            with torch.no_grad():
                output = self.network(inputs)
        except RuntimeError as error:
            raise ValueError(f"{message} an error: {error}") from error
        if output.numel() != num_rows:
            raise ValueError(f"{message} outputs {tuple(output.shape)}.")
