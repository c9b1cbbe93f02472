"""Imitation of a teacher that acts less and less itself (DAgger, Ross et al., arXiv 1011.0686).

rsl_rl's `Distillation` lets the student act from the first step. A task of several stages, such as
reaching, grasping and lifting, is then hardly seen: a fresh student drives the arm to where neither
it nor the teacher has been.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import Distillation
from tensordict import TensorDict

_STATE = "dagger_state_dict"


class DAgger(Distillation):
    """Distillation in which the teacher acts in a share of the environments, falling from 1 to 0.

    Each iteration samples these environments, so that the student errs for some steps at a time,
    and the teacher shows how to go on from there.
    """

    def __init__(self, *args: Any, teacher_iterations: int = 0, **kwargs: Any) -> None:
        """Build; the share falls linearly over `teacher_iterations`. 0: the student always acts."""
        super().__init__(*args, **kwargs)
        self._teacher_iterations = teacher_iterations

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Return the student's sampled actions, or the teacher's with the student's noise."""
        actions = super().act(obs)
        if self.teacher_share > 0.0:
            if self.storage.step == 0:
                draws = torch.rand(len(actions), 1, device=actions.device)
                self._is_driven = draws < self.teacher_share
            shown: Any = self.transition.privileged_actions
            actions += self._is_driven * (shown - self._raw_student.output_mean)
        return actions

    @property
    def teacher_share(self) -> float:
        """Share of the environments in which the teacher acts."""
        if self.num_updates >= self._teacher_iterations:
            return 0.0
        return 1.0 - self.num_updates / self._teacher_iterations

    def update(self) -> dict[str, float]:
        """Update the student with the collected steps."""
        return {"teacher_share": self.teacher_share, **super().update()}

    def save(self) -> dict[str, Any]:
        """Return the networks, the optimizer and the number of updates."""
        return {**super().save(), _STATE: {"num_updates": self.num_updates}}

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load the parts in `load_cfg`; None: all, or only the teacher if that is all there is."""
        if load_cfg is None and _STATE in loaded_dict:
            self.num_updates = loaded_dict[_STATE]["num_updates"]
        return super().load(loaded_dict, load_cfg, strict)
