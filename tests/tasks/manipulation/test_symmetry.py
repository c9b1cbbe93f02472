"""Mirror images of an arm that lifts, against simulated mirrored arms."""

from __future__ import annotations

import gc
import weakref
from dataclasses import asdict
from types import SimpleNamespace

import mujoco
import pytest
import torch
from lifting_tasks import LIFT, lifting, task_cfg
from tensordict import TensorDict
from term_columns import term_columns

from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.tasks.manipulation.symmetry import mirror_left_right
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.symmetry import mirror_of_joints, of_direction
from mjlab.utils.mirror import DIRECTION


def make_env(edit=None):
    """Two arms without randomization."""
    cfg = task_cfg(num_envs=2)
    cfg.events = {name: term for name, term in cfg.events.items() if "friction" not in name}
    cfg.observations["actor"].enable_corruption = False
    if edit is not None:
        edit(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def put_before_mirror(env):
    """Put cube and goal of environment 1 to the right where those of environment 0 are to the left."""
    left, right = env.scene.env_origins.clone()
    cube, side = torch.tensor([0.3, 0.08, 0.02]), torch.tensor(DIRECTION)
    pose = torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]] * 2)
    pose[:, :3] = torch.stack([left + cube, right + side * cube])
    env.scene["cube"].write_root_link_pose_to_sim(pose)
    goal = torch.tensor([0.3, 0.1, 0.3])
    lifting(env).target_pos[:] = torch.stack([left + goal, right + side * goal])


def test_the_mirror_image_is_what_a_mirrored_arm_senses():
    env = make_env()
    put_before_mirror(env)
    torch.manual_seed(0)
    for _ in range(40):
        seen = env.step(mirror_left_right(env, actions=0.5 * torch.randn(1, 7))[1])[0]
        both, _ = mirror_left_right(env, TensorDict(seen, batch_size=[2]))
        for group, values in seen.items():
            torch.testing.assert_close(both[group][:2], values)
            for name, columns in term_columns(env, group):
                # Masses of the two sides differ by some grams.
                gap = (both[group][2, columns] - values[1, columns]).abs().max()
                turn = (values[0, columns] - values[1, columns]).abs().max()
                assert gap < max(0.01, 0.2 * turn), (group, name, gap, turn)
    # The two sides agree only after mirroring.
    for group, values in seen.items():
        for name, columns in term_columns(env, group):
            assert (values[0, columns] - values[1, columns]).abs().max() > 0.02, (group, name)
    env.close()


def test_the_image_of_an_image_is_the_original():
    env = make_env()
    obs = TensorDict({"actor": torch.randn(3, 29), "critic": torch.randn(3, 29)}, batch_size=[3])
    actions = torch.randn(3, 7)
    once = mirror_left_right(env, obs, actions)
    twice = mirror_left_right(env, once[0][3:], once[1][3:])
    for group in ("actor", "critic"):
        assert not torch.allclose(once[0][group][3:], obs[group])
        torch.testing.assert_close(twice[0][group][3:], obs[group])
    torch.testing.assert_close(twice[1][3:], actions)
    env.close()


def test_a_hand_beside_the_mirror_plane_is_refused():
    def move_the_hand(cfg):
        spec_fn = cfg.scene.entities["robot"].spec_fn

        def spec_with_moved_hand():
            spec = spec_fn()
            spec.site("grasp_site").pos = spec.site("grasp_site").pos + 0.02
            return spec

        cfg.scene.entities["robot"].spec_fn = spec_with_moved_hand

    env = make_env(move_the_hand)
    with pytest.raises(ValueError, match="'grasp_site'.*on the mirror plane"):
        mirror_left_right(env, actions=torch.zeros(2, 7))
    env.close()


def place(env):
    return env.scene["cube"].data.root_link_pos_w - env.scene.env_origins


def test_a_package_mirrors_its_own_term_beside_those_of_the_task():
    def observe_the_place(cfg):
        cfg.observations["actor"].terms["place"] = ObservationTermCfg(func=place)

    env = make_env(observe_the_place)
    obs = TensorDict({"actor": torch.ones(1, 32), "critic": torch.ones(1, 29)}, batch_size=[1])
    with pytest.raises(ValueError, match="actor/place.*`terms`"):
        mirror_left_right(env, obs)
    image, _ = mirror_left_right(env, obs, terms={place: of_direction})
    assert image["actor"][1, 29:].tolist() == [1.0, -1.0, 1.0]
    env.close()


def test_mirrors_do_not_keep_an_environment():
    env = make_env()
    mirror_left_right(env, actions=torch.zeros(1, 7))
    kept = weakref.ref(env)
    env.close()
    del env
    gc.collect()
    assert kept() is None


def test_the_cpu_profile_learns_from_mirror_images():
    cfg, rl_cfg = load_env_cfg(LIFT, profile="cpu"), load_rl_cfg(LIFT, profile="cpu")
    cfg.scene.num_envs, rl_cfg.num_steps_per_env = 8, 4
    cfg.commands["lift_height"].num_postures = 10
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    runner = MjlabOnPolicyRunner(env, asdict(rl_cfg), None, "cpu")
    sizes = []
    runner.alg.actor.register_forward_pre_hook(
        lambda module, args: sizes.append(args[0].batch_size[0])
    )
    runner.learn(1)
    # A mini-batch is a quarter of 8 environments times 4 steps, and its mirror image.
    assert max(sizes) == 2 * 8 * 4 // 4
    env.close()


@pytest.mark.parametrize(
    ("constraint", "sign"),
    [
        ('joint1="left" joint2="right" polycoef="0 -1 0 0 0"', 1.0),
        ('joint1="right" joint2="left" polycoef="0 1 0 0 0"', -1.0),
        ('joint1="right" joint2="left" polycoef="0 -0.5 0 0 0"', None),
        ('joint1="right" joint2="left" polycoef="0.01 -1 0 0 0"', None),
        ('joint1="right" joint2="left" polycoef="0 -1 0 0 0" active="false"', None),
    ],
)
def test_a_finger_stands_for_the_one_that_follows_it(constraint, sign):
    fingers = "".join(
        f'<body pos="0 {y} 0"><joint name="{name}" type="slide" axis="0 1 0"/><geom size=".1"/></body>'
        for name, y in (("left", 0.1), ("right", -0.1))
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="hand"><geom size=".1"/>{fingers}</body></worldbody>'
        f"<equality><joint {constraint}/></equality></mujoco>"
    )
    hand = SimpleNamespace(
        joint_names=["left", "right"],
        data=SimpleNamespace(default_joint_pos=torch.zeros(1, 2)),
        indexing=SimpleNamespace(root_body_id=1, joint_ids=torch.tensor([0, 1])),
    )
    if sign is None:
        with pytest.raises(ValueError, match="both sides"):
            mirror_of_joints(model, hand, names=["left"])
    else:
        assert mirror_of_joints(model, hand, names=["left"]).signs.tolist() == [sign]
    # Both fingers are each other's images, coupled or not.
    assert mirror_of_joints(model, hand).sources.tolist() == [1, 0]
