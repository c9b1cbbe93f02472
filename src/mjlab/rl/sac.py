"""Soft actor-critic for thousands of environments, learning concurrently with the physics.

The algorithm of Haarnoja et al. (arXiv 1812.05905), with changes for massively parallel simulation
(FastSAC, Seo et al., arXiv 2512.01996; FlashSAC, arXiv 2604.04539): large batches, layer
normalization, distributional critics, low initial exploration noise, and noise held for several steps.

On the CPU one core steps the physics while another learns, in lock step: the updates of an environment
step use the transitions stored before it started, and the actions of the next step wait for them. The
same seed gives the same weights, bit for bit, independent of the speed of the cores.
"""

from __future__ import annotations

import copy
import math
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import fields
from typing import TYPE_CHECKING, Any, cast

import torch
from rsl_rl.env import VecEnv
from rsl_rl.utils import (
    reduce_gradients_in_buckets,
    resolve_callable,
    resolve_class,
    resolve_obs_groups,
)
from tensordict import TensorDict
from torch import nn

from mjlab.envs.mdp.actions import JointPositionAction
from mjlab.rl.config import RslRlSacAlgorithmCfg
from mjlab.rl.replay import ReplayStorage
from mjlab.rl.sac_models import SacActorModel, TwinCriticModel
from mjlab.rl.schedule import Schedule
from mjlab.utils.errors import UserError, check_field
from mjlab.utils.memory import check_memory

if TYPE_CHECKING:
    from mjlab.rl.vecenv_wrapper import RslRlVecEnvWrapper

# Range of scaled returns if `value_range` is None.
_SCALED_RANGE = (-5.0, 5.0)
# Loadable parts of a checkpoint.
_PARTS = ("actor", "critic", "optimizer", "iteration")


