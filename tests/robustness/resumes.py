"""Runs resumed under other flags: each flag acts, or is an error that names it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from .commands import TASK, check_end, command
from .runs import SAC, check_loadable, learned, same, trained
from .trials import Broken, Trial

WHAT = "runs of PPO and SAC resumed under other flags of learner and environment, or under the same"
TRIALS = 60
LIMIT = 120.0

_ITERATIONS = 2

# Flags with values that differ from those of the run. Each changes the weights of the next iteration.
_ENV: dict[str, tuple[Any, ...]] = {
    "env.decimation": (2, 7),
    "env.episode-length-s": (0.5, 0.25),
    "env.scale-rewards-by-dt": (False,),
    "env.sim.mujoco.timestep": (0.005, 0.02),
    "env.sim.mujoco.gravity": ("(0.0, 0.0, -1.62)",),
    "env.rewards.smooth-reward.weight": (9.0, -1.0),
    "env.actions.effort.scale": (0.1, 3.0),
    "env.observations.actor.terms.cart-pos.scale": (2.0,),
    "env.observations.actor.terms.cart-pos.delay-max-lag": (3,),
    "env.events.reset-slider.params.position-range": ("(-1.0, 1.0)",),
    "env.scene.entities.cartpole.articulation.actuators.0.armature": (0.5,),
    "env.scene.entities.cartpole.articulation.actuators.0.viscous-damping": (1.0,),
    "num-envs": (4, 20),
}
_ACTING: dict[str, dict[str, tuple[Any, ...]]] = {
    "ppo": {
        "agent.seed": (5, 6),
        "agent.num-steps-per-env": (5, 11),
        "agent.clip-actions": (0.1,),
        "agent.actor.activation": ("tanh",),
        "agent.actor.distribution-cfg.init-std": (0.2,),
        "agent.algorithm.learning-rate": (1e-5, 1e-6, 0.01),
        "agent.algorithm.optimizer": ("adamw", "sgd", "rmsprop"),
        "agent.algorithm.gamma": (0.5,),
        "agent.algorithm.entropy-coef": (1.0,),
        "agent.algorithm.num-learning-epochs": (2,),
        **_ENV,
    },
    "sac": {
        "agent.seed": (5, 6),
        "agent.num-steps-per-env": (5, 11),
        "agent.critic.activation": ("tanh",),
        "agent.algorithm.actor-learning-rate": (1e-5, 1e-2),
        "agent.algorithm.critic-learning-rate": (1e-5, 1e-2),
        "agent.algorithm.weight-decay": (0.5,),
        "agent.algorithm.init-alpha": (0.5,),
        "agent.algorithm.tau": (0.9,),
        "agent.algorithm.num-updates": (3,),
        "agent.algorithm.replay-steps": (13, 90),
        "agent.algorithm.value-range": ("(-3.0, 3.0)",),
        **_ENV,
    },
}
# Flags that the weights do not depend on, and those of the run itself.
_QUIET: dict[str, tuple[Any, ...]] = {
    "agent.save-interval": (1, 3),
    "agent.seed": (7, -1),
    "agent.run-name": ("again",),
    "env.sim.num-threads": (1,),
    "env.viewer.width": (300,),
}
# Flags that cannot act: errors.
_FIXED: dict[str, dict[str, tuple[Any, ...]]] = {
    "ppo": {
        "agent.actor.hidden-dims": ("(8,)", "(64, 65)"),
        "agent.critic.obs-normalization": (True,),
        "agent.obs-groups.critic": ("('actor', 'critic')",),
    },
    "sac": {
        "agent.actor.hidden-dims": ("(8,)",),
        "agent.critic.obs-normalization": (False,),
        "agent.actor.distribution-cfg.init-std": (0.3,),
        "agent.algorithm.num-atoms": (51,),
    },
}


def prepare(folder: Path) -> dict[str, Any]:
    """Train with both learners, and resume without flags."""
    runs = {name: trained(folder / name, _ITERATIONS, *flags) for name, flags in (
        ("ppo", ()), ("sac", SAC),
    )}  # fmt: skip
    plain = {name: _resumed(run, folder / f"{name}-resumed", []) for name, run in runs.items()}
    return {name: (str(run), str(plain[name])) for name, run in runs.items()}


def run(trial: Trial, prepared: dict[str, Any]) -> None:
    """Resume a copy of a run under a few flags, and compare with a resume without."""
    rng = trial.rng
    learner = rng.choice(("ppo", "sac"))
    folder, plain = prepared[learner]
    quiet = rng.random() < 0.25
    table = _QUIET if quiet else _ACTING[learner]
    names = rng.sample(sorted(table), rng.randint(1, 3))
    chosen = {name: rng.choice(table[name]) for name in names}
    stops = not quiet and rng.random() < 0.15
    if stops:
        name = rng.choice(sorted(_FIXED[learner]))
        chosen[name] = rng.choice(_FIXED[learner][name])
    flags = [word for name, value in chosen.items() for word in (f"--{name}", str(value))]
    trial.trying(f"{learner} resumed with {' '.join(flags)}")
    if stops:
        ended = _resume(Path(folder), Path("stopped"), flags)
        words = name.replace("algorithm.num-atoms", "critic").split(".")
        if ended.status != 1 or not any(word in ended.err for word in words[1:]):
            raise Broken(f"exit status {ended.status}: {ended.err[-200:]}")
        return
    found = learned(_resumed(Path(folder), Path("one"), flags))
    is_same = same(found, learned(Path(plain)))
    if is_same and not quiet:
        raise Broken("the weights are those of the resume without flags")
    if quiet and not is_same:
        raise Broken("the weights are not those of the resume without flags")
    if rng.random() < 0.3 and not same(found, learned(_resumed(Path(folder), Path("two"), flags))):
        raise Broken("the same flags gave other weights")
    if rng.random() < 0.4:
        # A session more, which needs no flags.
        last = _ITERATIONS + 2
        chained = _resumed(None, Path("one"), [], last)
        if not same(learned(chained), learned(_resumed(Path(folder), Path("long"), flags, last))):
            raise Broken("resumed twice, the weights are those of other settings")


def _resume(
    run: Path | None, root: Path, flags: list[str], iterations: int = _ITERATIONS + 1
) -> Any:
    """Resume a copy of `run` in `root`, or the newest run there, up to a number of iterations."""
    experiment = (root / "cartpole").resolve()
    if run is not None:
        shutil.copytree(run, experiment / run.name)
    ended = command(
        "train", TASK, "--device", "cpu", "--log-root", str(experiment.parent),
        "--agent.resume", "True", "--agent.max-iterations", str(iterations), *flags,
        patience=60.0,
    )  # fmt: skip
    check_end(ended)
    check_loadable(experiment.parent)
    return ended


def _resumed(
    run: Path | None, root: Path, flags: list[str], iterations: int = _ITERATIONS + 1
) -> Path:
    """Return the last checkpoint of a run resumed under `flags`; see `_resume`."""
    ended = _resume(run, root, flags, iterations)
    found = list((root / "cartpole").resolve().glob(f"*/model_{iterations - 1}.pt"))
    if ended.status != 0 or len(found) != 1:
        raise Broken(f"exit status {ended.status}: {ended.err[-200:]}")
    return found[0]
