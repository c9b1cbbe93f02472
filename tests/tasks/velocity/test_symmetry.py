"""Left-right symmetry augmentation against simulated mirrored robots."""

from __future__ import annotations

from dataclasses import asdict
from types import SimpleNamespace

import mujoco
import pytest
import torch
from tensordict import TensorDict
from term_columns import term_columns

from mjlab.cli.train_config import parse_train_flags
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg, SceneEntityCfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.sensor import BuiltinSensorCfg, GridPatternCfg, ObjRef, RayCastSensorCfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.symmetry import mirror_left_right, mirror_of_joints

FLAT_GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
ROUGH_GO1 = "Mjlab-Velocity-Rough-Unitree-Go1"
FLAT_G1 = "Mjlab-Velocity-Flat-Unitree-G1"
SUFFIX = "-No-State-Estimation"
# Height of the root (m) when feet just touch the ground.
FALLING = {FLAT_GO1: 0.27, FLAT_G1: 0.74}
TASKS = [FLAT_GO1, FLAT_G1]


def make_env(task, edit=None):
    """Two environments on flat ground without randomization."""
    cfg = load_env_cfg(task)
    cfg.scene.num_envs = 2
    cfg.scene.terrain.terrain_type, cfg.scene.terrain.terrain_generator = "plane", None
    cfg.events, cfg.curriculum = {}, {}
    command = cfg.commands["twist"]
    command.rel_standing_envs, command.heading_command, command.ranges.heading = 0.0, False, None
    command.resampling_time_range = (100.0, 100.0)
    cfg.observations["actor"].enable_corruption = False
    if edit is not None:
        edit(cfg)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    return env


def mirrored_rows(env, actions):
    """Return `actions` (1, n) and below it its mirror image."""
    return mirror_left_right(env, actions=actions)[1]


def put_before_mirror(env, height, turning=0.1, left=0.0):
    """Give environment 0 a random state and environment 1 its mirror image.

    Args:
        env: The environments.
        height: Height of the roots (m).
        turning: Size of the angular velocity (rad/s).
        left: Distance of environment 0 from the mirror (m).
    """
    robot = env.scene["robot"]
    pose = robot.data.default_root_state[:, :7].clone()
    pose[:, :3] = env.scene.env_origins + torch.tensor([[0.0, left, height], [0.0, -left, height]])
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    quat = torch.nn.functional.normalize(upright + 0.1 * torch.randn(4), dim=0)
    pose[0, 3:], pose[1, 3:] = quat, quat * torch.tensor([1.0, -1.0, 1.0, -1.0])
    velocity = (torch.randn(6) * torch.tensor([1.0] * 3 + [turning] * 3)).repeat(2, 1)
    velocity[1] *= torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    # Actions and joints are in the same order, and both measured from the default pose.
    offsets = mirrored_rows(env, 0.1 * torch.randn(1, len(robot.joint_names)))
    speeds = mirrored_rows(env, torch.randn(1, len(robot.joint_names)))
    robot.write_root_state_to_sim(torch.cat([pose, velocity], dim=1))
    robot.write_joint_state_to_sim(robot.data.default_joint_pos + offsets, speeds)
    command = torch.randn(3)
    signs = torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])
    env.command_manager.get_term("twist").vel_command_b[:] = command * signs
    env.scene.write_data_to_sim()
    env.sim.forward()
    env.sim.sense()


@pytest.mark.parametrize("task", TASKS)
def test_the_mirror_image_is_what_a_mirrored_robot_senses(task):
    env = make_env(task)
    torch.manual_seed(0)
    names = list(env.scene["robot"].joint_names)
    assert env.action_manager.get_term("joint_pos").target_names == names
    # In the air, and falling onto the ground for some steps.
    differs = set()
    for height, steps in ((0.6, 1), (FALLING[task], 3), (FALLING[task], 5)):
        put_before_mirror(env, height)
        action = mirrored_rows(env, 0.3 * torch.randn(1, len(names)))
        for _ in range(steps):
            seen = env.step(action)[0]
        both, _ = mirror_left_right(env, TensorDict(seen, batch_size=[2]))
        assert both.batch_size == torch.Size([4])
        for group, values in seen.items():
            torch.testing.assert_close(both[group][:2], values)
            for name, columns in term_columns(env, group):
                # Masses of the two sides differ by some grams, and landing is sudden.
                gap = (both[group][2, columns] - values[1, columns]).abs().max()
                turn = (values[0, columns] - values[1, columns]).abs().max()
                assert gap < max(0.05, 0.5 * turn), (group, name, gap, turn)
                if gap < 0.2 * turn:
                    differs.add(name)
    # Each term had a state whose two sides agree only after mirroring.
    assert differs == {name for group in seen for name, _ in term_columns(env, group)}
    env.close()


