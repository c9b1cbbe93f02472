"""Configs of a training run. They reach rsl_rl as dicts (`dataclasses.asdict`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from mjlab.compat import accepts_older_fields

TorchCompileMode = Literal["default", "max-autotune-no-cudagraphs"]
"""Modes of `torch.compile` that rsl_rl's algorithms can have."""


def gaussian_distribution(init_std: float = 1.0) -> dict[str, Any]:
    """Return a `distribution_cfg`: normal, with one learned deviation for each action."""
    return {"class_name": "GaussianDistribution", "init_std": init_std, "std_type": "scalar"}


def squashed_gaussian(init_std: float = 0.15, log_std_max: float = 0.0) -> dict[str, Any]:
    """Return a `distribution_cfg`: normal, through tanh, with deviations that the network gives."""
    return {
        "class_name": "mjlab.rl.sac_models:SquashedGaussian",
        "init_std": init_std,
        "log_std_range": (-5.0, log_std_max),
    }


@accepts_older_fields
@dataclass
class RslRlModelCfg:
    """A network: actor or critic."""

    hidden_dims: tuple[int, ...] = (128, 128, 128)
    """Width of each hidden layer."""
    activation: str = "elu"
    """Activation function between layers, by rsl_rl's name (`elu`, `relu`, `tanh`, ...)."""
    obs_normalization: bool = False
    """Whether observations are normalized by their running mean and standard deviation."""
    cnn_cfg: dict[str, Any] | None = None
    """Settings of the image encoder, for models that have one."""
    distribution_cfg: dict[str, Any] | None = None
    """Distribution of the output, as `{"class_name": "GaussianDistribution", "init_std": 1.0,
    "std_type": "scalar"}`. None: the output is deterministic."""
    rnn_type: str | None = None
    """`lstm` or `gru` for a recurrent model (with `class_name="RNNModel"`)."""
    rnn_hidden_dim: int = 256
    """Width of the recurrent state."""
    rnn_num_layers: int = 1
    """Number of recurrent layers."""
    class_name: str = "MLPModel"
    """A class of rsl_rl, or `module:Class`."""


