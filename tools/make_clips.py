"""Record the clips of the README: `python tools/make_clips.py [NAME ...] --run lift=FOLDER`.

Animated WebP of 480 x 270 pixels at 25 frames per second, below 500 KB each; the first one of the README
is larger, and its animated pictures have 1.5 MB in all. Clips of policies that do not ship with the package need the run folder of a training, for example

    uv run mjlab train Mjlab-Lift-Cube-Yam --profile cpu
    uv run python tools/make_clips.py lift --run lift=logs/rsl_rl/yam_lift_cube/<time>
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import torch
import tyro
from PIL import Image

from mjlab.rl.checkpoint import latest_checkpoint
from mjlab.runs.policy import make_env, make_policy
from mjlab.scripts.demo import DEMOS
from mjlab.tasks.registry import load_env_cfg
from mjlab.terrains import (
    BoxInvertedPyramidStairsTerrainCfg,
    SubTerrainCfg,
    TerrainEntityCfg,
    TerrainGeneratorCfg,
)
from mjlab.viewer.model_sync import compute_poses, copy_state, host_model
from mjlab.viewer.native.visualizer import add_moving_geoms
from mjlab.viewer.offscreen_renderer import open_renderer

_IMAGES = Path(__file__).parents[1] / "docs" / "images"
_FPS = 25
# Frames are rendered larger and downsampled for antialiasing.
_OVERSAMPLING = 2
_HORIZON = (0.93, 0.94, 0.96)
_BOX = (0.68, 0.71, 0.75, 1.0)


@dataclass(frozen=True)
class Clip:
    """Clip of a policy."""

    task: str
    """Task of the policy."""
    profile: str | None = "cpu"
    """Profile of the training."""
    policy: Path | None = None
    """Bundled policy. None: checkpoint of a run folder passed by `--run`."""
    num_envs: int = 1
    """Number of environments, all in view."""
    spacing: float = 1.0
    """Distance between environments (m)."""
    command: dict[str, tuple[float, float]] | None = None
    """Ranges of the velocity command; None: those of the task."""
    terrain: SubTerrainCfg | None = None
    """Terrain below the robot. None: that of the task."""
    motion: str | None = None
    """Motion of a tracking task."""
    start: float = 0.0
    """Time before the first frame (s)."""
    seconds: float = 4.0
    """Duration (s)."""
    speed: float = 1.0
    """Speed of the clip relative to real time."""
    body: str | None = None
    """Body whose mean over the environments the camera follows in x and y. None: fixed camera."""
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Camera target, relative to the followed place (m)."""
    distance: float = 2.0
    """Distance from the camera to its target (m)."""
    azimuth: float = 120.0
    """Azimuth of the view (degrees)."""
    elevation: float = -14.0
    """Elevation of the view (degrees)."""
    hidden_sites: bool = True
    """Hide sites."""
    size: tuple[int, int] = (480, 270)
    """Width and height (pixels)."""
    max_bytes: int = 500_000
    """Limit of the file's size."""


