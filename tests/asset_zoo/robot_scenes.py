"""Robots on flat ground, and what their tests have in common there."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import torch
from robot_figures import VISUAL_GROUP

from mjlab.entity import Entity, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg


def compiled(cfg: EntityCfg, **changes) -> mujoco.MjModel:
    """Return the robot's model alone, with some fields of its config changed."""
    for field, value in changes.items():
        setattr(cfg, field, value)
    return cfg.build().compile()


def scene_of(cfg: EntityCfg, options: MujocoCfg, num_envs: int = 1) -> tuple[Scene, Simulation]:
    """Return a plane with the entity `robot` on it, and its simulation with a task's `options`."""
    scene = Scene(
        SceneCfg(num_envs=num_envs, entities={"robot": cfg}, terrain=TerrainEntityCfg()),
        device="cpu",
    )
    sim_cfg = SimulationCfg(engine="native", mujoco=options)
    sim = Simulation(num_envs, sim_cfg, model=scene.compile(), device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return scene, sim


def place(scene: Scene, lift: float | torch.Tensor = 0.0) -> Entity:
    """Put the robot into its initial state, `lift` meters higher, and let it hold it; return it."""
    robot: Entity = scene["robot"]
    robot.set_joint_position_target(robot.data.default_joint_pos)
    root = robot.data.default_root_state.clone()
    root[:, :3] += scene.env_origins
    root[:, 2] += lift
    robot.write_root_state_to_sim(root)
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, robot.data.default_joint_vel)
    scene.write_data_to_sim()
    return robot


def turn_on_its_side(sim: Simulation) -> None:
    """Turn the robot by a quarter about x, to the left, so that its y axis points up."""
    sim.data.qpos[:] = torch.tensor(sim.mj_model.key_qpos[0], dtype=torch.float32)
    sim.data.qpos[0, 3:7] = torch.tensor([0.5**0.5, 0.5**0.5, 0, 0])


def check_light(model: mujoco.MjModel) -> None:
    """Check the one light of a robot: a spot above it that follows its center of mass."""
    assert model.light_mode.tolist() == [mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM]
    light = model.light(0)
    assert light.type[0] == mujoco.mjtLightType.mjLIGHT_SPOT
    np.testing.assert_allclose(light.pos, [0, 0, 2])
    np.testing.assert_allclose(light.dir, [0, 0, -1])
    np.testing.assert_allclose(light.diffuse, 0.7)
    np.testing.assert_allclose(light.specular, 0.3)
    np.testing.assert_allclose(light.ambient, 0.0)
    assert (light.cutoff[0], light.exponent[0]) == (45, 10)


def check_drawing_changes_nothing(
    cfg: EntityCfg, options: MujocoCfg, pose: dict[int, float], at_least: int
) -> None:
    """Check that masses and a second of lying about are the same without what is drawn only.

    `pose` are elements of `qpos` that lay the robot down, so that much of it touches the ground.
    `at_least` geoms are drawn only.
    """
    drawn, bare = (scene_of(one, options)[1].mj_model for one in (cfg, _without_drawing(cfg)))
    assert drawn.ngeom >= bare.ngeom + at_least
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_invweight0"):
        np.testing.assert_array_equal(getattr(drawn, field), getattr(bare, field))
    (touching, qpos), (touching_bare, qpos_bare) = (_end_of_a_fall(m, pose) for m in (drawn, bare))
    assert touching == touching_bare
    assert touching
    np.testing.assert_array_equal(qpos, qpos_bare)


def _without_drawing(cfg: EntityCfg) -> EntityCfg:
    def spec_fn() -> mujoco.MjSpec:
        spec = cfg.spec_fn()
        for geom in list(spec.geoms):
            if geom.group == VISUAL_GROUP:
                spec.delete(geom)
        return spec

    bare = copy.copy(cfg)
    bare.spec_fn = spec_fn
    return bare


def _end_of_a_fall(
    model: mujoco.MjModel, pose: dict[int, float]
) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Return the geoms that touch and the positions, after a second that starts in `pose`."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for index, value in pose.items():
        data.qpos[index] = value
    mujoco.mj_step(model, data, nstep=200)
    names = [
        (model.geom(contact.geom1).name, model.geom(contact.geom2).name)
        for contact in data.contact[: data.ncon]
    ]
    return names, data.qpos.copy()
