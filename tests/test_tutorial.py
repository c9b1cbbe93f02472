"""The tutorial's snippets, word for word, make a working task in a module of the user's own."""

from __future__ import annotations

import importlib
import shutil
import sys
import warnings
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest
import torch

from mjlab import compat
from mjlab.actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp import dr, joint_pos_rel
from mjlab.envs.mdp.actions import (
    JointEffortActionCfg,
    JointPositionActionCfg,
    JointVelocityActionCfg,
)
from mjlab.managers import EventTermCfg, ObservationTermCfg, SceneEntityCfg
from mjlab.tasks import registry

DATA = Path(__file__).parent / "data" / "tutorial"
TASK = "My-Cartpole-Swingup"


@pytest.fixture
def package(tmp_path, monkeypatch) -> ModuleType:
    """Return the user's package, freshly written and imported."""
    folder = tmp_path / "my_tasks"
    folder.mkdir()
    for path in DATA.iterdir():
        shutil.copy(path, folder / path.name.removesuffix(".txt"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    compat._warn_once.cache_clear()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            importlib.import_module("my_tasks")
        yield sys.modules["my_tasks.my_cartpole"]
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] == "my_tasks"]:
            del sys.modules[name]


def make_env(cfg: ManagerBasedRlEnvCfg, num_envs: int = 8, seed: int = 4) -> ManagerBasedRlEnv:
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def actions(steps: int, num_envs: int = 8) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 2.0 * torch.rand(steps, num_envs, 1, generator=generator) - 1.0


def observed(env: ManagerBasedRlEnv, steps: int = 4) -> torch.Tensor:
    """Return the actor's observations over `steps` steps, and close the environment."""
    seen = [env.step(action)[0]["actor"].clone() for action in actions(steps, env.num_envs)]
    env.close()
    return torch.stack(seen)


def test_the_environment_is_what_the_tutorial_describes(package):
    env = make_env(package.make_env_cfg(swing_up=True))
    observations, reward, terminated, truncated, _ = env.step(actions(1)[0])
    assert {name: tuple(group.shape) for name, group in observations.items()} == {
        "actor": (8, 5),
        "critic": (8, 5),
    }
    assert torch.equal(observations["actor"], observations["critic"])
    # The agent controls 20 times a second, for 50 s.
    assert env.step_dt == pytest.approx(0.05)
    assert env.max_episode_length == 1000
    assert ((reward >= 0) & (reward <= env.step_dt)).all()
    assert not terminated.any()
    assert not truncated.any()
    assert env.sim.mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    env.close()


@pytest.mark.parametrize(("swing_up", "angle"), [(True, np.pi), (False, 0.0)])
def test_episodes_start_around_the_initial_state_of_the_variant(package, swing_up, angle):
    env = make_env(package.make_env_cfg(swing_up=swing_up), num_envs=64)
    data = env.scene["cartpole"].data
    offset = data.joint_pos - torch.tensor([0.0, angle], dtype=torch.float32)
    assert (offset[:, 0].abs() <= 0.1).all()
    assert (offset[:, 1].abs() <= 0.034).all()
    assert (data.joint_vel.abs() <= 0.01).all()
    assert offset.std(dim=0).min() > 0.01
    env.close()


def test_the_only_end_of_an_episode_is_its_time_limit(package):
    cfg = package.make_env_cfg(swing_up=True)
    cfg.episode_length_s = 0.15
    env = make_env(cfg)
    for step, action in enumerate(actions(3)):
        _, _, terminated, truncated, _ = env.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == 2)
    env.close()


def test_the_effort_is_clamped_and_geared_as_the_xml_says(package):
    env = make_env(package.make_env_cfg(swing_up=True), num_envs=3)
    env.step(torch.tensor([[0.5], [1.0], [7.0]]))
    force = env.sim.data.qfrc_actuator[:, 0]
    torch.testing.assert_close(force, torch.tensor([5.0, 10.0, 10.0]))
    env.close()


