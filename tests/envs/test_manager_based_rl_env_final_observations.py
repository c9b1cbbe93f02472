"""Final observations of truncated episodes: values, and absence of side effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    TerminationTermCfg,
)
from mjlab.managers.manager_base import ManagerTermBase
from mjlab.sensor import CameraSensorCfg, GridPatternCfg, ObjRef, RayCastSensorCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.utils.noise import (
    GaussianNoiseCfg,
    NoiseModelWithAdditiveBiasCfg,
    UniformNoiseCfg,
)

NUM_ENVS, STEPS = 4, 9
Edit = Callable[[ManagerBasedRlEnvCfg], None]


def joint_pos(env: Any) -> torch.Tensor:
    return env.sim.data.qpos


def pole_place(env: Any) -> torch.Tensor:
    """A derived quantity: the place of the pole's body."""
    return env.sim.data.xipos[:, -1]


class Sum(ManagerTermBase):
    """The sum over all calls of an episode: a term with state."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(env)
        self.total = torch.zeros(env.num_envs, env.sim.data.qpos.shape[1])

    def __call__(self, env: Any) -> torch.Tensor:
        self.total += env.sim.data.qpos
        return self.total

    def reset(self, env_ids: Any) -> None:
        self.total[env_ids] = 0.0


def due(steps: list[int]) -> Callable[[Any], torch.Tensor]:
    """Return a termination of environment i when its episode has `steps[i]` steps."""
    return lambda env: env.episode_length_buf >= torch.tensor(steps)


def config(engine: str, *edits: Edit) -> ManagerBasedRlEnvCfg:
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = NUM_ENVS, 5, engine
    cfg.episode_length_s = 100.0
    group = ObservationGroupCfg(
        terms={
            "pos": ObservationTermCfg(func=joint_pos),
            "place": ObservationTermCfg(func=pole_place),
        },
        enable_corruption=True,
    )
    cfg.observations = {"actor": group}
    # Environments 1 and 3 run out of time after the 4th and 6th step, 0 fails after the 5th.
    cfg.terminations = {
        "time_out": TerminationTermCfg(func=due([99, 4, 99, 6]), time_out=True),
        "failed": TerminationTermCfg(func=due([5, 99, 99, 99])),
    }
    for edit in edits:
        edit(cfg)
    return cfg


@pytest.fixture
def make() -> Iterator[Callable[..., ManagerBasedRlEnv]]:
    """Return a function that makes an environment, reset and ready to step."""
    made: list[ManagerBasedRlEnv] = []

    def make(*edits: Edit, observes_ends: bool = True, engine: str = "native") -> ManagerBasedRlEnv:
        env = ManagerBasedRlEnv(config(engine, *edits), device="cpu")
        made.append(env)
        env.observes_ends = observes_ends
        env.reset()
        return env

    yield make
    for env in made:
        env.close()


def steps(env: ManagerBasedRlEnv) -> list[tuple[Any, ...]]:
    """Step with fixed actions; return copies of what each step returns."""
    generator = torch.Generator().manual_seed(0)
    returned = []
    for _ in range(STEPS):
        values = env.step(2.0 * torch.rand(NUM_ENVS, 1, generator=generator) - 1.0)
        returned.append((*(value.clone() for value in values[1:4]), values[0], dict(values[4])))
    return returned


def go_on(cfg: ManagerBasedRlEnvCfg) -> None:
    """Let no episode end."""
    cfg.terminations = {}


def remember(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add delays, histories and a term with state."""
    terms = cfg.observations["actor"].terms
    terms["late"] = ObservationTermCfg(func=joint_pos, delay_min_lag=2, delay_max_lag=2)
    terms["old"] = ObservationTermCfg(func=joint_pos, history_length=3)
    terms["both"] = ObservationTermCfg(
        func=joint_pos, delay_min_lag=1, delay_max_lag=1, history_length=2
    )
    terms["sum"] = ObservationTermCfg(func=Sum)