class SAC:
    """Soft actor-critic, with the interface of rsl_rl's algorithms.

    `act` and `process_env_step` are called once per environment step. `update` only returns the
    metrics since its last call.
    """

    takes_final_observations = True
    rnd = None

    def __init__(
        self,
        actor: SacActorModel,
        critic: TwinCriticModel,
        storage: ReplayStorage,
        env: VecEnv,
        cfg: RslRlSacAlgorithmCfg,
        *,
        device: str = "cpu",
        multi_gpu_cfg: dict | None = None,
        grad_reduce_bucket_mb: float = 25,
    ) -> None:
        """Set up from networks, replay buffer, environments and settings.

        Raises:
            ValueError: settings are inconsistent.
        """
        self.cfg, self.device, self.storage = cfg, device, storage
        self.actor, self.critic = actor.to(device), critic.to(device)
        self._raw_actor, self._raw_critic = self.actor, self.critic
        # The acting policy, exposed by `get_policy`, changes only between environment steps.
        self._policy = copy.deepcopy(self.actor).requires_grad_(False)
        self._target = copy.deepcopy(self.critic).requires_grad_(False)
        self._log_alpha = nn.Parameter(torch.tensor(math.log(cfg.init_alpha), device=device))
        # The fused optimizer takes a quarter of the time. The decay of second moments is faster than
        # usual, because targets move (arXiv 2512.01996).
        self.optimizer = torch.optim.AdamW(
            [
                {"params": list(self.critic.parameters())},
                {"params": list(self.actor.parameters())},
                {"params": [self._log_alpha], "weight_decay": 0.0},
            ],
            betas=(0.9, 0.95),
            weight_decay=cfg.weight_decay,
            fused=True,
        )
        self._rate_factor = Schedule(
            "RslRlSacAlgorithmCfg.learning_rate_factor", cfg.learning_rate_factor
        )
        # Replay buffer, critics and teacher have shares of the bounds, in (-1, 1).
        self._bounds = actor.distribution.bounds
        self._teacher = _Teacher(cfg, self._bounds)
        symmetry, self._env = cfg.symmetry_cfg, env
        self._mirror = resolve_callable(symmetry["data_augmentation_func"]) if symmetry else None
        transition = storage.num_bytes // ((cfg.replay_steps + 1) * env.num_envs)
        check_memory(
            "SAC batch_size times num_updates", cfg.batch_size * cfg.num_updates, transition, device,
            "a smaller batch_size",
        )  # fmt: skip
        lowest, highest = cfg.alpha_range
        check_field(cfg, "alpha_range", lowest <= highest, "low <= high")
        is_whole = not symmetry or cfg.batch_size % 2 == 0
        check_field(cfg, "batch_size", is_whole, "an even number, because half is mirrored")
        self._multi_gpu, self._bucket_mb = multi_gpu_cfg, grad_reduce_bucket_mb

        self._generator = torch.Generator(device=device)
        self._generator.manual_seed(torch.initial_seed() % 2**63)
        self._noise = _HeldNoise(env.num_envs, env.num_actions, cfg.noise_hold, device)
        scales = cfg.value_range is None
        self._reward_scale = _ReturnScale(env.num_envs, cfg.gamma, device) if scales else None
        self._num_steps = self._num_updates_made = 0
        self._set_learning_rates()
        self._actions = torch.zeros(env.num_envs, env.num_actions, device=device)
        self._started = False
        # Metrics of the updates in progress, and of finished ones.
        self._metrics: list[dict[str, torch.Tensor]] = []
        self._finished: list[dict[str, torch.Tensor]] = []
        self._thread: ThreadPoolExecutor | None = None
        self._running: Future[None] | None = None
        self._is_ending = False
        self._is_concurrent = multi_gpu_cfg is None and torch.device(device).type == "cpu"
        # For the acting thread. More threads would wait for those of the physics.
        self.num_threads = 1 if self._is_concurrent else None

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict, device: str) -> SAC:
        """Build networks and replay buffer from a `RslRlOffPolicyRunnerCfg` as a dict."""
        alg_class, further = resolve_class(cfg["algorithm"])
        # Subclasses receive further settings as keyword arguments.
        own = {field.name for field in fields(RslRlSacAlgorithmCfg)} & further.keys()
        alg_cfg = RslRlSacAlgorithmCfg(**{name: further.pop(name) for name in own})
        actor_class, actor_cfg = resolve_class(cfg["actor"])
        critic_class, critic_cfg = resolve_class(cfg["critic"])
        cfg["obs_groups"] = resolve_obs_groups(obs, cfg["obs_groups"], ["actor", "critic"])
        distribution = actor_cfg.get("distribution_cfg")
        if distribution and alg_cfg.action_bounds == "joint_ranges":
            bounds = joint_range_bounds(cast("RslRlVecEnvWrapper", env))
            actor_cfg = {**actor_cfg, "distribution_cfg": {"bounds": bounds, **distribution}}
        actor = actor_class(obs, cfg["obs_groups"], "actor", env.num_actions, **actor_cfg)
        critic = critic_class(
            obs,
            cfg["obs_groups"],
            "critic",
            env.num_actions,
            num_atoms=alg_cfg.num_atoms,
            value_range=alg_cfg.value_range or _SCALED_RANGE,
            **critic_cfg,
        )
        if not isinstance(actor, SacActorModel):
            raise ValueError(
                f"agent.actor class_name: expected a SacActorModel, got {type(actor).__name__}."
            )
        groups = list(dict.fromkeys([*actor.obs_groups, *critic.obs_groups]))
        if (teacher := alg_cfg.teacher) is not None:
            shape = tuple(obs[teacher].shape[1:]) if teacher in obs else ()
            if len(shape) != 1 or shape[0] % env.num_actions or not shape[0]:
                raise ValueError(
                    f"SAC teacher: expected an observation group with {env.num_actions} actions, and "
                    f"rows of as many values, got {teacher!r} of shape {shape or None}. Available: "
                    f"{sorted(obs.keys())}."
                )
            groups.append(teacher)
        storage = ReplayStorage(alg_cfg.replay_steps, obs.to(device), groups, env.num_actions)
        multi_gpu = cfg["multi_gpu"]
        return alg_class(
            actor, critic, storage, env, alg_cfg, device=device, multi_gpu_cfg=multi_gpu, **further
        )

    # Acting.

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Return actions with exploration noise, (N, A)."""
        if not self._started:
            self.storage.start(obs)
            if self._multi_gpu is not None:
                # A checkpoint has the state of the first process, but each process samples different
                # batches.
                self._generator.manual_seed(int(torch.randint(2**62, ())))
            self._started = True
        distribution = self._policy.distribution
        distribution.update(self._policy.mlp(self._policy.get_latent(obs)))
        noise = self._noise.draw()
        self._actions = distribution.share_of(noise)
        if self._num_steps < self.cfg.teacher_steps:
            noise = distribution.std * noise
            self._actions = self._teacher.act(obs, noise, self._actions)
        return self._bounds * self._actions

    def process_env_step(
        self, obs: TensorDict, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        """Store a step, update the acting policy, and start the next updates."""
        self._wait()
        # Tensors created in the rollout's inference mode could not be modified outside it.
        with torch.inference_mode(False), torch.no_grad():
            self.storage.add(
                self._actions,
                rewards,
                dones,
                extras.get("time_outs"),
                obs,
                extras.get("final_ids"),
                extras.get("final_observations"),
            )
            for model in (self.actor, self.critic):
                model.update_normalization(obs)
            if self._reward_scale is not None:
                self._reward_scale.update(rewards, dones, together=self._multi_gpu is not None)
            # Average the parameters of the acting policy; copy its observation statistics.
            newest = self.cfg.policy_average
            if newest < 1.0:
                # At smaller rates, weights move less per step: average over more steps.
                newest *= min(self._rate_factor.at(self._num_steps), 1.0)
            for own, learned in zip(
                self._policy.parameters(), self.actor.parameters(), strict=True
            ):
                own.lerp_(learned, newest)
            for own, learned in zip(self._policy.buffers(), self.actor.buffers(), strict=True):
                own.copy_(learned)
        self._num_steps += 1
        if self._num_steps < self.cfg.learning_starts:
            return
        if self._is_concurrent:
            if self._thread is None:
                self._thread = ThreadPoolExecutor(1, "learner", lambda: torch.set_num_threads(1))
            self._running = self._thread.submit(self._learn)
            return
        with torch.inference_mode(False), torch.enable_grad():
            self._learn()

    def compute_returns(self, obs: TensorDict) -> None:
        """Do nothing: SAC does not use returns of whole rollouts."""

    def update(self) -> dict[str, float]:
        """Return the mean metrics over the updates finished since the last call."""
        metrics, self._finished = self._finished, []
        # The runner checks the weights.
        self._wait()
        return {
            name: torch.stack([one[name] for one in metrics if name in one]).mean().item()
            for name in sorted(set().union(*metrics))
        }

    # Learning.

    def _learn(self) -> None:
        """Make the updates of one environment step, from one sample of the replay buffer."""
        self._set_learning_rates()
        cfg, parts = self.cfg, 1 if self._mirror is None else 2
        size = cfg.num_updates * cfg.batch_size // parts
        batch = self.storage.sample(size, cfg.gamma, cfg.num_steps_return, self._generator)
        before, after, actions = batch.observations, batch.next_observations, batch.actions
        returns, discounts, weights = batch.returns, batch.discounts, batch.weights
        if self._reward_scale is not None:
            returns = returns * self._reward_scale.factor
        if self._mirror is not None:
            actions = self._bounds * actions
            before, actions = self._mirror(env=self._env, obs=before, actions=actions)
            actions = actions / self._bounds
            after, _ = self._mirror(env=self._env, obs=after, actions=None)
            returns, discounts, weights = (
                value.repeat(2) for value in (returns, discounts, weights)
            )
        with torch.no_grad():
            inputs = {
                "actor": self.actor.get_latent(before),
                "critic": self.critic.get_latent(before),
                "next_actor": self.actor.get_latent(after),
                "next_critic": self.critic.get_latent(after),
                "actions": actions,
                "returns": returns,
                "discounts": discounts,
                "weights": weights,
            }
        if self._teacher.weight(self._num_steps) > 0.0:
            inputs["teacher"] = before[self._teacher.group]
        # Each update has transitions together with their mirrored copies.
        for rows in torch.arange(size * parts, device=self.device).view(
            parts, cfg.num_updates, -1
        ).transpose(0, 1).flatten(1):  # fmt: skip
            if self._is_ending:
                break
            self._update({name: value[rows] for name, value in inputs.items()})

    def _set_learning_rates(self) -> None:
        cfg, factor = self.cfg, self._rate_factor.at(self._num_steps)
        rates = (
            factor * cfg.critic_learning_rate,
            factor * cfg.actor_learning_rate,
            cfg.alpha_learning_rate,
        )
        for group, rate in zip(self.optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        self.learning_rate = rates[1]

    def _update(self, inputs: dict[str, torch.Tensor]) -> None:
        self.optimizer.zero_grad(set_to_none=True)
        metrics = self._critic_gradients(inputs)
        self._num_updates_made += 1
        if self._num_updates_made % self.cfg.policy_delay == 0:
            metrics |= self._actor_gradients(inputs)
        if self._multi_gpu is not None:
            parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
            reduce_gradients_in_buckets(parameters, self._multi_gpu["world_size"], self._bucket_mb)
        self.optimizer.step()
        with torch.no_grad():
            self._log_alpha.clamp_(*map(math.log, self.cfg.alpha_range))
            for target, source in zip(
                self._target.parameters(), self.critic.parameters(), strict=True
            ):
                target.lerp_(source, self.cfg.tau)
        self._metrics.append(metrics)

    def _critic_gradients(self, inputs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Add the gradients of both critics for y = R + discount (Q'(s', a') - alpha log p(a' | s'))."""
        with torch.no_grad(), self._autocast():
            actions, log_prob = self._sample(inputs["next_actor"])
            values = self._target.values(inputs["next_critic"], actions)
            value = values.amin(dim=0) if self.cfg.pessimistic else values.mean(dim=0)
            value = value - self._log_alpha.exp() * log_prob
            target = inputs["returns"] + inputs["discounts"] * value
            expected = self.critic.distribution_of(target)
        with self._autocast():
            logits = self.critic.logits(inputs["critic"], inputs["actions"])
        losses = [-(expected * torch.log_softmax(one, dim=-1)).sum(dim=-1) for one in logits]
        loss = sum((loss * inputs["weights"]).mean() for loss in losses)
        assert isinstance(loss, torch.Tensor)
        loss.backward()
        # Mass in the end atoms indicates that the range of values is too narrow.
        ends = expected[:, 0] + expected[:, -1]
        return {
            "critic": loss.detach(),
            "value": target.mean(),
            "value_at_range_end": ends.mean(),
        }

    def _actor_gradients(self, inputs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Add the gradients of the policy, which maximizes Q(s, a) - alpha log p(a | s), and of alpha."""
        with self._autocast():
            actions, log_prob = self._sample(inputs["actor"])
            values = self.critic.values(inputs["critic"], actions)
        value = values.amin(dim=0) if self.cfg.pessimistic else values.mean(dim=0)
        loss = (self._log_alpha.exp().detach() * log_prob - value).mean()
        distribution = self.actor.distribution
        # Critics are inaccurate for rarely tried actions. Without this penalty, actions of joints with
        # little effect drift to their bounds, where the gradient of tanh vanishes.
        loss = loss + self.cfg.mean_penalty * distribution.params[0].square().sum(dim=-1).mean()
        metrics = {}
        if "teacher" in inputs:
            # On states that the policy visits (DAgger; Ross et al., arXiv 1011.0686).
            mean = torch.tanh(distribution.params[0])
            distance = self._teacher.distance(inputs["teacher"], mean)
            loss = loss + self._teacher.weight(self._num_steps) * distance
            metrics["imitation"] = distance.detach()
        entropy = distribution.entropy.detach().mean()
        # Entropy per action of a Gaussian with standard deviation `target_std`.
        target = math.log(self.cfg.target_std * math.sqrt(2 * math.pi * math.e))
        alpha_loss = self._log_alpha.exp() * (entropy - distribution.output_dim * target)
        # Gradients of the critic come from the critic loss only.
        loss.backward(inputs=list(self.actor.parameters()))
        alpha_loss.backward()
        return metrics | {
            "actor": loss.detach(),
            "entropy": entropy,
            "alpha": self._log_alpha.detach().exp(),
            "saturated_actions": (actions.detach().abs() > 0.95).float().mean(),
        }

    def _sample(self, latent: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        distribution = self.actor.distribution
        distribution.update(self.actor.mlp(latent))
        noise = torch.randn(
            (len(latent), distribution.output_dim), generator=self._generator, device=self.device
        )
        return distribution.share_and_log_prob(noise)

    def _autocast(self) -> torch.autocast:
        kind = torch.device(self.device).type
        return torch.autocast(kind, torch.bfloat16, enabled=self.cfg.use_mixed_precision)

    def _wait(self) -> None:
        """Wait for the updates in progress; raise their errors."""
        if self._running is not None:
            try:
                self._running.result()
            finally:
                # A signal may have ended the waiting instead.
                if self._running.done():
                    self._running = None
        self._finished += self._metrics
        self._metrics = []

    def _end_updates(self) -> None:
        """End the updates in progress early, for a state that replaces theirs."""
        if self._running is not None:
            self._is_ending = True
            wait([self._running])
            self._running, self._is_ending = None, False

    # Modes, files, processes.

    def train_mode(self) -> None:
        """Enable updates of observation statistics."""
        self.actor.train()
        self.critic.train()

    def eval_mode(self) -> None:
        """Finish the updates of the last step, and freeze observation statistics."""
        self._wait()
        self.actor.eval()
        self.critic.eval()

    def close(self) -> None:
        """End the updates and their thread; the next step starts a new thread."""
        self._end_updates()
        if self._thread is not None:
            self._thread.shutdown()
            self._thread = None

    def get_policy(self) -> SacActorModel:
        """Return the acting policy."""
        return self._policy

    def save(self) -> dict[str, Any]:
        """Return all weights and states except the replay buffer, as plain data."""
        self._wait()
        return {
            "actor_state_dict": self._policy.state_dict(),
            "critic_state_dict": self.critic.state_dict(),
            "optimizer_state_dict": self.optimizer.state_dict(),
            "sac_state_dict": {
                "actor": self.actor.state_dict(),
                "target": self._target.state_dict(),
                "log_alpha": self._log_alpha.detach(),
                "noise": self._noise.state_dict(),
                "reward_scale": self._reward_scale.state_dict() if self._reward_scale else None,
                "generator": self._generator.get_state(),
                "num_steps": self._num_steps,
                "num_updates": self._num_updates_made,
            },
        }

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load the parts in `load_cfg` (`actor`, `critic`, `optimizer`, `iteration`). None: all.

        Returns True if the iteration count is to be loaded.
        """
        self._end_updates()
        cfg = dict.fromkeys(_PARTS, True) if load_cfg is None else load_cfg
        if cfg.get("actor"):
            for model in (self.actor, self._policy):
                model.load_state_dict(loaded_dict["actor_state_dict"], strict=strict)
        if cfg.get("critic"):
            for model in (self.critic, self._target):
                model.load_state_dict(loaded_dict["critic_state_dict"], strict=strict)
        if cfg.get("optimizer"):
            self.optimizer.load_state_dict(loaded_dict["optimizer_state_dict"])
        if load_cfg is None:
            state = loaded_dict["sac_state_dict"]
            self.actor.load_state_dict(state["actor"])
            self._target.load_state_dict(state["target"])
            with torch.no_grad():
                self._log_alpha.copy_(state["log_alpha"])
            # Generators of CPUs and GPUs have states of other sizes.
            if state["generator"].shape == self._generator.get_state().shape:
                self._generator.set_state(state["generator"].cpu())
            self._num_steps, self._num_updates_made = state["num_steps"], state["num_updates"]
            self._noise.load_state_dict(state["noise"])
            if self._reward_scale is not None and state["reward_scale"] is not None:
                self._reward_scale.load_state_dict(state["reward_scale"])
        self._set_learning_rates()
        return cfg.get("iteration", False)

    def override(self, name: str, value: Any) -> None:
        """Set a setting that `load` restored: weight decay, alpha, or the seed.

        Settings with which the algorithm was built, such as learning rates, act already.

        Raises:
            UserError: bounds of actions, which the policy was trained with.
        """
        if name == "action_bounds":
            raise UserError(
                "--agent.algorithm.action-bounds: expected those that the policy was trained with, got "
                f"{value!r}; leave it out, or train a new run."
            )
        if name == "weight_decay":
            for group in self.optimizer.param_groups[:2]:
                group[name] = float(value)
        elif name == "init_alpha":
            with torch.no_grad():
                self._log_alpha.fill_(math.log(value))
        elif name == "seed":
            self._generator.manual_seed(value)

    def broadcast_parameters(self) -> None:
        """Broadcast the weights of the first process to all processes."""
        for model in (self.actor, self.critic, self._policy, self._target):
            for tensor in model.state_dict().values():
                torch.distributed.broadcast(tensor, src=0)


def joint_range_bounds(env: RslRlVecEnvWrapper) -> list[float]:
    """Return the actions that reach the ends of the joint ranges, (A,).

    For joint position actions, max |q_end - q_default| / scale over both ends of the range, as FastSAC
    (Seo et al., arXiv 2512.01996), at least 1: targets beyond the end let a finger press. 1 for other
    actions, and for joints without a range. At most the environment's `clip_actions`.
    """
    bounds = []
    manager = env.unwrapped.action_manager
    for term in (manager.get_term(name) for name in manager.active_terms):
        own = torch.ones(term.action_dim)
        if isinstance(term, JointPositionAction):
            limits = env.unwrapped.scene[term.cfg.entity_name].data.default_joint_pos_limits
            low, high = limits[:, term.target_ids].unbind(dim=2)
            reach = torch.maximum(high - term.offset, term.offset - low) / abs(term.scale)
            own = torch.where(reach.isfinite(), reach, 1.0).amax(dim=0)
        bounds += own.tolist()
    largest = math.inf if env.clip_actions is None else env.clip_actions
    return [min(max(bound, 1.0), largest) for bound in bounds]


class _HeldNoise:
    """Standard normal noise (N, A), held for k steps per environment.

    k has a Zipf distribution, P(k) ~ 1 / k^2 up to a maximum k (FlashSAC, arXiv 2604.04539). Noise
    resampled at every step averages out before a leg has moved.
    """

    def __init__(self, num_envs: int, num_actions: int, longest: int, device: str) -> None:
        check_memory("SAC noise_hold", longest, 8, device, "a shorter one")
        self._noise = torch.zeros(num_envs, num_actions, device=device)
        self._steps_left = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._chances = 1.0 / torch.arange(1, longest + 1, device=device).square()

    def draw(self) -> torch.Tensor:
        due = self._steps_left == 0
        fresh = torch.randn_like(self._noise)
        torch.where(due[:, None], fresh, self._noise, out=self._noise)
        steps = 1 + torch.multinomial(self._chances, len(due), replacement=True)
        self._steps_left = torch.where(due, steps, self._steps_left) - 1
        return self._noise

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"noise": self._noise, "steps_left": self._steps_left}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        if all(state[n].shape == value.shape for n, value in self.state_dict().items()):
            self._noise = state["noise"].to(self._noise.device).clone()
            self._steps_left = state["steps_left"].to(self._noise.device).clone()


