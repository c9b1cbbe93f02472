"""Training configs, passed to rsl_rl as dicts (`dataclasses.asdict`)."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

from mjlab.compat import accepts_older_fields
from mjlab.utils.ranges import (
    Count,
    CountOrZero,
    Fraction,
    Limit,
    Number,
    Positive,
    Range,
    Weight,
)
from mjlab.utils.screen import shown

TorchCompileMode = Literal["default", "max-autotune-no-cudagraphs"]
"""Modes of `torch.compile` supported by rsl_rl's algorithms."""


def gaussian_distribution(init_std: float = 1.0) -> dict[str, Any]:
    """Return a `distribution_cfg`: Gaussian with one learned standard deviation per action."""
    return {"class_name": "GaussianDistribution", "init_std": init_std, "std_type": "scalar"}


def bounded_gaussian(bound: float, init_std: float = 1.0) -> dict[str, Any]:
    """Return a `distribution_cfg`: Gaussian; without exploration, actions are clipped to [-bound, bound]."""
    gaussian = gaussian_distribution(init_std)
    return {**gaussian, "class_name": "mjlab.rl.bounded_gaussian:BoundedGaussian", "bound": bound}


def squashed_gaussian(init_std: float = 0.15, log_std_max: float = 0.0) -> dict[str, Any]:
    """Return a `distribution_cfg`: tanh-squashed Gaussian with state-dependent standard deviations."""
    return {
        "class_name": "mjlab.rl.sac_models:SquashedGaussian",
        "init_std": init_std,
        "log_std_range": (-5.0, log_std_max),
    }


@accepts_older_fields
@dataclass
class RslRlModelCfg:
    """Network config: actor or critic."""

    hidden_dims: Annotated[tuple[int, ...], Range(-1)] = field(
        default=(128, 128, 128), metadata=shown("learning", "[N,...]")
    )
    """Width of each hidden layer; -1: that of the input."""
    activation: str = "elu"
    """Activation function between layers (rsl_rl's name: `elu`, `relu`, `tanh`, ...)."""
    obs_normalization: bool = False
    """Normalize observations by their running mean and standard deviation."""
    cnn_cfg: dict[str, Any] | None = None
    """Image encoder settings, for models with an encoder."""
    distribution_cfg: dict[str, Any] | None = None
    """Output distribution, e.g. `{"class_name": "GaussianDistribution", "init_std": 1.0,
    "std_type": "scalar"}`. None: deterministic output."""
    rnn_type: str | None = None
    """RNN type, `lstm` or `gru` (with `class_name="RNNModel"`)."""
    rnn_hidden_dim: CountOrZero = 256
    """Size of the hidden state."""
    rnn_num_layers: CountOrZero = 1
    """Number of recurrent layers."""
    class_name: str = "MLPModel"
    """rsl_rl class name, or `module:Class`."""