def test_the_term_configs_that_groups_share_stay_as_they_were(package):
    make_env(package.make_env_cfg(swing_up=True)).close()
    assert package.cart_cfg.joint_names == ("slider",)
    assert package.cart_cfg.joint_ids == slice(None)
    assert package.observations["actor"].terms["cart_pos"] is package.cart_pos
    # A second environment of another variant is built from the same objects.
    make_env(package.make_env_cfg(swing_up=False)).close()


def test_the_newer_name_of_the_actuator_is_the_same_actuator(package):
    older = observed(make_env(package.make_env_cfg(swing_up=True)))
    cfg = package.make_env_cfg(swing_up=True)
    cfg.scene.entities["cartpole"].articulation = EntityArticulationInfoCfg(
        actuators=(XmlActuatorCfg(target_names_expr=("slider",)),)
    )
    assert torch.equal(observed(make_env(cfg)), older)


KINDS = {
    "Motor": ('<motor name="slide" joint="slider"/>', JointEffortActionCfg, {}),
    "Position": (
        '<position name="slide" joint="slider" kp="5"/>',
        JointPositionActionCfg,
        {"use_default_offset": False},
    ),
    "Velocity": (
        '<velocity name="slide" joint="slider" kv="5"/>',
        JointVelocityActionCfg,
        {"use_default_offset": False},
    ),
    "Muscle": (
        '<muscle name="slide" joint="slider" lengthrange="-2 2"/>',
        JointEffortActionCfg,
        {},
    ),
}


