"""`EntityData` against plain MuJoCo: every property, in states that differ between environments."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityArticulationInfoCfg
from mjlab.entity.data import compute_velocity_from_cvel

TOLERANCE = {"rtol": 1e-4, "atol": 1e-4}


def object_velocity(model, data, kind, index):
    """Linear then angular world velocity of an object, from MuJoCo itself."""
    result = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, index, result, 0)
    return np.concatenate((result[3:], result[:3]))


def check(actual, expected):
    torch.testing.assert_close(
        actual, torch.tensor(np.array(expected), dtype=torch.float32), **TOLERANCE
    )


@pytest.fixture(params=["ROBOT", "ARM", "TWO_TREES"])
def world(kit, request):
    """One of the models beside another entity, so that no address starts at zero."""
    sim, scene = kit.make(other=kit.cfg(kit.ROBOT), robot=kit.cfg(getattr(kit, request.param)))
    references = kit.randomize(sim)
    return sim.mj_model, references, scene["robot"]


def test_poses_and_velocities_of_bodies_agree_with_mujoco(world):
    model, references, entity = world
    data, ids = entity.data, entity.indexing.body_ids.tolist()
    check(data.body_link_pos_w, [d.xpos[ids] for d in references])
    check(data.body_link_quat_w, [d.xquat[ids] for d in references])
    check(data.body_com_pos_w, [d.xipos[ids] for d in references])
    xbody, body = mujoco.mjtObj.mjOBJ_XBODY, mujoco.mjtObj.mjOBJ_BODY
    link = [[object_velocity(model, d, xbody, i) for i in ids] for d in references]
    com = [[object_velocity(model, d, body, i) for i in ids] for d in references]
    check(data.body_link_vel_w, link)
    check(data.body_com_vel_w, com)
    check(data.root_link_vel_w, np.array(link)[:, 0])
    check(data.root_com_vel_w, np.array(com)[:, 0])
    for env, reference in enumerate(references):
        for column, i in enumerate(ids):
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, data.body_com_quat_w[env, column].double().numpy())
            np.testing.assert_allclose(matrix, reference.ximat[i], atol=1e-4)


@pytest.mark.parametrize("chosen", [slice(1, None), torch.tensor([-1, 0])])
def test_velocities_of_some_links_are_those_of_all_that_are_chosen(world, chosen):
    data = world[2].data
    for one in ("lin", "ang"):
        some = getattr(data, f"link_{one}_vel_of")(chosen)
        torch.testing.assert_close(some, getattr(data, f"body_link_{one}_vel_w")[:, chosen])


def test_geoms_and_sites_agree_with_mujoco(world):
    model, references, entity = world
    data = entity.data
    for kind, obj in (("geom", mujoco.mjtObj.mjOBJ_GEOM), ("site", mujoco.mjtObj.mjOBJ_SITE)):
        ids = getattr(entity.indexing, f"{kind}_ids").tolist()
        assert ids
        check(getattr(data, f"{kind}_pos_w"), [getattr(d, f"{kind}_xpos")[ids] for d in references])
        velocity = [[object_velocity(model, d, obj, i) for i in ids] for d in references]
        check(getattr(data, f"{kind}_vel_w"), velocity)
        quat = getattr(data, f"{kind}_quat_w")
        assert (quat.gather(-1, quat.abs().argmax(-1, keepdim=True)) > 0).all()
        for env, reference in enumerate(references):
            for column, i in enumerate(ids):
                matrix = np.zeros(9)
                mujoco.mju_quat2Mat(matrix, quat[env, column].double().numpy())
                expected = getattr(reference, f"{kind}_xmat")[i]
                np.testing.assert_allclose(matrix, expected, atol=1e-4)


def test_joint_and_force_fields_agree_with_mujoco(world):
    model, references, entity = world
    data = entity.data
    q, v = entity.indexing.joint_q_adr.tolist(), entity.indexing.joint_v_adr.tolist()
    check(data.joint_pos, [d.qpos[q] for d in references])
    check(data.joint_vel, [d.qvel[v] for d in references])
    torch.testing.assert_close(
        data.joint_acc,
        torch.tensor(np.array([d.qacc[v] for d in references]), dtype=torch.float32),
        rtol=1e-3,
        atol=1e-2,
    )
    # Generalized forces of the applied wrenches, computed from Jacobians.
    expected = []
    for reference in references:
        force = np.zeros(model.nv)
        for body in range(1, model.nbody):
            mujoco.mj_applyFT(
                model, reference, reference.xfrc_applied[body, :3],
                reference.xfrc_applied[body, 3:], reference.xipos[body], body, force,
            )  # fmt: skip
        expected.append(force[v])
    check(data.qfrc_external, expected)
    check(data.qfrc_actuator, np.zeros((3, len(v))))


def test_forces_of_wrenches_belong_to_one_moment(kit):
    """Also where velocities are newer than accelerations, as in observations."""
    sim, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    kit.randomize(sim)
    sim.data.xfrc_applied.zero_()
    sim.step()
    sim.data.qvel.mul_(3.0)
    sim.forward(stage="vel")
    check(scene["robot"].data.qfrc_external, torch.zeros(3, 2).numpy())


def test_frames_of_the_root(kit):
    sim, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    references = kit.randomize(sim)
    data = scene["robot"].data
    matrices = np.array([d.xmat[1].reshape(3, 3) for d in references])
    check(data.projected_gravity_b, matrices.transpose(0, 2, 1) @ [0.0, 0.0, -1.0])
    forward = matrices @ [1.0, 0.0, 0.0]
    check(data.heading_w, np.arctan2(forward[:, 1], forward[:, 0]))
    for name in ("root_link_lin_vel", "root_link_ang_vel", "root_com_lin_vel", "root_com_ang_vel"):
        world_frame = getattr(data, f"{name}_w").double().numpy()
        check(getattr(data, f"{name}_b"), np.einsum("nji,nj->ni", matrices, world_frame))


def test_tendons_agree_with_mujoco(kit):
    sim, scene = kit.make(other=kit.cfg(kit.ARM), arm=kit.cfg(kit.ARM))
    references = kit.randomize(sim)
    index = scene["arm"].indexing.tendon_ids.tolist()
    check(scene["arm"].data.tendon_len, [d.ten_length[index] for d in references])
    check(scene["arm"].data.tendon_vel, [d.ten_velocity[index] for d in references])


def test_each_tree_has_its_own_center_of_mass(kit):
    """Velocities about the first body's center of mass would be off by meters per second."""
    sim, scene = kit.make(num_envs=1, pair=kit.cfg(kit.TWO_TREES))
    sim.data.qpos[0, 0] = 5.0
    sim.data.qvel[:] = 0.0
    sim.data.qvel[0, scene["pair"].indexing.joint_v_adr[1]] = 1.0
    sim.forward()
    # The hinge is at (0, 0.3) of the second body: its origin circles it at 1 rad/s.
    velocity = scene["pair"].data.body_link_lin_vel_w[0, 1]
    torch.testing.assert_close(velocity, torch.tensor([0.3, 0.0, 0.0]), rtol=0, atol=1e-5)