CLIPS = {
    # The view of the model's camera `side`, as in clips of users.
    "swingup": Clip(
        "Mjlab-Cartpole-Swingup", lookat=(0.0, 0.0, 1.0), distance=5.0, azimuth=90.0,
        elevation=-22.0, seconds=5.0,
    ),
    "go1": Clip(
        DEMOS["go1"].task, None, DEMOS["go1"].policy, num_envs=6, spacing=0.9,
        command={"lin_vel_x": (0.9, 0.9), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
        start=2.0, seconds=3.0, body="robot/trunk", lookat=(0.0, 0.0, 0.2), distance=3.0, azimuth=145.0,
    ),
    "go1_stairs": Clip(
        DEMOS["go1"].task, None, DEMOS["go1"].policy,
        command={"lin_vel_x": (1.0, 1.0), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
        terrain=BoxInvertedPyramidStairsTerrainCfg(
            size=(6.0, 6.0), step_height_range=(0.03, 0.03), step_width=0.3, platform_width=1.8
        ),
        start=0.9, seconds=3.0, body="robot/trunk", lookat=(0.0, 0.0, 0.05), distance=2.0, azimuth=105.0,
        elevation=-14.0,
    ),
    "g1": Clip(
        DEMOS["g1"].task, "cpu", DEMOS["g1"].policy, num_envs=2, spacing=1.2,
        command={"lin_vel_x": (0.8, 0.8), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
        start=3.0, seconds=3.0, body="robot/pelvis", lookat=(0.0, 0.0, 0.62), distance=3.0, azimuth=150.0,
        size=(720, 405), max_bytes=700_000,
    ),
    "g1_rough": Clip(
        "Mjlab-Velocity-Rough-Unitree-G1",
        command={"lin_vel_x": (0.8, 0.8), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
        terrain=BoxInvertedPyramidStairsTerrainCfg(
            size=(8.0, 8.0), step_height_range=(0.06, 0.06), step_width=0.3, platform_width=2.0
        ),
        start=1.0, seconds=4.0, speed=2.0, body="robot/pelvis", lookat=(0.0, 0.0, 0.5), distance=3.4,
        azimuth=110.0,
    ),
    "lift": Clip(
        "Mjlab-Lift-Cube-Yam", lookat=(0.25, 0.0, 0.22), distance=1.2, azimuth=130.0, elevation=-16.0,
        seconds=3.0,
    ),
    "multi_cube": Clip(
        "Mjlab-Multi-Cube-Seg-Yam", "student", lookat=(0.25, 0.0, 0.22), distance=1.2, azimuth=130.0,
        elevation=-16.0, seconds=6.0, speed=2.0,
    ),
    "g1_tracking": Clip(
        DEMOS["g1-tracking"].task, None, DEMOS["g1-tracking"].policy, motion="squat", seconds=4.0,
        body="robot/pelvis", lookat=(0.0, 0.0, 0.7), distance=2.9, azimuth=150.0,
    ),
    "five_motions": Clip(
        "Mjlab-Tracking-Flat-Unitree-G1", num_envs=5, spacing=1.4,
        motion="squat,wave,side_step,slow_walk,turn_in_place", seconds=4.4,
        body="robot/pelvis", lookat=(0.0, 0.0, 0.6), distance=4.8, azimuth=115.0,
        elevation=-20.0,
    ),
}  # fmt: skip
# Packages that `mjlab new-robot` writes, installed: trunk and standing height (m), of four and two legs.
_QUADRUPEDS = {
    "Aliengo": ("base", 0.337),
    "Mini-Cheetah": ("base", 0.317),
    "B2": ("base", 0.467),
    "Spot": ("body", 0.464),
    "Hyqreal2": ("base", 0.494),
    "Go2": ("base", 0.288),  # docs/images/own_robot.webp
}
_BIPEDS = {
    "T1": ("Trunk", 0.665),
    "H1": ("pelvis", 0.99),
    "Berkeley-Humanoid": ("torso", 0.518),
    "Apptronik-Apollo": ("torso_link", 1.022),  # docs/images/own_apollo.webp
}


# Height commanded 1 m/s (m); height of the whole robot and distance of the camera over that of the trunk.
for _robots, _reference, _whole, _distance in (
    (_QUADRUPEDS, 0.28, 1.0, 6.0),
    (_BIPEDS, 0.76, 1.7, 4.5),
):
    for _title, (_trunk, _height) in _robots.items():
        _speed = 0.8 * (_height / _reference) ** 0.5
        CLIPS[f"own_{_title.lower().replace('-', '_')}"] = Clip(
            f"Velocity-Flat-{_title}", "cpu",
            command={"lin_vel_x": (_speed, _speed), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (0.0, 0.0)},
            start=2.0, seconds=2.0, body=f"robot/{_trunk}",
            lookat=(0.0, 0.0, 0.5 * _whole * _height), distance=_distance * _height, azimuth=125.0,
        )  # fmt: skip

for _title, _height, _distance in (("Ur5e", 0.5, 3.0), ("Openarm", 0.4, 2.2)):
    CLIPS[f"own_{_title.lower()}"] = Clip(
        f"Reach-{_title}", lookat=(0.1, 0.0, _height), distance=_distance, azimuth=140.0, seconds=4.0,
        speed=2.0,
    )  # fmt: skip


@dataclass
class Args:
    """Flags."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = tuple(CLIPS)
    """Clips to record."""
    run: tuple[str, ...] = ()
    """Run folders, as NAME=FOLDER."""
    folder: Path = _IMAGES
    """Folder of the clips."""
    seed: int = 1
    """Seed of the episodes."""
    frames: Path | None = field(default=None)
    """Folder for the frames as PNG. None: none."""


def main(args: Args) -> None:
    """Record the clips."""
    runs = dict(item.split("=", 1) for item in args.run)
    for name in args.names:
        clip = CLIPS[name]
        if clip.policy is None and name not in runs:
            raise SystemExit(f"--run: expected {name}=FOLDER of a run of {clip.task}.")
        policy = clip.policy or latest_checkpoint(Path(runs[name]))
        if policy is None:
            raise SystemExit(f"{runs[name]}: expected a checkpoint, found none.")
        frames = record(clip, policy, args.seed)
        path = args.folder / f"{name}.webp"
        save(frames, path, clip.max_bytes)
        if args.frames is not None:
            args.frames.mkdir(parents=True, exist_ok=True)
            for index in range(0, len(frames), 15):
                Image.fromarray(frames[index]).save(args.frames / f"{name}_{index:03d}.png")
        print(f"{path}: {path.stat().st_size // 1000} kB, {len(frames)} frames")


def save(frames: list[np.ndarray], path: Path, max_bytes: int) -> None:
    """Write an animated WebP, at the best quality below the limit of its size."""
    first, *rest = [Image.fromarray(frame) for frame in frames]
    for quality in (80, 70, 60, 50, 40):
        first.save(
            path, save_all=True, append_images=rest, duration=1000 // _FPS, loop=0, quality=quality,
            method=6, minimize_size=True,
        )  # fmt: skip
        if path.stat().st_size < max_bytes:
            return
    raise SystemExit(f"{path}: expected less than {max_bytes} bytes; use a shorter clip.")


def record(clip: Clip, policy: Path, seed: int) -> list[np.ndarray]:
    """Return the frames of a clip, each (height, width, 3), uint8."""
    cfg = load_env_cfg(clip.task, play=True, profile=clip.profile)
    cfg.scene.env_spacing = clip.spacing
    cfg.scene.spec_fn = light_studio
    # The robot starts at the center of its environment, and walks at one velocity.
    if clip.command is not None:
        command: Any = cfg.commands["twist"]
        for name, bounds in clip.command.items():
            setattr(command.ranges, name, bounds)
        command.heading_command, command.ranges.heading = False, None
        command.rel_standing_envs = 0.0
        reset: Any = cfg.events["reset_base"]
        reset.params["pose_range"] = {}
    if clip.terrain is not None:
        generator = TerrainGeneratorCfg(
            size=clip.terrain.size, border_width=10.0, color_scheme="none",
            sub_terrains={"terrain": clip.terrain},
        )  # fmt: skip
        cfg.scene.terrain = TerrainEntityCfg(terrain_type="generator", terrain_generator=generator)
    if clip.motion is not None:
        motion: Any = cfg.commands["motion"]
        motion.motion_file = clip.motion
    cfg.scene.num_envs, cfg.seed = clip.num_envs, seed
    env = make_env(clip.task, cfg, "cpu")
    try:
        act = make_policy(clip.task, env, "trained", policy, "cpu", clip.profile)
        return film(clip, env, act)
    finally:
        env.close()


def film(clip: Clip, env: Any, policy: Any) -> list[np.ndarray]:
    """Step the environments and render each of them into one scene."""
    sim = env.unwrapped.sim
    model = host_model(sim.mj_model)
    if clip.terrain is not None:
        # Unlike planes, boxes of terrain have no texture.
        boxes = (model.body_weldid[model.geom_bodyid] == 0) & (
            model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
        )
        model.geom_rgba[boxes], model.geom_matid[boxes] = _BOX, -1
    # Shadows are sharp only near the target.
    model.stat.extent = 2.0 * clip.distance
    model.vis.map.shadowclip = 0.9
    data, camera, option = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvOption()
    option.sitegroup[:] = not clip.hidden_sites
    camera.distance, camera.azimuth, camera.elevation = clip.distance, clip.azimuth, clip.elevation
    steps_per_frame = max(round(clip.speed / _FPS / env.unwrapped.step_dt), 1)
    width, height = (_OVERSAMPLING * length for length in clip.size)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    frames: list[np.ndarray] = []
    target = np.zeros(3)
    with torch.inference_mode(), open_renderer(model, height, width) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        for _ in range(round(clip.start / env.unwrapped.step_dt)):
            env.step(policy(env.get_observations()))
        while len(frames) < clip.seconds * _FPS:
            places = []
            for index in reversed(range(clip.num_envs)):
                copy_state(sim, index, data)
                compute_poses(model, data)
                if clip.body is not None:
                    places.append(data.body(clip.body).xpos * (1.0, 1.0, 0.0))
            if places:
                # Smooth, so that the camera does not sway with the gait.
                place = np.mean(places, axis=0)
                target = 0.8 * target + 0.2 * place if frames else place
            camera.lookat = np.array(clip.lookat) + target
            suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
            data.light_xpos[suns] = camera.lookat - 4.0 * data.light_xdir[suns]
            renderer.update_scene(data, camera, option)
            for index in range(1, clip.num_envs):
                copy_state(sim, index, data)
                compute_poses(model, data)
                add_moving_geoms(renderer.scene, model, data, option)
            image = Image.fromarray(renderer.render())
            frames.append(np.asarray(image.resize(clip.size, Image.Resampling.LANCZOS)))
            for _ in range(steps_per_frame):
                env.step(policy(env.get_observations()))
    return frames


def light_studio(spec: mujoco.MjSpec) -> None:
    """Replace lights, sky and ground: one sun from the side, weak fill, light and dull ground."""
    for light in spec.lights:
        light.active = False
    for direction, diffuse, casts in (
        ((-0.5, 0.6, -1.0), (0.62, 0.60, 0.56), True),
        ((0.6, -0.4, -0.6), (0.15, 0.18, 0.25), False),
    ):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=direction, diffuse=diffuse,
            ambient=(0.0, 0.0, 0.0), specular=(0.1, 0.1, 0.1), castshadow=casts,
        )  # fmt: skip
    paint_studio(spec, 2.0)


def paint_studio(spec: mujoco.MjSpec, tiles: float) -> None:
    """Replace sky and ground: light and dull, with pairs of tiles that are `tiles` m wide."""
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    spec.add_texture(
        name="studio_sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=(0.55, 0.68, 0.85), rgb2=_HORIZON,
        width=512, height=3072,
    )  # fmt: skip
    spec.add_texture(
        name="studio_ground", type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, rgb1=(0.72, 0.75, 0.79), rgb2=(0.65, 0.68, 0.72),
        width=512, height=512,
    )  # fmt: skip
    ground = spec.add_material(
        name="studio_ground",
        texuniform=True,
        texrepeat=(1.0 / tiles,) * 2,
        reflectance=0.0,
        specular=0.0,
    )
    ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "studio_ground"
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.material, geom.rgba = "studio_ground", (1.0, 1.0, 1.0, 1.0)
    visual = spec.visual
    visual.headlight.ambient = (0.28, 0.29, 0.32)
    visual.headlight.diffuse = (0.18, 0.18, 0.18)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    visual.rgba.haze = visual.rgba.fog = (*_HORIZON, 1.0)
    visual.map.haze, visual.map.fogstart, visual.map.fogend = 0.5, 1.5, 9.0
    visual.quality.offsamples, visual.quality.shadowsize = 8, 4096
    visual.global_.fovy = 38.0


if __name__ == "__main__":
    main(tyro.cli(Args))