def a_step_to_climb(cfg):
    """Give all environments one place, a low box across the mirror, and a scan of the ground."""

    def add_box(spec):
        box = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.3, 0.2, 0.2))
        box.pos, box.group = (0.3, 0.0, 0.0), 0

    cfg.scene.spec_fn, cfg.scene.env_spacing = add_box, 0.0


def histories(cfg):
    """Show three steps of everything; states before the mirror follow one another in each."""
    cfg.observations["actor"].history_length = 3


@pytest.mark.parametrize(
    ("task", "edit"),
    [
        (FLAT_GO1, None),
        (FLAT_G1, None),
        (ROUGH_GO1, a_step_to_climb),
        (FLAT_GO1, histories),
        (FLAT_GO1 + SUFFIX, None),
        (FLAT_G1 + SUFFIX, None),
        (ROUGH_GO1 + SUFFIX, a_step_to_climb),
    ],
)
def test_every_term_is_mirrored_exactly_while_the_robot_turns_fast(task, edit):
    """At 10 rad/s the IMU of the Go1, 67 mm from the middle, moves at up to 0.7 m/s by turning."""
    env = make_env(task, edit)
    torch.manual_seed(1)
    turns = {}
    history = max(3, env.cfg.observations["actor"].history_length or 0)
    for moment in range(history + 3):
        # As after a step, but without physics: masses of the two sides differ by some grams.
        put_before_mirror(env, 1.1, turning=10.0, left=0.15)
        seen = TensorDict(env.observation_manager.compute(update_history=True), batch_size=[2])
        if moment < history - 1:
            continue  # Histories show states from before, too.
        both, _ = mirror_left_right(env, seen)
        for group, values in seen.items():
            for name, columns in term_columns(env, group):
                image, other = both[group][2, columns], values[1, columns]
                torch.testing.assert_close(
                    image, other, atol=1e-4, rtol=1e-4, msg=f"{group}/{name}"
                )
                turn = (values[0, columns] - other).abs().max().item()
                turns[name] = max(turn, turns.get(name, 0.0))
    still = {"actions", "foot_air_time", "foot_contact", "foot_contact_forces"}
    assert {name for name, turn in turns.items() if turn < 0.01} <= still
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_the_mirror_image_is_exact_after_steps_of_fast_turns_in_the_air(task):
    env = make_env(task)
    torch.manual_seed(2)
    put_before_mirror(env, 1.5, turning=8.0)
    for _ in range(3):
        action = mirrored_rows(env, 0.3 * torch.randn(1, len(env.scene["robot"].joint_names)))
        seen = TensorDict(env.step(action)[0], batch_size=[2])
    both, _ = mirror_left_right(env, seen)
    for group in ("actor", "critic"):
        for name, columns in term_columns(env, group):
            gap = (both[group][2, columns] - seen[group][1, columns]).abs().max()
            # Tolerance for the mass differences of the two sides within 0.06 s.
            assert gap < (0.5 if name == "joint_vel" else 0.05), (group, name, gap)
    env.close()


def test_rays_to_the_left_are_rays_to_the_right_in_the_mirror():
    env = make_env(ROUGH_GO1)
    offsets, _ = env.scene["terrain_scan"].cfg.pattern.generate_rays(None, "cpu")
    seen = TensorDict(env.observation_manager.compute(), batch_size=[2])
    (columns,) = [c for name, c in term_columns(env, "actor") if name == "height_scan"]
    for axis, sign in ((0, 1.0), (1, -1.0)):
        seen["actor"][:, columns] = offsets[:, axis]
        image = mirror_left_right(env, seen)[0]["actor"][2:, columns]
        torch.testing.assert_close(image, sign * offsets[:, axis].expand(2, -1))
    env.close()


def other_scales(cfg):
    terms = cfg.observations["actor"].terms
    terms["base_lin_vel"].scale, terms["base_ang_vel"].scale = 2.0, 0.25


def the_root_s_own_turn(cfg):
    cfg.observations["actor"].terms["base_ang_vel"] = ObservationTermCfg(func=mdp.base_ang_vel)