@dataclass
class RslRlPpoAlgorithmCfg:
    """Proximal policy optimization."""

    num_learning_epochs: int = 5
    """Passes over the data of an iteration."""
    num_mini_batches: int = 4
    """Parts that the data of an iteration is split into."""
    learning_rate: float = 1e-3
    """Learning rate of the optimizer; the start value under the adaptive schedule."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """`adaptive` changes the learning rate to keep the policy change near `desired_kl`."""
    gamma: float = 0.99
    """Discount factor per environment step."""
    lam: float = 0.95
    """Decay of generalized advantage estimation."""
    entropy_coef: float = 0.005
    """Weight of the entropy bonus."""
    desired_kl: float = 0.01
    """Policy change per update that the adaptive schedule aims at (Kullback-Leibler)."""
    max_grad_norm: float = 1.0
    """Gradients are scaled down to this norm."""
    value_loss_coef: float = 1.0
    """Weight of the value loss."""
    use_clipped_value_loss: bool = True
    """Whether the value loss is clipped as the policy loss is."""
    clip_param: float = 0.2
    """Range of the probability ratio beyond which the policy loss is clipped."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalize advantages within each mini-batch instead of over all data."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Optimizer."""
    share_cnn_encoders: bool = False
    """Whether actor and critic share their image encoders."""
    symmetry_cfg: dict[str, Any] | None = field(default=None, kw_only=True)
    """Learning from mirror images too: `{"data_augmentation_func": "module:function",
    "use_data_augmentation": True}`, as rsl_rl has it. `mjlab.tasks.velocity.symmetry:mirror_left_right`
    is such a function. None: only what was seen."""
    use_mixed_precision: bool = field(default=False, kw_only=True)
    """Mixed precision: bfloat16 in the networks while learning."""
    class_name: str = "PPO"
    """A class of rsl_rl, or `module:Class`."""


@dataclass
class RslRlSacAlgorithmCfg:
    """Soft actor-critic with distributional critics, from a replay (`mjlab.rl.sac`).

    The defaults are FastSAC's (Seo et al., arXiv 2512.01996), made smaller for a few cores.
    """

    batch_size: int = 2048
    """Transitions of an update; mirror images count."""
    num_updates: int = 4
    """Updates for each environment step of all environments. Times `batch_size`, by the number of
    environments, this is how often a transition is used (the replay ratio)."""
    replay_steps: int = 500
    """Last steps of each environment that are kept to learn from."""
    learning_starts: int = 10
    """Environment steps before the first update."""
    gamma: float = 0.97
    """Discount factor per environment step."""
    num_steps_return: int = 1
    """Steps over which rewards are summed before the critics' prediction takes their place."""
    value_range: tuple[float, float] | None = None
    """Smallest and largest discounted return that the critics can tell apart. None: rewards are
    divided by the scale of the returns seen so far."""
    num_atoms: int = 101
    """Values that a critic tells apart within the range."""
    tau: float = 0.05
    """Share by which target critics follow the critics in an update."""
    pessimistic: bool = False
    """Take the smaller of both critics' predictions, instead of their mean."""
    policy_delay: int = 4
    """Updates of the critics for one of the policy."""
    actor_learning_rate: float = 3e-4
    """Learning rate of the policy."""
    critic_learning_rate: float = 3e-4
    """Learning rate of the critics."""
    weight_decay: float = 1e-3
    """Decay of weights (AdamW)."""
    init_alpha: float = 1e-3
    """Weight of the entropy, before any learning."""
    alpha_learning_rate: float = 3e-4
    """Learning rate of the logarithm of that weight."""
    alpha_range: tuple[float, float] = (1e-5, 1.0)
    """Smallest and largest weight of the entropy."""
    target_std: float = 0.15
    """Deviation of each action, before tanh, to whose entropy that of the policy is held."""
    mean_penalty: float = 0.01
    """Weight of the squared mean of each action, before tanh, in the loss of the policy. Keeps actions
    that matter little from drifting to their bounds."""
    teacher: str | None = None
    """Observation group with the action that a controller would take, (N, actions), such as that of
    `stepping_action`; the policy imitates it. Values outside (-1, 1) leave an action free."""
    teacher_steps: int = 0
    """Environment steps at the start in which the controller acts, with the policy's exploration."""
    imitation: tuple[tuple[int, float], ...] = ((0, 0.0),)
    """Weight of the squared distance from the teacher's action in the loss of the policy: points
    (environment step, weight), with lines between them."""
    policy_average: float = 1.0
    """Share by which the weights of the policy that acts follow those that are learned, at every
    environment step; 1 takes them over. An average falls less often than the newest weights do."""
    noise_hold: int = 1
    """Most steps for which an environment keeps its exploration noise; 1 draws it at every step."""
    symmetry_cfg: dict[str, Any] | None = None
    """Learning from mirror images too, as for PPO: `{"data_augmentation_func": "module:function"}`.
    Half of each batch are then mirror images."""
    use_mixed_precision: bool = False
    """Mixed precision: bfloat16 in the networks while learning. Two thirds of the time on CPUs with
    AVX-512-bf16 or AMX."""
    save_replay: bool = True
    """Replay file beside the newest checkpoint. Without it, the replay of a resumed run starts
    empty."""
    class_name: str = "mjlab.rl.sac:SAC"
    """A class of rsl_rl, or `module:Class`."""