class _ReturnScale:
    """Reward factor that scales discounted returns to a standard deviation of 1, within the range.

    1 / max(std(G), max|G| / 5), over all running returns G of the environments so far (SimbaV2, Lee et
    al., arXiv 2502.15280).
    """

    def __init__(self, num_envs: int, gamma: float, device: str) -> None:
        self._gamma = gamma
        self._returns = torch.zeros(num_envs, device=device)
        self._count, self._mean, self._sum = (torch.zeros((), device=device) for _ in range(3))
        self._largest = torch.zeros((), device=device)
        self.factor = torch.ones((), device=device)

    def update(self, rewards: torch.Tensor, dones: torch.Tensor, together: bool) -> None:
        """Update with a step; `together`: use the same factor in all processes."""
        self._returns = rewards + self._gamma * self._returns
        count = self._count + len(rewards)
        shift = self._returns.mean() - self._mean
        within = (self._returns - self._returns.mean()).square().sum()
        self._sum = self._sum + within + shift.square() * self._count * len(rewards) / count
        self._mean = self._mean + shift * len(rewards) / count
        self._count = count
        self._largest = torch.maximum(self._largest, self._returns.abs().max())
        deviation = (self._sum / count).sqrt()
        scale = torch.maximum(deviation, self._largest / _SCALED_RANGE[1]).clamp(min=1e-6)
        if together:
            torch.distributed.all_reduce(scale, op=torch.distributed.ReduceOp.MAX)
        self.factor = 1.0 / scale
        self._returns = torch.where(dones.bool(), 0.0, self._returns)

    def state_dict(self) -> dict[str, torch.Tensor]:
        names = ("_returns", "_count", "_mean", "_sum", "_largest", "factor")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        for name, value in state.items():
            own = getattr(self, name)
            if value.shape == own.shape:
                setattr(self, name, value.to(own.device).clone())