@pytest.mark.parametrize("suffix", ["older", "newer"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_kind_of_actuator_is_found_in_the_xml(package, kind, suffix):
    import mjlab.actuator

    element, action_type, options = KINDS[kind]
    xml = (DATA / "cartpole.xml").read_text()
    before, after = xml.split("<actuator>")[0], "</mujoco>"
    spec_xml = f"{before}<actuator>{element}</actuator>{after}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        name = f"Xml{kind}ActuatorCfg" if suffix == "older" else "XmlActuatorCfg"
        actuator_type = getattr(mjlab.actuator, name)
    cfg = package.make_env_cfg(swing_up=False)
    robot = cfg.scene.entities["cartpole"]
    robot.spec_fn = lambda: mujoco.MjSpec.from_string(spec_xml)
    robot.articulation = EntityArticulationInfoCfg(
        actuators=(actuator_type(target_names_expr=("slider",)),)
    )
    cfg.actions = {
        "drive": action_type(entity_name="cartpole", actuator_names=("slider",), **options)
    }
    env = make_env(cfg)
    action = actions(1)[0].abs()
    env.step(action)
    torch.testing.assert_close(env.sim.data.ctrl, action)
    env.close()


def test_noise_as_the_tutorial_adds_it(package, tmp_path):
    snippet = (DATA / "noise.py.txt").read_text()
    names = {
        "ObservationTermCfg": ObservationTermCfg,
        "joint_pos_rel": joint_pos_rel,
        "cart_cfg": package.cart_cfg,
    }
    head, _, call = snippet.partition("\n\n")
    exec(head, names)
    noisy = eval(call, names)
    cfg = package.make_env_cfg(swing_up=True)
    cfg.observations["actor"] = type(cfg.observations["actor"])(
        {**package.actor_terms, "cart_pos": noisy}, enable_corruption=True
    )
    env = make_env(cfg, num_envs=256)
    observations = env.step(torch.zeros(256, 1))[0]
    noise = observations["actor"] - observations["critic"]
    assert (noise[:, 0].abs() <= 0.05 + 1e-6).all()
    assert noise[:, 0].std() > 0.02
    assert (noise[:, 1:] == 0).all()
    env.close()


@pytest.mark.parametrize("mode", ["startup", "reset"])
def test_pole_mass_and_joint_damping_are_randomized(package, mode):
    pole = SceneEntityCfg("cartpole", body_names=("pole_1",))
    hinge = SceneEntityCfg("cartpole", joint_names=("hinge_1",))
    cfg = package.make_env_cfg(swing_up=True)
    cfg.events = {
        **cfg.events,
        "pole_inertia": EventTermCfg(
            func=dr.pseudo_inertia,
            mode=mode,
            params={"asset_cfg": pole, "alpha_range": (-0.2, 0.2)},
        ),
        "damping": EventTermCfg(
            func=dr.joint_damping, mode=mode, params={"asset_cfg": hinge, "ranges": (1e-3, 1e-2)}
        ),
    }
    env = make_env(cfg, num_envs=32)
    model, plain = env.sim.model, env.sim.mj_model
    body, joint = plain.body("cartpole/pole_1").id, plain.joint("cartpole/hinge_1")
    mass = model.body_mass[:, body]
    assert len(mass.unique()) == 32
    # alpha scales mass and inertia alike, by exp(2 alpha).
    assert (mass / plain.body_mass[body]).log().abs().max() <= 0.4 + 1e-5
    # The principal axes may come in another order.
    inertia = model.body_inertia[:, body].sum(dim=1) / plain.body_inertia[body].sum()
    torch.testing.assert_close(inertia, mass / plain.body_mass[body], rtol=1e-4, atol=0)
    damping = model.dof_damping[:, joint.dofadr[0]]
    assert len(damping.unique()) == 32
    assert ((damping >= 1e-3) & (damping <= 1e-2)).all()
    cart = plain.body("cartpole/cart").id
    assert (model.body_mass[:, cart] == plain.body_mass[cart]).all()
    before = mass.clone()
    env.reset()
    assert torch.equal(env.sim.model.body_mass[:, body], before) == (mode == "startup")
    assert torch.isfinite(observed(env)).all()


def test_a_heavier_pole_moves_differently(package):
    seen = {}
    for scale in (1.0, 2.0):
        cfg = package.make_env_cfg(swing_up=True)
        pole = SceneEntityCfg("cartpole", body_names=("pole_1",))
        params = {"asset_cfg": pole, "ranges": (scale, scale)}
        mass = EventTermCfg(func=dr.body_mass, mode="startup", params=params)
        cfg.events = {**cfg.events, "pole_mass": mass}
        with warnings.catch_warnings():
            # Mass without inertia is advised against.
            warnings.simplefilter("ignore")
            env = make_env(cfg)
        seen[scale] = env.obs_buf["actor"].clone(), observed(env)
    assert torch.equal(seen[1.0][0], seen[2.0][0]), "episodes have to begin alike"
    assert not torch.allclose(seen[1.0][1], seen[2.0][1], atol=1e-3)


def test_the_task_is_registered_under_its_own_name_and_trains(package, tmp_path, capsys):
    assert TASK in registry.list_tasks()
    assert registry.load_env_cfg(TASK, play=True).episode_length_s == 1e10
    from mjlab.cli.flags import parse_flags
    from mjlab.scripts.train import TrainConfig, launch_training

    flags = ["--num-envs", "8", "--device", "cpu", "--log-root", str(tmp_path / "logs")]
    flags += ["--agent.max-iterations", "1", "--agent.num-steps-per-env", "4"]
    flags += ["--agent.algorithm.learning-rate", "3e-4", "--agent.algorithm.entropy-coef", "0.005"]
    threads = torch.get_num_threads()
    cfg = parse_flags(TrainConfig, TrainConfig.from_task(TASK), flags, "train")
    run_dir = launch_training(TASK, cfg)
    torch.set_num_threads(threads)
    assert run_dir.parent == tmp_path / "logs" / "cartpole"
    assert (run_dir / "model_0.pt").is_file()
    assert f"Task:    {TASK}, 8 environments" in capsys.readouterr().out


def test_a_name_can_be_registered_once_only(package):
    with pytest.raises(ValueError, match=f"{TASK!r} is registered already"):
        registry.register_mjlab_task(
            TASK, package.cartpole_swingup_env_cfg(), rl_cfg=package.cartpole_ppo_runner_cfg()
        )
