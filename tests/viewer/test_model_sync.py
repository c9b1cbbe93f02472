"""Copies of model fields and state from a simulation to the host."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from viewer_fakes import FakeEnv

from mjlab.viewer.model_sync import compute_poses, copy_state, host_model, sync_model_fields


def test_only_fields_that_are_drawn_are_copied_and_only_of_one_environment() -> None:
    env = FakeEnv(2)
    model = host_model(env.sim.mj_model)
    rgba = torch.rand(2, model.ngeom, 4)
    env.sim.expand("geom_rgba", rgba)
    env.sim.expand("dof_damping", torch.full((2, model.nv), 9.0))
    sync_model_fields(model, env.sim.model, env.sim.expanded_fields, 1)
    np.testing.assert_allclose(model.geom_rgba, rgba[1], rtol=1e-6)
    assert not (model.dof_damping == 9.0).any()
    assert not np.allclose(env.sim.mj_model.geom_rgba, rgba[1])


def test_moved_geoms_are_drawn_moved() -> None:
    env = FakeEnv(1)
    geom = env.sim.mj_model.geom("cartpole/cart").id
    assert env.sim.mj_model.geom_sameframe[geom] != 0
    model = host_model(env.sim.mj_model)
    model.geom_pos[geom] = (0.0, 0.0, 0.5)
    data = mujoco.MjData(model)
    compute_poses(model, data)
    np.testing.assert_allclose(data.geom_xpos[geom], [0.0, 0.0, 1.5])


def test_state_comes_alike_from_a_simulation_its_data_and_a_plain_mjdata() -> None:
    env = FakeEnv(2)
    env.step(torch.tensor([[0.5], [1.0]]))
    expected = env.sim.datas[1]
    for source, index in ((env.sim, 1), (env.sim.data, 1), (expected, 0)):
        data = mujoco.MjData(env.sim.mj_model)
        copy_state(source, index, data)
        np.testing.assert_allclose(data.qpos, expected.qpos, rtol=1e-6)
        np.testing.assert_allclose(data.qvel, expected.qvel, rtol=1e-6)
        np.testing.assert_allclose(data.ctrl, expected.ctrl)
        np.testing.assert_allclose(data.time, expected.time, rtol=1e-6)