class _Teacher:
    """Controller that acts at first, and is imitated by the policy.

    The observation group `group` holds its actions a*, and may hold a matrix W, row by row: effects of actions,
    such as the motion of a hand. Values of a* outside the bounds leave the policy free.
    """

    def __init__(self, cfg: RslRlSacAlgorithmCfg, bounds: torch.Tensor) -> None:
        self._weight = Schedule("RslRlSacAlgorithmCfg.imitation", cfg.imitation)
        has_weight = any(weight for _, weight in cfg.imitation)
        if cfg.teacher is None and (cfg.teacher_steps > 0 or has_weight):
            raise ValueError(
                f"SAC teacher_steps, imitation: expected 0 without a teacher, got {cfg.teacher_steps} "
                f"and {cfg.imitation}; set teacher to the observation group with its actions."
            )
        self.group, self._bounds = cfg.teacher, bounds

    def act(self, obs: TensorDict, noise: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Return the controller's actions with `noise` before tanh, `actions` for free ones.

        Actions are shares of the bounds.
        """
        shown: Any = obs[self.group][:, : actions.shape[1]] / self._bounds
        near = torch.tanh(torch.atanh(shown) + noise)
        return torch.where(shown.abs() < 1.0, near, actions)

    def weight(self, num_steps: int) -> float:
        """Return the weight of `distance` after `num_steps` environment steps."""
        return self._weight.at(num_steps)

    def distance(self, shown: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        """Return the mean of |d|^2 + |W b d|^2, d = a - a* / b, of `mean` a (B, A) from the group's `shown` (B, .).

        a are shares of the bounds b.
        """
        size = mean.shape[1]
        action = shown[:, :size] / self._bounds
        difference = torch.where(action.abs() < 1.0, mean - action, 0.0)
        matrix = shown[:, size:].unflatten(1, (shown.shape[1] // size - 1, size))  # (B, m, A)
        effects = matrix @ (self._bounds * difference).unsqueeze(2)
        return torch.cat((difference, effects.squeeze(2)), dim=1).square().sum(dim=-1).mean()