@pytest.mark.parametrize("edit", [other_scales, the_root_s_own_turn])
def test_the_lever_arm_is_mirrored_from_whatever_shows_the_turn(edit):
    env = make_env(FLAT_GO1, edit)
    torch.manual_seed(3)
    put_before_mirror(env, 1.1, turning=10.0)
    seen = TensorDict(env.observation_manager.compute(update_history=True), batch_size=[2])
    image = mirror_left_right(env, seen)[0]["actor"][2, :6]
    torch.testing.assert_close(image, seen["actor"][1, :6], atol=1e-4, rtol=1e-4)
    env.close()


def test_a_mirror_image_of_the_mirror_image_is_the_original():
    env = make_env(FLAT_GO1)
    torch.manual_seed(0)
    seen = TensorDict(env.observation_manager.compute(), batch_size=[2]).apply(torch.randn_like)
    actions = torch.randn(2, 12)
    once = mirror_left_right(env, seen, actions)
    twice = mirror_left_right(env, once[0][2:], once[1][2:])
    for group in set(seen.keys()):
        torch.testing.assert_close(twice[0][group][2:], seen[group])
        assert not torch.allclose(once[0][group][2:], seen[group])
    torch.testing.assert_close(twice[1][2:], actions)
    env.close()


def unknown_term(cfg):
    cfg.observations["actor"].terms["clock"] = ObservationTermCfg(
        func=lambda env: torch.zeros(env.num_envs, 1)
    )


def a_selection_of_joints(cfg):
    cfg.observations["actor"].terms["joint_vel"].params["asset_cfg"] = SceneEntityCfg(
        "robot", joint_names=("FL_.*",)
    )


def a_velocity_of_more_times(cfg):
    cfg.observations["actor"].terms["base_lin_vel"].history_length = 3


def no_angular_velocity(cfg):
    del cfg.observations["actor"].terms["base_ang_vel"]


def an_angular_velocity_of_another_time(cfg):
    cfg.observations["critic"].terms["base_ang_vel"].delay_max_lag = 2


def an_accelerometer_on_one_side(cfg):
    sensor = BuiltinSensorCfg(
        name="acceleration",
        sensor_type="accelerometer",
        obj=ObjRef(type="site", name="imu", entity="robot"),
    )
    cfg.scene.sensors += (sensor,)
    cfg.observations["actor"].terms["acceleration"] = ObservationTermCfg(
        func=mdp.builtin_sensor, params={"sensor_name": "robot/acceleration"}
    )


def a_gyro_on_a_leg(cfg):
    sensor = BuiltinSensorCfg(
        name="turn", sensor_type="gyro", obj=ObjRef(type="site", name="FL", entity="robot")
    )
    cfg.scene.sensors += (sensor,)
    cfg.observations["actor"].terms["turn"] = ObservationTermCfg(
        func=mdp.builtin_sensor, params={"sensor_name": "robot/turn"}
    )


def rays_from_one_side(cfg):
    scan = RayCastSensorCfg(
        name="scan",
        frame=ObjRef(type="site", name="imu", entity="robot"),
        pattern=GridPatternCfg(size=(0.2, 0.2), resolution=0.1),
    )
    cfg.scene.sensors += (scan,)
    cfg.observations["actor"].terms["scan"] = ObservationTermCfg(
        func=mdp.height_scan, params={"sensor_name": "scan"}
    )


def a_pose_that_leans(cfg):
    cfg.scene.entities["robot"].init_state.joint_pos = {"FL_hip_joint": 0.4}


def a_history_that_is_not_flattened(cfg):
    cfg.observations["critic"].terms["base_lin_vel"].history_length = 3
    cfg.observations["critic"].terms["base_lin_vel"].flatten_history_dim = False
    cfg.observations["critic"].concatenate_terms = False


def a_scale_for_each_joint(cfg):
    cfg.observations["actor"].terms["joint_pos"].scale = tuple(range(1, 13))


def a_clip_to_one_side(cfg):
    cfg.observations["actor"].terms["joint_pos"].clip = (-1.0, 3.0)


def joints_in_an_order_of_their_own(cfg):
    cfg.observations["actor"].terms["joint_vel"].params["asset_cfg"] = SceneEntityCfg(
        "robot", joint_names=("RL.*", "RR.*", "FL.*", "FR.*"), preserve_order=True
    )


def actions_of_one_side(cfg):
    cfg.actions["joint_pos"].actuator_names = (".L_.*",)


def a_stronger_left(cfg):
    cfg.actions["joint_pos"].scale = {".L_.*": 0.5, ".R_.*": 0.25}