def test_velocity_from_cvel_of_a_spinning_point():
    pos, com = torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    cvel = torch.tensor([[0.0, 0.0, 3.0, 0.5, 0.0, 0.0]])
    velocity = compute_velocity_from_cvel(pos, com, cvel)
    assert velocity.tolist() == [[0.5, 3.0, 0.0, 0.0, 0.0, 3.0]]


def test_encoder_bias_shifts_only_the_biased_positions(kit):
    sim, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    kit.randomize(sim)
    data = scene["robot"].data
    before = data.joint_pos.clone()
    data.encoder_bias[:] = 0.25
    torch.testing.assert_close(data.joint_pos_biased, before + 0.25)
    torch.testing.assert_close(data.joint_pos, before)


def test_joint_limits_hard_soft_and_absent(kit):
    cfg = kit.cfg(
        kit.ROBOT, articulation=EntityArticulationInfoCfg(soft_joint_pos_limit_factor=0.5)
    )
    _, scene = kit.make(num_envs=2, robot=cfg)
    data = scene["robot"].data
    expected = torch.tensor([[-1.0, 2.0], [-torch.inf, torch.inf]]).expand(2, 2, 2)
    torch.testing.assert_close(data.joint_pos_limits, expected)
    torch.testing.assert_close(data.default_joint_pos_limits, expected)
    torch.testing.assert_close(
        data.soft_joint_pos_limits[1], torch.tensor([[-0.25, 1.25], [-torch.inf, torch.inf]])
    )


def test_only_fields_that_are_read_are_asked_for(kit):
    """On the native engine every field that was asked for is copied out after every call."""

    class Recorder:
        nworld = 2

        def __init__(self, data):
            self.data, self.asked = data, []

        def __getattr__(self, name):
            self.asked.append(name)
            return getattr(self.data, name)

    sim, scene = kit.make(num_envs=2, robot=kit.cfg(kit.ROBOT))
    recorder = Recorder(sim.data)
    entity = scene["robot"]
    entity.initialize(sim.mj_model, sim.model, recorder, "cpu")
    entity.reset()
    assert recorder.asked == []
    _ = entity.data.joint_pos
    assert set(recorder.asked) == {"qpos"}
    _ = entity.data.root_link_ang_vel_w
    assert set(recorder.asked) == {"qpos", "cvel"}


def test_fields_of_neighboring_elements_are_views(kit):
    sim, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    data = scene["robot"].data
    for view, source in (
        (data.joint_pos, sim.data.qpos),
        (data.joint_vel, sim.data.qvel),
        (data.body_link_pos_w, sim.data.xpos),
        (data.root_link_pos_w, sim.data.xpos),
    ):
        assert view.untyped_storage().data_ptr() == source.untyped_storage().data_ptr()


def test_reading_follows_the_simulation(kit):
    sim, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    data = scene["robot"].data
    first = data.joint_pos.clone(), data.body_link_pos_w.clone()
    kit.randomize(sim, seed=3)
    assert not torch.allclose(data.joint_pos, first[0])
    assert not torch.allclose(data.body_link_pos_w, first[1])


def test_joint_torques_says_what_to_use_instead(kit):
    _, scene = kit.make(robot=kit.cfg(kit.ROBOT))
    with pytest.raises(NotImplementedError, match="qfrc_actuator.*actuator_force"):
        _ = scene["robot"].data.joint_torques


def test_data_before_initialize_says_what_to_call(kit):
    with pytest.raises(RuntimeError, match="Scene.initialize"):
        _ = kit.cfg(kit.ROBOT).build().data
