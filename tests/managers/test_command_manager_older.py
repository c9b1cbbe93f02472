"""Commands in the spelling of releases 1.1 to 1.5: whole-batch updates in an environment of today."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch

from mjlab import compat
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import CommandTerm, CommandTermCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.tasks.velocity.mdp import UniformVelocityCommand

NUM_ENVS = 3


@dataclass(kw_only=True)
class PlayCfg(CommandTermCfg):
    term: type = CommandTerm

    def build(self, env):
        return self.term(self, env)


class Play(CommandTerm):
    """A motion player as packages write them: a frame a step, and the robot put back at the end."""

    last = 4
    updates_of_all = 0

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.frame = torch.zeros(self.num_envs, 1)
        self.step_count = 0
        self.metrics["updates"] = torch.zeros(self.num_envs)
        self.dts = []
        self.generator = torch.Generator().manual_seed(0)
        self.draws = []

    @property
    def command(self):
        return self.frame

    def _resample_command(self, env_ids):
        self.frame[env_ids] = 0.0
        self._env.sim.data.qpos[env_ids] = 0.0

    def _update_metrics(self):
        self.metrics["updates"] += 1.0


class Update(Play):
    def _update_command(self):
        self.step_count += 1
        self.updates_of_all += 1
        self.draws.append(torch.rand(1, generator=self.generator).item())
        self.frame += 1.0
        ended = (self.frame[:, 0] > self.last).nonzero().flatten()
        if len(ended) > 0:
            self._resample_command(ended)
            self._env.sim.forward()


class Keywords(Update):
    """Command term with custom keyword arguments."""

    def _update_command(self, again=False, *, faster=0.0):
        super()._update_command()
        self.frame += faster
        if again:
            self._update_command(faster=1.0)


class Compute(Play):
    """Redraws and advances by itself."""

    def compute(self, dt):
        assert isinstance(dt, float)
        self.dts.append(dt)
        super().compute(dt)

    def _update_command(self, env_ids=None):
        self.frame[slice(None) if env_ids is None else env_ids] += 1.0


class Both(Compute):
    def _update_command(self):
        super()._update_command()


class Mixed(SimpleNamespace):
    def _update_command(self):
        self.frame += 1.0


class FromMixin(Mixed, Play):
    def __init__(self, cfg, env):
        Play.__init__(self, cfg, env)


@pytest.fixture(autouse=True)
def _forget_warnings():
    compat._warn_once.cache_clear()


def make(term, num_envs=NUM_ENVS, **fields):
    cfg = load_env_cfg("Mjlab-Cartpole-Balance")
    cfg.scene.num_envs = num_envs
    fields = {"resampling_time_range": (10.0, 10.0), **fields}
    cfg.commands = {"play": PlayCfg(term=term, **fields)}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    return env, env.command_manager.get_term("play")


def step(env):
    return env.step(torch.zeros(env.num_envs, 1))


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize("num_envs", [1, NUM_ENVS])
@pytest.mark.parametrize("term", [Update, Keywords, Compute, Both, FromMixin])
def test_every_environment_advances_once_a_step_and_once_a_reset(term, num_envs):
    env, play = make(term, num_envs)
    env.reset()
    assert play.frame.flatten().tolist() == [1.0] * num_envs
    step(env)
    assert play.frame.flatten().tolist() == [2.0] * num_envs
    assert play.metrics["updates"].tolist() == [2.0] * num_envs
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize("term", [Update, Keywords, Compute, Both, FromMixin])
def test_a_partial_reset_leaves_commands_metrics_and_robots_of_the_others(term):
    env, play = make(term)
    env.reset()
    # The next update would end these motions, and put the robots back.
    play.frame[:] = play.last
    env.sim.data.qpos[:] = torch.arange(1.0, NUM_ENVS + 1.0)[:, None] / 10.0
    env.sim.forward()
    before = {
        "metrics": play.metrics["updates"].clone(),
        "time_left": play.time_left.clone(),
        "qpos": env.sim.data.qpos.clone(),
        "xpos": env.sim.data.xpos.clone(),
    }
    counts = play.step_count
    env.reset(env_ids=torch.tensor([1]))
    others = [0, 2]
    assert play.frame[others].flatten().tolist() == [play.last] * 2
    assert play.frame[1].item() == 1.0
    assert play.step_count == counts
    now = {
        "metrics": play.metrics["updates"],
        "time_left": play.time_left,
        "qpos": env.sim.data.qpos,
        "xpos": env.sim.data.xpos,
    }
    for name, values in now.items():
        torch.testing.assert_close(values[others], before[name][others], rtol=0, atol=1e-6)
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize("num_envs", [1, NUM_ENVS])
def test_an_older_compute_gets_a_number_and_new_commands_their_full_time(num_envs):
    env, play = make(Compute, num_envs)
    env.reset()
    env.episode_length_buf[-1] = env.max_episode_length
    step(env)
    assert play.dts == [0.0, env.step_dt]
    expected = [10.0 - env.step_dt] * (num_envs - 1) + [10.0]
    assert play.time_left.tolist() == pytest.approx(expected)
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize(
    "env_ids",
    [[1], slice(1, 2), torch.tensor([False, True, False]), [False, True, False], torch.tensor([1])],
)
def test_an_older_update_takes_every_way_to_name_environments(env_ids):
    env, play = make(Update)
    env.reset()
    play._update_command(env_ids)
    assert play.frame.flatten().tolist() == [1.0, 2.0, 1.0]
    play._update_command([])
    assert play.frame.flatten().tolist() == [1.0, 2.0, 1.0]
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_partial_resets_keep_class_counters():
    env, play = make(Update)
    play._update_command([1])
    assert play.updates_of_all == 0
    assert "updates_of_all" not in vars(play)
    state = play.generator.get_state()
    play._update_command([1])
    assert not torch.equal(play.generator.get_state(), state)
    play._update_command()
    assert play.updates_of_all == 1
    play._update_command([1])
    assert play.updates_of_all == 1
    env.close()


def test_each_older_method_warns_once_when_its_term_is_built():
    class Quiet(Update):
        def _update_command(self):
            pass

    with pytest.warns(FutureWarning, match=r"Quiet\._update_command without argument") as seen:
        env, _ = make(Quiet)
        env.reset()
        step(env)
    assert len([w for w in seen if "without argument" in str(w.message)]) == 1
    env.close()


def test_methods_with_todays_arguments_are_called_as_they_are():
    class Today(Play):
        def _update_command(self, ids):
            pass

        def compute(self, *args, **kwargs):
            pass

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env, play = make(Today)
    assert "_update_command" not in vars(play)
    assert "compute" not in vars(play)
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_subclasses_may_update_without_env_ids():
    class Doubled(UniformVelocityCommand):
        def _update_command(self):
            super()._update_command()
            self.vel_command_b *= 2.0

    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs = 2
    twist = cfg.commands["twist"]
    ranges = replace(twist.ranges, lin_vel_x=(0.5, 0.5), lin_vel_y=(0.0, 0.0))

    class TwistCfg(type(twist)):
        def build(self, env):
            return Doubled(self, env)

    fields = vars(twist) | {"ranges": ranges, "rel_standing_envs": 0.0}
    cfg.commands, cfg.curriculum = {"twist": TwistCfg(**fields)}, {}
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    assert env.command_manager.get_command("twist")[:, 0].tolist() == [1.0, 1.0]
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_controls_of_release_1_2_get_the_three_arguments_they_take():
    calls = []

    class Controls(Play):
        def create_gui(self, name, server, get_env_idx):
            calls.append((name, server, get_env_idx))

    env, _ = make(Controls)
    env.command_manager.create_gui("server", print, on_change=print)
    assert calls == [("play", "server", print)]
    env.close()


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ("on_change=None", {"on_change": 1}),
        ("on_change", {"on_change": 1}),
        ("callback=None", {"callback": 1}),
        ("callback=None, request=None", {"callback": 1, "request": 2}),
        ("request_action=None", {"request_action": 2}),
        ("*, request_action=None", {"request_action": 2}),
        ("on_change=None, *, request_action=None", {"on_change": 1, "request_action": 2}),
        ("on_change=None, request_action=None", {"on_change": 1, "request_action": 2}),
        ("**further", {"further": {"on_change": 1, "request_action": 2}}),
    ],
)
def test_controls_get_the_arguments_they_take(parameters, expected):
    namespace: dict = {}
    exec(
        f"def create_gui(self, name, server, get_env_idx, {parameters}): return locals()", namespace
    )
    term = type("Controls", (Play,), {"create_gui": namespace["create_gui"]})
    controls = object.__new__(term)
    compat.accept_older_methods(controls)
    given = controls.create_gui("play", "server", print, 1, 2)
    basic = {"self": controls, "name": "play", "server": "server", "get_env_idx": print}
    assert given == basic | expected