def rays_from_two_frames(cfg):
    (scan,) = [sensor for sensor in cfg.scene.sensors if sensor.name == "foot_height_scan"]
    cfg.observations["actor"].terms["height_scan"] = ObservationTermCfg(
        func=mdp.height_scan, params={"sensor_name": scan.name}
    )


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (unknown_term, "actor/clock: .*does not support"),
        (a_selection_of_joints, "joints of both sides, got .*FL_calf_joint"),
        (a_velocity_of_more_times, "actor/base_lin_vel: .*angular velocity"),
        (a_history_that_is_not_flattened, "'critic': .*concatenate_terms=False"),
        (a_scale_for_each_joint, "actor/joint_pos: .*scale"),
        (a_clip_to_one_side, "actor/joint_pos: .*clip"),
        (joints_in_an_order_of_their_own, "preserve_order=True"),
        (actions_of_one_side, "joints of both sides"),
        (a_stronger_left, "same scale on both sides"),
        (no_angular_velocity, "actor/base_lin_vel: .*-0.0666 m"),
        (an_angular_velocity_of_another_time, "critic/base_lin_vel: .*the same fixed delay"),
        (an_accelerometer_on_one_side, "Accelerometer 'robot/acceleration': .*-0.0666 m"),
        (a_gyro_on_a_leg, "'robot/turn': .*'robot/FL_calf'"),
        (rays_from_one_side, "'scan': .*symmetric rays"),
        (rays_from_two_frames, "'foot_height_scan': .*symmetric rays"),
        (a_pose_that_leans, "Joint 'FR_hip_joint' is not the mirror image of 'FL_hip_joint'"),
    ],
)
def test_what_has_no_known_mirror_image_is_refused(edit, message):
    env = make_env(FLAT_GO1, edit)
    with pytest.raises(ValueError, match=message) as caught:
        mirror_left_right(env, actions=torch.zeros(2, 12))
    assert "symmetry_cfg to None" in str(caught.value)
    env.close()


def two_legs(names, xs=(0.0, 0.0)):
    """Return a robot of two legs to the left and right, and its model."""
    robot = SimpleNamespace(
        joint_names=names,
        data=SimpleNamespace(default_joint_pos=torch.zeros(1, 2)),
        indexing=SimpleNamespace(root_body_id=1, joint_ids=torch.tensor([0, 1])),
    )
    legs = "".join(
        f'<body pos="{x} {y} 0"><joint name="{name}" axis="0 1 0"/><geom size=".1"/></body>'
        for name, x, y in zip(names, xs, (0.1, -0.1), strict=True)
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="trunk"><geom size=".1"/>{legs}</body></worldbody></mujoco>'
    )
    return model, robot


@pytest.mark.parametrize("names", [("LF_HAA", "RF_HAA"), ("hl_knee", "hr_knee"), ("a", "b")])
def test_legs_of_any_name_are_mirrored(names):
    mirror = mirror_of_joints(*two_legs(names))
    assert mirror.sources.tolist() == [1, 0]
    assert mirror.signs.tolist() == [1.0, 1.0]


def test_joints_of_an_asymmetric_robot_are_named():
    with pytest.raises(ValueError, match="'trunk'.* a .*20 mm.* b ") as caught:
        mirror_of_joints(*two_legs(("a", "b"), xs=(0.0, 0.02)))
    assert "pairs" in str(caught.value)
    model, robot = two_legs(("a", "b"), xs=(0.0, 0.02))
    assert mirror_of_joints(model, robot, pairs={"a": "b"}).sources.tolist() == [1, 0]


def test_pairs_replace_partners_of_joints_and_feet():
    env = make_env(FLAT_GO1)
    sides = {"FL": "RR", "FR": "RL"}
    pairs = {f"{a}_hip_joint": f"{b}_hip_joint" for a, b in sides.items()}
    pairs |= {f"{a}_foot_collision": f"{b}_foot_collision" for a, b in sides.items()}
    names = env.action_manager.get_term("joint_pos").target_names
    actions = torch.arange(1.0, 1.0 + len(names)).expand(2, -1)
    seen = TensorDict(env.observation_manager.compute(), batch_size=[2])
    (columns,) = [c for name, c in term_columns(env, "critic") if name == "foot_air_time"]
    feet = env.scene["feet_ground_contact"].primary_names
    seen["critic"][:, columns] = torch.arange(4.0)
    image, moved = mirror_left_right(env, seen, actions, pairs=pairs)
    other = sides | {b: a for a, b in sides.items()}
    for name, value in zip(names, moved[2].tolist(), strict=True):
        leg, joint = name[:2], name[2:]
        partner = other[leg] if joint == "_hip_joint" else leg[0] + {"L": "R", "R": "L"}[leg[1]]
        assert abs(value) == 1 + names.index(partner + joint)
    expected = [feet.index(other[foot[:2]] + foot[2:]) for foot in feet]
    assert image["critic"][2, columns].tolist() == expected
    # Without them, the same environment is mirrored left to right again.
    torch.testing.assert_close(mirrored_rows(env, moved[:2])[:2], actions)
    assert mirrored_rows(env, actions)[2].abs().tolist() != moved[2].abs().tolist()
    env.close()