@dataclass
class RslRlPpoAlgorithmCfg:
    """Proximal policy optimization."""

    num_learning_epochs: Count = 5
    """Number of epochs per iteration."""
    num_mini_batches: Count = 4
    """Number of mini-batches per epoch."""
    learning_rate: Positive = field(default=1e-3, metadata=shown("learning", "X"))
    """Learning rate; the initial value under the adaptive schedule."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """Learning rate schedule: `adaptive` keeps the KL divergence of updates near `desired_kl`."""
    gamma: Fraction = 0.99
    """Discount factor per environment step."""
    lam: Fraction = 0.95
    """Parameter lambda of generalized advantage estimation (GAE)."""
    entropy_coef: Annotated[float, Range(ends="()")] = field(
        default=0.005, metadata=shown("learning", "X")
    )
    """Weight of the entropy bonus; negative: a penalty."""
    desired_kl: Limit = 0.01
    """Target KL divergence per update, for the adaptive schedule."""
    max_grad_norm: Limit = 1.0
    """Maximum gradient norm; larger gradients are rescaled."""
    value_loss_coef: Weight = 1.0
    """Weight of the value loss."""
    use_clipped_value_loss: bool = True
    """Clip the value loss, as the policy loss."""
    clip_param: Limit = 0.2
    """Clipping range of the probability ratio in the policy loss."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalize advantages per mini-batch instead of over all data."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Optimizer."""
    share_cnn_encoders: bool = False
    """Share image encoders between actor and critic."""
    symmetry_cfg: dict[str, Any] | None = field(default=None, kw_only=True)
    """Symmetry augmentation, in rsl_rl's format: `{"data_augmentation_func": "module:function",
    "use_data_augmentation": True}`, e.g. with `mjlab.tasks.velocity.symmetry:mirror_left_right`.
    None: no augmentation."""
    use_mixed_precision: bool = field(default=False, kw_only=True)
    """Use mixed precision in updates (bfloat16 networks)."""
    class_name: str = "PPO"
    """rsl_rl class name, or `module:Class`."""


@dataclass
class RslRlSacAlgorithmCfg:
    """Soft actor-critic with distributional critics and a replay buffer (`mjlab.rl.sac`).

    The defaults are FastSAC's (Seo et al., arXiv 2512.01996), reduced for a few CPU cores.
    """

    action_bounds: Literal["scale", "joint_ranges"] = "scale"
    """Bounds of the actions. `scale`: -1 and 1, one action scale from the default joint position.
    `joint_ranges`: joint position targets reach both ends of each joint's range, and one scale at
    least; other actions as `scale`. A resumed policy keeps its bounds."""
    batch_size: Count = field(default=2048, metadata=shown("learning", "N"))
    """Number of transitions per update, mirrored ones included."""
    num_updates: Count = field(default=4, metadata=shown("learning", "N"))
    """Number of updates per step of all environments. Times `batch_size`, divided by the number of
    environments, this is the replay ratio: the number of times a transition is used."""
    replay_steps: Count = 500
    """Capacity of the replay buffer, in steps per environment."""
    learning_starts: CountOrZero = 10
    """Number of environment steps before the first update."""
    gamma: Fraction = 0.97
    """Discount factor per environment step."""
    num_steps_return: Count = 1
    """Number n of rewards in n-step returns."""
    value_range: Annotated[tuple[float, float] | None, Range(ends="()")] = None
    """Range (low, high) of discounted returns that the critics represent. None: rewards are divided
    by the scale of the returns seen so far."""
    num_atoms: Annotated[int, Range(2)] = 101
    """Number of atoms of a critic's return distribution."""
    tau: Annotated[float, Range(0.0, 1.0, "(]")] = 0.05
    """Polyak coefficient of the target critics per update."""
    pessimistic: bool = False
    """Use the minimum of both critics instead of their mean."""
    policy_delay: Count = 4
    """Number of critic updates per policy update."""
    actor_learning_rate: Positive = field(default=3e-4, metadata=shown("learning", "X"))
    """Learning rate of the policy."""
    critic_learning_rate: Positive = 3e-4
    """Learning rate of the critics."""
    learning_rate_factor: Annotated[tuple[tuple[int, float], ...], Range(0.0, ends="[)")] = (
        (0, 1.0),
    )
    """Factor of both learning rates: points (environment step, factor), interpolated linearly."""
    weight_decay: Weight = 1e-3
    """Weight decay (AdamW)."""
    init_alpha: Positive = 1e-3
    """Initial entropy coefficient alpha."""
    alpha_learning_rate: Weight = 3e-4
    """Learning rate of log(alpha)."""
    alpha_range: Annotated[tuple[float, float], Range(0.0, ends="(]")] = (1e-5, 1.0)
    """Range (low, high) of alpha."""
    target_std: Positive = 0.15
    """Standard deviation per action, before tanh, that defines the target entropy."""
    mean_penalty: Weight = 0.01
    """Weight of the squared mean of each action, before tanh, in the policy loss. Keeps actions with
    little effect from drifting to their bounds."""
    teacher: str | None = None
    """Observation group with the actions of a controller for the policy to imitate, (N, actions), e.g.
    those of `stepping_action`. Values outside the bounds leave an action free. Further values are rows of a
    matrix, (N, rows x actions): its product with the distance of the actions counts as that does."""
    teacher_steps: CountOrZero = 0
    """Number of initial environment steps controlled by the teacher, with the policy's exploration."""
    imitation: Annotated[tuple[tuple[int, float], ...], Range(0.0, ends="[)")] = ((0, 0.0),)
    """Weight of the squared distance from the teacher's action in the policy loss: points
    (environment step, weight), interpolated linearly."""
    policy_average: Annotated[float, Range(0.0, 1.0, "(]")] = 1.0
    """Averaging coefficient per environment step, from the learned weights to those of the acting
    policy, times `learning_rate_factor` where that is below 1; 1: no averaging. An averaged policy
    falls less often than the newest one."""
    noise_hold: Count = 1
    """Maximum number of steps an environment keeps its exploration noise; 1: resample every step."""
    symmetry_cfg: dict[str, Any] | None = None
    """Symmetry augmentation, as for PPO: `{"data_augmentation_func": "module:function"}`. Half of
    each batch is mirrored."""
    use_mixed_precision: bool = False
    """Use mixed precision in updates (bfloat16 networks). Takes two thirds of the time on CPUs with
    AVX-512-bf16 or AMX."""
    save_replay: bool = True
    """Save the replay buffer next to the newest checkpoint. If False, the replay of a resumed run
    starts empty."""
    class_name: str = "mjlab.rl.sac:SAC"
    """rsl_rl class name, or `module:Class`."""


@dataclass
class RslRlDistillationAlgorithmCfg:
    """Imitation of a teacher on the states that the student visits (DAgger; arXiv 1011.0686)."""

    num_learning_epochs: Count = 1
    """Number of epochs per iteration."""
    gradient_length: Count = 8
    """Number of environment steps per update, and of backpropagation through time of a recurrent
    student. Should divide epochs times steps of an iteration: remaining steps are not used."""
    learning_rate: Positive = field(default=1e-3, metadata=shown("learning", "X"))
    """Learning rate."""
    max_grad_norm: Limit | None = 1.0
    """Maximum gradient norm; larger gradients are rescaled. None: unlimited."""
    loss_type: Literal["mse", "huber"] = "mse"
    """Loss between the actions of student and teacher. `huber` limits the influence of large actions,
    as a teacher's are where it has never been."""
    teacher_iterations: CountOrZero = 0
    """Number of iterations in which the teacher acts in some environments, a share that falls from 1 to
    0. 0: the student acts from the start."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Optimizer."""
    use_mixed_precision: bool = False
    """Use mixed precision in updates (bfloat16 networks)."""
    class_name: str = "mjlab.rl.dagger:DAgger"
    """rsl_rl class name, or `module:Class`."""


@dataclass
class EvaluationCfg:
    """Conditions of a solved task, success of an episode, and schedule of evaluations in training.

    The return of an episode is the sum of its weighted rewards BEFORE they are multiplied by the
    environment step: with rewards in [0, 1], an episode of 1000 steps has at most 1000.
    """

    # A solved task.
    solved_return: Number | None = None
    """Mean evaluation return required for a solved task. None without other conditions: evaluations
    with `trigger_return` only."""
    solved_below: Annotated[dict[str, float], Range()] = field(default_factory=dict)
    """Upper bounds of metrics by name; all must hold for the task to be solved, and `solved_return`
    may then be None. Names: those of `metrics`, `failure_rate`, `success_rate`, `mean_length`. Rates
    are judged by the center of their 95 % Wilson interval, so that few episodes prove little: 8
    failures in 200 count as 4.9 %, 0 in 4 as 24 %."""
    solved_above: Annotated[dict[str, float], Range()] = field(default_factory=dict)
    """Lower bounds of metrics by name, as `solved_below`."""
    stop_when_solved: bool = field(default=True, metadata=shown("learning", "False"))
    """Stop training once the task is solved and a second evaluation, on unused episodes, confirms
    it."""

    # Success of an episode.
    success: Number | str | None = None
    """Success of an episode: a minimum return; `survival`, no termination before the time limit; or
    `module:function`, a function `func(env) -> (num_envs,) bool`, read one step before the end, because the
    environment has reset when the last step returns. None: a return of `solved_return`."""

    # When to evaluate.
    trigger_fraction: Weight = 0.8
    """Fraction of `solved_return` that the mean reward of the training data, times the episode
    length, must reach before an evaluation. Saves time; below 1, because training explores."""
    trigger_return: Number | None = None
    """Return of the training data that triggers an evaluation, instead of `trigger_fraction`."""
    trigger_below: Annotated[dict[str, float], Range()] = field(default_factory=dict)
    """Upper bounds of `metrics` in the training environments that trigger an evaluation, together with
    the return if that is set: means over the environments of the first process after an iteration, with
    exploration."""
    min_interval: CountOrZero = 3
    """Minimum number of iterations between evaluations."""
    first_iteration: CountOrZero = 0
    """Minimum number of iterations before the first evaluation."""

    # Size and content of an evaluation.
    num_episodes: Count = 256
    """Number of episodes of an evaluation and of its confirmation; one per environment, with the
    deterministic policy."""
    metrics: dict[str, Callable[[Any], Any]] = field(default_factory=dict)
    """Metrics besides the return: `func(env) -> (num_envs,)` by name, averaged over the steps of an
    episode."""
    standing_still: dict[str, Callable[[Any], Any]] = field(default_factory=dict)
    """Values of `metrics` for a robot that stands still, by the metric's name and in the same form.
    Evaluations give the metric's share of it, `NAME_share`, which bounds may name."""
    units: dict[str, str] = field(default_factory=dict)
    """Units of `metrics` by name, shown beside their values."""

    @staticmethod
    def of(values: EvaluationCfg | Mapping[str, Any] | None) -> EvaluationCfg:
        """Return the config of a dict, such as that of a runner or a recorded one. None: the default."""
        if isinstance(values, EvaluationCfg):
            return values
        known = {field.name for field in fields(EvaluationCfg)}
        return EvaluationCfg(**{k: v for k, v in (values or {}).items() if k in known})

    @property
    def criterion(self) -> Callable[[Any], Any] | str | float | None:
        """Success of an episode: `success`, with a function for its name, or else `solved_return`."""
        return self.solved_return if self.success is None else resolve_success(self.success)

    @property
    def trigger(self) -> float | None:
        """Return of the training data, at full length, that triggers an evaluation. None: any."""
        trigger = self.trigger_return
        if trigger is None and self.solved_return is not None:
            trigger = self.trigger_fraction * self.solved_return
        return None if trigger == -math.inf else trigger

    def earliest_after(self, last: int) -> int:
        """Return the number of finished iterations from which an evaluation may follow that after `last`."""
        return max(last + self.min_interval, self.first_iteration)

    def is_triggered(
        self,
        mean_step_reward: float,
        episode_steps: float,
        exploring: Mapping[str, float] | None = None,
    ) -> bool:
        """Return True if the training data reach `trigger` and `trigger_below`.

        Args:
            mean_step_reward: Mean weighted reward per step.
            episode_steps: Length of an episode.
            exploring: Metrics of the training environments by name. A missing one is not below.
        """
        has_return = self.trigger is None or mean_step_reward * episode_steps >= self.trigger
        found = exploring or {}
        return has_return and all(
            found.get(name, math.inf) <= most for name, most in self.trigger_below.items()
        )


def resolve_success(success: Any) -> Any:
    """Return the success of an episode with the function for a name `module:function`.

    Raises:
        ValueError: another text than `survival`, or a function that cannot be imported.
    """
    if not isinstance(success, str) or success == "survival":
        return success
    module, _, name = success.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            "EvaluationCfg success: expected a return, `survival` or `module:function`, got "
            f"{success!r} ({error})."
        ) from error


@dataclass
class RslRlBaseRunnerCfg:
    """Training run config."""

    seed: Annotated[int, Range(-1, 2**32 - 1)] = 42
    """Seed of the run and its environments; -1 draws a seed, printed and recorded. Other processes
    of the run derive their seeds from it."""
    num_steps_per_env: Count = field(default=24, metadata=shown("learning", "N"))
    """Number of steps per environment and iteration."""
    max_iterations: CountOrZero = field(default=300, metadata=shown("run", "N"))
    """Total number of iterations; those before a resume count."""
    obs_groups: dict[str, tuple[str, ...]] = field(
        default_factory=lambda: {"actor": ("actor",), "critic": ("critic",)}
    )
    """Observation groups of each model, concatenated in this order."""
    save_interval: Count = field(default=50, metadata=shown("save", "N"))
    """Number of iterations between checkpoints."""
    experiment_name: str = "exp1"
    """Folder of the experiment, under the log root."""
    run_name: str = field(default="", metadata=shown("save", "TEXT"))
    """Suffix of the run folder's name, after the start time."""
    logger: Literal["wandb", "tensorboard"] = field(
        default="tensorboard", metadata=shown("save", "tensorboard|wandb")
    )
    """Logging service: `tensorboard` writes to the run folder only; `wandb` also uploads to
    Weights & Biases. (mjlab 1.6 uploads by default.)"""
    wandb_project: str = "mjlab"
    """Weights & Biases project."""
    wandb_tags: tuple[str, ...] = ()
    """Weights & Biases tags of the run."""
    resume: bool | Literal["auto"] = field(default=False, metadata=shown("resume", "True|auto"))
    """Resume from a checkpoint. `auto`: if there is one, else start a new run, as job scripts need."""
    load_run: str = field(default=".*", metadata=shown("resume", "REGEX"))
    """Run folder to resume from: regular expression; the newest match is used."""
    load_checkpoint: str = field(default="model_.*.pt", metadata=shown("resume", "REGEX"))
    """Checkpoint to resume from: regular expression; the newest match is used."""
    clip_actions: Limit | None = None
    """Bound c: actions are clipped to [-c, c] before the environment."""
    upload_model: bool = True
    """Upload checkpoints and exported policies to Weights & Biases."""
    save_git_diff: bool = field(default=True, kw_only=True)
    """Save the commit and the uncommitted changes of the task's repository in the run folder (`git/`)."""
    upload_git_diff: bool = field(default=False, kw_only=True)
    """Upload the git diff to Weights & Biases."""
    evaluation: EvaluationCfg = field(default_factory=EvaluationCfg, kw_only=True)
    """Conditions of a solved task, and evaluations during training."""


@dataclass
class RslRlOnPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """Training run with an on-policy algorithm."""

    class_name: str = "OnPolicyRunner"
    """Runner class, by rsl_rl's name."""
    actor: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution())
    )
    """Policy network."""
    critic: RslRlModelCfg = field(default_factory=RslRlModelCfg)
    """Value network."""
    algorithm: RslRlPpoAlgorithmCfg = field(default_factory=RslRlPpoAlgorithmCfg)
    """Learning algorithm."""
    torch_compile_mode: TorchCompileMode | None = field(default=None, kw_only=True)
    """Mode of `torch.compile` for the networks; compilation delays the start. None: no compilation."""
    annealing: Annotated[tuple[tuple[int, float], ...], Range(0.0, ends="[)")] = field(
        default=((0, 1.0),), kw_only=True
    )
    """Factor of the algorithm's `desired_kl` and `entropy_coef`: points (iteration, factor), interpolated
    linearly. Below 1, exploration fades and, with the adaptive schedule, updates get smaller: the success
    of a nearly solved task stops swinging between evaluations."""


@dataclass
class RslRlOffPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """Training run with an off-policy algorithm. Actions are bounded: `algorithm.action_bounds`."""

    actor: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(
            class_name="mjlab.rl.sac_models:SacActorModel",
            hidden_dims=(256, 128, 64),
            activation="swish",
            obs_normalization=True,
            distribution_cfg=squashed_gaussian(),
        )
    )
    """Policy network."""
    critic: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(
            class_name="mjlab.rl.sac_models:TwinCriticModel",
            hidden_dims=(256, 128, 64),
            activation="swish",
            obs_normalization=True,
        )
    )
    """Critic networks (both critics)."""
    algorithm: RslRlSacAlgorithmCfg = field(default_factory=RslRlSacAlgorithmCfg)
    """Learning algorithm."""


@dataclass
class RslRlDistillationRunnerCfg(RslRlBaseRunnerCfg):
    """Training run of a student that learns to imitate a trained teacher."""

    obs_groups: dict[str, tuple[str, ...]] = field(
        default_factory=lambda: {"student": ("actor",), "teacher": ("actor",)}
    )
    """Observation groups of each model, concatenated in this order."""
    class_name: str = "DistillationRunner"
    """Runner class, by rsl_rl's name."""
    student: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution(0.1))
    )
    """Policy network. Its standard deviation is that of the actions in training, and is constant."""
    teacher: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution())
    )
    """Teacher network, as trained. `train` takes its sizes and class from the teacher's run."""
    algorithm: RslRlDistillationAlgorithmCfg = field(default_factory=RslRlDistillationAlgorithmCfg)
    """Learning algorithm."""
    teacher_checkpoint: str | None = field(default=None, metadata=shown("learning", "FILE"))
    """Teacher checkpoint, trained with PPO. Not needed to resume a run."""
    torch_compile_mode: TorchCompileMode | None = None
    """Mode of `torch.compile` for the networks; compilation delays the start. None: no compilation."""