def disturb(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add noise, random lags and a noise model, and a group that is a dict."""
    terms = cfg.observations["actor"].terms
    terms["pos"].noise = UniformNoiseCfg(n_min=-0.1, n_max=0.1)
    terms["place"].noise = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=GaussianNoiseCfg(std=0.1), bias_noise_cfg=GaussianNoiseCfg(std=1.0)
    )
    terms["random"] = ObservationTermCfg(
        func=joint_pos, delay_max_lag=3, delay_hold_prob=0.3, history_length=2
    )
    terms["shared"] = ObservationTermCfg(func=joint_pos, delay_max_lag=3, delay_per_env=False)
    cfg.observations["other"] = ObservationGroupCfg(
        terms={"sum": ObservationTermCfg(func=Sum)}, concatenate_terms=False
    )


def look_down(cfg: ManagerBasedRlEnvCfg) -> None:
    """Add rays and images that move with the pole, and observe them."""
    cfg.scene.sensors = (
        RayCastSensorCfg(
            name="rays",
            frame=ObjRef(type="body", name="pole_1", entity="cartpole"),
            pattern=GridPatternCfg(size=(0.2, 0.0), resolution=0.2),
            ray_alignment="base",
            max_distance=10.0,
        ),
        CameraSensorCfg(
            name="eye",
            parent_body="cartpole/pole_1",
            pos=(0.0, -1.0, 0.0),
            quat=(0.7071, 0.7071, 0.0, 0.0),
            width=8,
            height=6,
            data_types=("depth",),
        ),
    )
    terms = cfg.observations["actor"].terms
    terms["rays"] = ObservationTermCfg(func=lambda env: env.scene["rays"].data.hit_pos_w.flatten(1))
    terms["image"] = ObservationTermCfg(func=lambda env: env.scene["eye"].data.depth.flatten(1))


def rows(values: Any, ids: Any) -> list[torch.Tensor]:
    """Return rows of observations, group by group."""
    if isinstance(values, dict):
        return [row for value in values.values() for row in rows(value, ids)]
    return [values[ids]]


# Values.


@pytest.mark.parametrize(
    ("engine", "edits"), [("native", ()), ("native", (remember,)), ("warp", (remember,))]
)
def test_final_observations_are_those_of_an_episode_that_goes_on(make, engine, edits):
    ended = steps(make(*edits, engine=engine))
    going_on = steps(make(*edits, go_on, engine=engine))
    for step, ids in ((3, [1]), (5, [3])):
        extras, observations = ended[step][4], ended[step][3]
        assert extras["final_ids"].tolist() == ids
        final = extras["final_observations"]["actor"]
        assert torch.equal(final, going_on[step][3]["actor"][ids])
        # Neither the first observation of the next episode nor the one before the step.
        assert not torch.equal(final, observations["actor"][ids])
        assert not torch.equal(final, ended[step - 1][3]["actor"][ids])


def test_only_steps_in_which_an_episode_runs_out_of_time_have_them(make):
    env = make()
    returned = steps(env)
    # Environment 1 runs out of time again.
    assert [k for k, values in enumerate(returned) if "final_ids" in values[4]] == [3, 5, 7]
    assert [k for k, values in enumerate(returned) if "final_observations" in values[4]] == [
        3,
        5,
        7,
    ]
    env.episode_length_buf[3] = 5
    assert "final_ids" in env.step(torch.zeros(NUM_ENVS, 1))[4]
    assert "final_ids" not in env.reset()[1]


def test_an_episode_that_terminates_when_its_time_is_over_has_none(make):
    def fail_in_time(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.terminations["failed"] = TerminationTermCfg(func=due([99, 4, 99, 99]))

    assert [k for k, v in enumerate(steps(make(fail_in_time))) if "final_ids" in v[4]] == [5]


@pytest.mark.parametrize("by", ["switch", "auto_reset"])
def test_without_the_switch_or_without_auto_reset_there_are_none(make, by):
    def by_hand(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.auto_reset = False

    env = make(observes_ends=False) if by == "switch" else make(by_hand)
    for _ in range(4):
        extras = env.step(torch.zeros(NUM_ENVS, 1))[4]
    assert env.reset_time_outs.any()
    assert "final_ids" not in extras


def test_rays_and_images_are_of_the_state_the_episode_ended_in(make):
    ended, going_on = steps(make(look_down)), steps(make(look_down, go_on))
    for step, ids in ((3, [1]), (5, [3])):
        final = ended[step][4]["final_observations"]["actor"]
        assert torch.equal(final, going_on[step][3]["actor"][ids])
        assert not torch.equal(final[:, -48:], ended[step][3]["actor"][ids, -48:])


def test_what_an_event_placed_in_the_step_is_seen(make):
    def place(env: Any, env_ids: Any) -> None:
        if env.common_step_counter == 4:
            pose = torch.full((2, 2), 0.3)
            cartpole = env.scene["cartpole"]
            cartpole.write_joint_position_to_sim(pose, env_ids=torch.tensor([1, 2]))

    def placing(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.events["place"] = EventTermCfg(func=place, mode="step")

    ended, going_on = steps(make(placing)), steps(make(placing, go_on))
    final = ended[3][4]["final_observations"]["actor"]
    assert torch.allclose(final[:, :2], torch.tensor(0.3))
    assert torch.equal(final, going_on[3][3]["actor"][[1]])


# No trace.


def read_everything(env: Any, env_ids: Any, seen: list[torch.Tensor]) -> torch.Tensor:
    """Curriculum that reads quantities derived from the final state of episodes."""
    values = [pole_place(env), env.sim.data.cvel, env.sim.data.qacc]
    if "rays" in env.scene.sensors:
        values += [env.scene["rays"].data.hit_pos_w.flatten(1), env.scene["eye"].data.depth]
    seen += [value.clone() for value in values]
    return torch.zeros(())


@pytest.mark.parametrize(
    ("engine", "edits"),
    [
        ("native", (remember, disturb)),
        ("native", (disturb, look_down)),
        ("warp", (remember, disturb)),
    ],
)
def test_trajectories_random_numbers_and_what_resets_read_do_not_depend_on_the_switch(
    make, engine, edits
):
    results = []
    for observes_ends in (False, True):
        seen: list[torch.Tensor] = []

        def reading(cfg: ManagerBasedRlEnvCfg, seen: list[torch.Tensor] = seen) -> None:
            cfg.curriculum = {
                "reads": CurriculumTermCfg(func=read_everything, params={"seen": seen})
            }

        env = make(*edits, reading, engine=engine, observes_ends=observes_ends)
        returned = steps(env)
        assert any("final_ids" in values[4] for values in returned) == observes_ends
        flat = [t for values in returned for t in (*values[:3], *rows(values[3], slice(None)))]
        results.append([*flat, *seen, torch.rand(3)])
    assert len(results[0]) == len(results[1])
    assert all(map(torch.equal, *results))


def test_steps_may_come_with_and_without_inference_mode(make):
    class Last(Sum):
        def __call__(self, env: Any) -> torch.Tensor:
            # Kept, made under whatever mode there is, unless the episode has just begun.
            if (env.episode_length_buf == 0).any():
                self.total = env.sim.data.qpos.clone()
            return self.total

    def add(cfg: ManagerBasedRlEnvCfg) -> None:
        cfg.observations["actor"].terms["last"] = ObservationTermCfg(func=Last)

    env = make(remember, disturb, look_down, add)
    for step in range(STEPS):
        with torch.inference_mode(step % 2 == 0):
            env.step(torch.zeros(NUM_ENVS, 1))


def test_nothing_more_runs_in_steps_without_a_time_out(make, monkeypatch):
    env = make(go_on)
    monkeypatch.setattr(env.sim, "looking_ahead", None)
    monkeypatch.setattr(env.observation_manager, "preview", None)
    steps(env)