def test_a_selection_of_both_sides_is_mirrored():
    def hips(cfg):
        cfg.observations["actor"].terms["joint_vel"].params["asset_cfg"] = SceneEntityCfg(
            "robot", joint_names=(".*_hip_joint",)
        )

    env = make_env(FLAT_GO1, hips)
    seen = TensorDict(env.observation_manager.compute(), batch_size=[2])
    (columns,) = [c for name, c in term_columns(env, "actor") if name == "joint_vel"]
    joints = env.scene["robot"].find_joints(".*_hip_joint")[1]
    seen["actor"][:, columns] = torch.arange(1.0, 5.0)
    image = mirror_left_right(env, seen)[0]["actor"][2, columns]
    other = [joints.index(name[0] + {"L": "R", "R": "L"}[name[1]] + name[2:]) for name in joints]
    assert image.tolist() == [-1.0 - i for i in other]
    env.close()


def test_a_joint_that_slides_is_mirrored_as_a_direction():
    robot = SimpleNamespace(
        joint_names=("left_slide", "right_slide", "left_turn", "right_turn"),
        data=SimpleNamespace(default_joint_pos=torch.zeros(1, 4)),
        indexing=SimpleNamespace(root_body_id=1, joint_ids=torch.arange(4)),
    )
    side = (
        '<body pos="0 {y} 0"><joint name="{side}_slide" type="slide" axis="0 1 0"/>'
        '<geom size=".1"/></body>'
    )
    turn = '<body pos="1 {y} 0"><joint name="{side}_turn" axis="0 1 0"/><geom size=".1"/></body>'
    bodies = "".join(
        part.format(y=y, side=name)
        for part in (side, turn)
        for name, y in (("left", 0.1), ("right", -0.1))
    )
    # The result must not depend on the rotation of the root by 90 degrees.
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body euler="0 0 90"><geom size=".1"/>{bodies}</body></worldbody></mujoco>'
    )
    mirror = mirror_of_joints(model, robot)
    assert mirror.sources.tolist() == [1, 0, 3, 2]
    assert mirror.signs.tolist() == [-1.0, -1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("rows", "got"),
    [(lambda rows: rows, "got 2 observations"), (lambda rows: rows[:1], "got 1 observations")],
)
def test_a_symmetry_without_mirrored_rows_warns(rows, got):
    env = RslRlVecEnvWrapper(make_env(FLAT_GO1))
    rl_cfg = load_rl_cfg(FLAT_GO1)
    rl_cfg.algorithm.symmetry_cfg = {
        "data_augmentation_func": lambda env, obs, actions: (rows(obs), actions),
        "use_data_augmentation": True,
    }
    with pytest.warns(UserWarning, match=f"symmetry_cfg.*{got}"):
        MjlabOnPolicyRunner(env, asdict(rl_cfg), None, "cpu")
    env.close()


def test_mirror_images_can_be_switched_off_by_a_flag():
    flags = ["--profile", "cpu", "--agent.algorithm.symmetry-cfg", "None"]
    assert parse_train_flags(FLAT_GO1, flags[:2], "train").agent.algorithm.symmetry_cfg is not None
    assert parse_train_flags(FLAT_GO1, flags, "train").agent.algorithm.symmetry_cfg is None


def test_the_cpu_profile_learns_from_mirror_images(tmp_path):
    cfg, rl_cfg = load_env_cfg(FLAT_GO1, profile="cpu"), load_rl_cfg(FLAT_GO1, profile="cpu")
    cfg.scene.num_envs = 8
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    runner = MjlabOnPolicyRunner(env, asdict(rl_cfg), str(tmp_path), "cpu")
    sizes = []
    runner.alg.actor.register_forward_pre_hook(
        lambda module, args: sizes.append(args[0].batch_size[0])
    )
    runner.learn(1)
    # A mini-batch is a quarter of 8 environments times 8 steps, and its mirror image.
    assert max(sizes) == 2 * 8 * 8 // 4
    assert (tmp_path / "model_0.pt").exists()
    env.close()