@dataclass
class RslRlDistillationAlgorithmCfg:
    """Imitation of a teacher on the states that the student leads to (DAgger; arXiv 1011.0686)."""

    num_learning_epochs: int = 1
    """Passes over the data of an iteration."""
    gradient_length: int = 8
    """Environment steps for one update; a recurrent student learns through as many. It should divide
    epochs times steps of an iteration: what is left over teaches nothing."""
    learning_rate: float = 1e-3
    """Learning rate."""
    max_grad_norm: float | None = 1.0
    """Gradients are scaled down to this norm; None leaves them."""
    loss_type: Literal["mse", "huber"] = "mse"
    """Distance between the actions of student and teacher."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Optimizer."""
    use_mixed_precision: bool = False
    """Mixed precision: bfloat16 in the networks while learning."""
    class_name: str = "Distillation"
    """A class of rsl_rl, or `module:Class`."""


@dataclass
class EvaluationCfg:
    """What counts as solved, and when training stops to look.

    The return of an episode is the sum of its weighted rewards BEFORE they are multiplied by the
    environment step: with rewards in [0, 1], an episode of 1000 steps has at most 1000.
    """

    solved_return: float | None = None
    """Mean evaluation return from which the task counts as solved. None, and
    no other condition: nothing is evaluated."""
    solved_below: dict[str, float] = field(default_factory=dict)
    """Further conditions, all to be met: the largest value of figures by name. A figure is a metric
    of `metrics`, `failure_rate`, `success_rate` or `mean_length`. `solved_return` may be None
    then. Rates are judged by the middle of their 95 % Wilson interval, so that few episodes show
    little: 8 failures in 200 as 4.9 %, none in 4 as 24 %."""
    solved_above: dict[str, float] = field(default_factory=dict)
    """Likewise the smallest value of figures."""
    metrics: dict[str, Callable[[Any], Any]] = field(default_factory=dict)
    """What evaluations measure beside the return: `func(env) -> (num_envs,)` by name, averaged over
    the steps of an episode."""
    stop_when_solved: bool = True
    """Stop training once the task is solved and a second evaluation, of unused episodes, confirms
    it."""
    num_episodes: int = 256
    """Episodes of an evaluation, and of the one that confirms it; each environment plays one, with
    the deterministic policy."""
    trigger_fraction: float = 0.8
    """An evaluation takes time, so it waits until the mean reward of the training data, times the
    length of an episode, reaches this fraction of `solved_return`. Below 1, because training
    explores."""
    trigger_return: float | None = None
    """Instead of `trigger_fraction`, the return of the training data to wait for."""
    min_interval: int = 3
    """Iterations from one evaluation to the next, at least."""
    first_iteration: int = 0
    """Iterations before the first evaluation, at least."""
    success_return: float | None = None
    """Return from which one episode is a success. None: `solved_return`."""
    success_func: Callable[[Any], Any] | None = None
    """Instead of a return: `func(env) -> (num_envs,) bool`. The value one step before an episode
    ends decides, because the environment has reset by the time its last step returns."""
    success_is_survival: bool = False
    """Whether an episode is a success where no termination ended it before its time was over. Not
    together with another condition of success."""
    prepare_env: Callable[[Any], None] | None = None
    """Turns, in place, a copy of the training environments' config into that of evaluations, where
    training makes the task easier than it is. None: they are the same. Evaluations in training call
    it on the config that the run has got; `evaluate` before flags and `TaskOptions` change anything,
    so that they win."""


@dataclass
class RslRlBaseRunnerCfg:
    """A training run."""

    seed: int = 42
    """Seed of the run, of the environment too; -1 draws one, which is printed and recorded. Further
    processes of the run derive theirs from it."""
    num_steps_per_env: int = 24
    """Environment steps per iteration."""
    max_iterations: int = 300
    """Iterations in total; those before a resume count."""
    obs_groups: dict[str, tuple[str, ...]] = field(
        default_factory=lambda: {"actor": ("actor",), "critic": ("critic",)}
    )
    """For each model, the observation groups that it gets, concatenated in this order."""
    save_interval: int = 50
    """Iterations from one checkpoint to the next."""
    experiment_name: str = "exp1"
    """Folder of the experiment, under the log root."""
    run_name: str = ""
    """Added to the name of the run folder, which is the time of its start."""
    logger: Literal["wandb", "tensorboard"] = "tensorboard"
    """Where figures go: `tensorboard` writes to the run folder only; `wandb` also uploads to
    Weights & Biases. (mjlab 1.6 uploads by default.)"""
    wandb_project: str = "mjlab"
    """Project at Weights & Biases."""
    wandb_tags: tuple[str, ...] = ()
    """Tags of the run at Weights & Biases."""
    resume: bool = False
    """Continue from a checkpoint."""
    load_run: str = ".*"
    """Run folder to resume from: a regular expression, of which the newest match is taken."""
    load_checkpoint: str = "model_.*.pt"
    """Checkpoint to resume from: a regular expression, of which the newest match is taken."""
    clip_actions: float | None = None
    """Actions are clipped to plus and minus this before they reach the environment. Those of SAC are
    in (-1, 1) anyway: the scale of the action term sets how far they reach."""
    upload_model: bool = True
    """Whether checkpoints and exported policies are uploaded to Weights & Biases."""
    save_git_diff: bool = field(default=True, kw_only=True)
    """Keep the commit and the uncommitted changes of the task's repository in the run's folder (`git/`)."""
    upload_git_diff: bool = field(default=False, kw_only=True)
    """Upload them to Weights & Biases, too."""
    evaluation: EvaluationCfg = field(default_factory=EvaluationCfg, kw_only=True)
    """What counts as solved."""


@dataclass
class RslRlOnPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """A training run with an on-policy algorithm."""

    class_name: str = "OnPolicyRunner"
    """The runner, by rsl_rl's name."""
    actor: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution())
    )
    """The policy network."""
    critic: RslRlModelCfg = field(default_factory=RslRlModelCfg)
    """The value network."""
    algorithm: RslRlPpoAlgorithmCfg = field(default_factory=RslRlPpoAlgorithmCfg)
    """The learning algorithm."""
    torch_compile_mode: TorchCompileMode | None = field(default=None, kw_only=True)
    """Networks compiled by `torch.compile`, which takes its time at the start; None does not."""


@dataclass
class RslRlOffPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """A training run with an off-policy algorithm. Actions are in (-1, 1)."""

    actor: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(
            class_name="mjlab.rl.sac_models:SacActorModel",
            hidden_dims=(256, 128, 64),
            activation="swish",
            obs_normalization=True,
            distribution_cfg=squashed_gaussian(),
        )
    )
    """The policy network."""
    critic: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(
            class_name="mjlab.rl.sac_models:TwinCriticModel",
            hidden_dims=(256, 128, 64),
            activation="swish",
            obs_normalization=True,
        )
    )
    """Both critics."""
    algorithm: RslRlSacAlgorithmCfg = field(default_factory=RslRlSacAlgorithmCfg)
    """The learning algorithm."""


@dataclass
class RslRlDistillationRunnerCfg(RslRlBaseRunnerCfg):
    """A training run in which a student learns to act as a trained teacher does."""

    obs_groups: dict[str, tuple[str, ...]] = field(
        default_factory=lambda: {"student": ("actor",), "teacher": ("actor",)}
    )
    """For each model, the observation groups that it gets, concatenated in this order."""
    class_name: str = "DistillationRunner"
    """The runner, by rsl_rl's name."""
    student: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution(0.1))
    )
    """The policy network. Its deviation is that of the actions while learning, and does not change."""
    teacher: RslRlModelCfg = field(
        default_factory=lambda: RslRlModelCfg(distribution_cfg=gaussian_distribution())
    )
    """The teacher's network, as it was trained. `train` takes sizes and kind from the teacher's run."""
    algorithm: RslRlDistillationAlgorithmCfg = field(default_factory=RslRlDistillationAlgorithmCfg)
    """The learning algorithm."""
    teacher_checkpoint: str | None = None
    """Checkpoint of the teacher, trained with PPO. A resumed run has its teacher already."""
    torch_compile_mode: TorchCompileMode | None = None
    """Networks compiled by `torch.compile`, which takes its time at the start; None does not."""
