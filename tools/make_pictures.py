"""Draw the pictures of the documentation: `python tools/make_pictures.py [NAME ...]`.

Renders offscreen, without a display. Run again when a terrain preset, the example of `variants.md`, the
reference runs of the Go1 or a statement of a badge changes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import torch
from make_clips import paint_studio
from matplotlib.figure import Figure
from PIL import Image, ImageEnhance

from mjlab.runs.reference import DATA, Reference, reference_path
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import CameraSensorCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.terrains import SubTerrainCfg, TerrainEntityCfg, TerrainGenerator, TerrainGeneratorCfg
from mjlab.terrains.config import ALL_TERRAIN_PRESETS
from mjlab.viewer.offscreen_renderer import OffscreenRenderer, open_renderer
from mjlab.viewer.viewer_config import ViewerConfig
from mjlab.viewer.viser.camera_viewer import depth_colors, segmentation_colors

_DOCS = Path(__file__).parents[1] / "docs"
_IMAGES = _DOCS / "images"

_WALKING = "Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation"
# Extent of one terrain (m), and difficulties of a strip.
_SIZE = 8.0
_DIFFICULTIES = (0.0, 0.5, 1.0)
_STRIPS_PER_ROW = 2
# Pixels of a strip and of its title. Strips are rendered larger and downsampled for antialiasing.
_WIDTH, _HEIGHT, _TITLE, _OVERSAMPLING = 640, 146, 24, 3
# Saturation and brightness of the colors of terrains, which tell heights but are strong.
_SATURATION, _BRIGHTNESS = 0.55, 1.25


# Badges of the README: name and statement.
BADGES = {
    "tests": "make test",
    "docs": "make docs",
    "python": "3.11 to 3.13",
    "license": "Apache 2.0",
    "cite": "CITATION.cff",
}
_BADGE = """\
<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="20" role="img" aria-label="{name}: {text}">
<clipPath id="r"><rect width="{width}" height="20" rx="3"/></clipPath>
<g clip-path="url(#r)"><rect width="{width}" height="20" fill="#3b6ea5"/>
<rect width="{left}" height="20" fill="#4a4f57"/></g>
<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11" text-anchor="middle">
<text x="{name_at}" y="14">{name}</text><text x="{text_at}" y="14">{text}</text></g></svg>
"""
# Pixels of a character and around a word.
_CHARACTER, _AROUND = 7, 12


def main(names: Sequence[str]) -> None:
    """Draw the pictures with these names."""
    for name in names:
        PICTURES[name](_IMAGES / f"{name}.png")


def draw_badges(path: Path) -> None:
    """Write the badges of the README as SVG, beside `path`."""
    for name, text in BADGES.items():
        left, right = (_CHARACTER * len(word) + _AROUND for word in (name, text))
        badge = _BADGE.format(
            name=name, text=text, width=left + right, left=left, name_at=left / 2,
            text_at=left + right / 2,
        )  # fmt: skip
        path.with_name(f"badge_{name}.svg").write_text(badge, encoding="utf-8")


def draw_learning(path: Path) -> None:
    """Draw the velocity error of the bundled reference runs over time, and the goal."""
    reference = Reference.load(reference_path(DATA, _WALKING, "cpu"))
    goal = load_rl_cfg(_WALKING, profile="cpu").evaluation.solved_below["lin_vel_error"]
    figure = Figure(figsize=(9.0, 3.4), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    for record in reference.seeds:
        minutes = np.array(record.run.seconds_at) / 60
        axes.plot(minutes, record.run.figures["lin_vel_error"], lw=2, label=f"seed {record.seed}")
    axes.axhline(goal, ls="--", lw=1.2, color="dimgray")
    axes.text(0.01, goal - 0.015, f"goal: {goal:g} m/s", va="top", color="dimgray")
    axes.set(
        xlim=(0.0, None), ylim=(0.0, None), xlabel="Minutes of training on two CPU cores (AMD EPYC)",
        ylabel="Error of the velocity (m/s)", title="A Go1 learns to walk: error in evaluations",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper right")
    figure.savefig(path)
    Image.open(path).convert("RGB").quantize(128).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB")


def draw_cameras(path: Path) -> None:
    """Draw camera images of the arm that lifts a cube, one engine per row."""
    figure = Figure(figsize=(9.6, 3.4), dpi=100)
    engines: tuple[Literal["native", "warp"], ...] = ("native", "warp")
    for row, engine in enumerate(engines):
        pictures = camera_pictures(engine)
        for column, (title, pixels) in enumerate(pictures.items()):
            left, width = (0.025 + 0.1625 * column, 0.158)
            axes = figure.add_axes((left, 0.485 - 0.475 * row, width, 0.45), xticks=[], yticks=[])
            axes.imshow(pixels, interpolation="nearest")
            if row == 0:
                axes.set_title(title, fontsize=9, pad=3)
            if column == 0:
                axes.set_ylabel(engine, fontsize=10, labelpad=4)
    figure.savefig(path)
    Image.open(path).convert("RGB").save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB")


def camera_pictures(engine: Literal["native", "warp"]) -> dict[str, np.ndarray]:
    """Return the images (H, W, 3) of two cameras, by content."""
    task = load_env_cfg("Mjlab-Lift-Cube-Yam-Rgb").scene
    kinds = ("rgb", "depth", "segmentation")
    common: dict[str, Any] = {"width": 144, "height": 144, "data_types": kinds}
    common["enabled_geom_groups"] = (0, 2)
    look = {
        # The arm from the side, with shadows, and its wrist camera.
        "side": CameraSensorCfg(
            name="side", pos=(0.2, -0.85, 0.3), quat=(0.75, 0.66, 0.0, 0.0), fovy=50.0,
            use_shadows=True, **common,
        ),
        "wrist": CameraSensorCfg(name="wrist", camera_name="robot/camera_d405", **common),
    }  # fmt: skip
    cfg = SceneCfg(
        num_envs=1,
        env_spacing=1.0,
        terrain=task.terrain,
        entities=task.entities,
        sensors=tuple(look.values()),
    )
    scene = Scene(cfg, device="cpu")
    sim = Simulation(1, SimulationCfg(engine=engine), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.set_sensor_context(scene.sensor_context)
    robot, cube = scene["robot"], scene["cube"]
    robot.write_joint_state_to_sim(
        robot.data.default_joint_pos, torch.zeros_like(robot.data.default_joint_pos)
    )
    cube.write_root_link_pose_to_sim(torch.tensor([[0.4, 0.0, 0.02, 0.95, 0.0, 0.0, 0.31]]))
    sim.forward()
    sim.sense()
    pictures = {}
    for name, white in (("side", 1.5), ("wrist", 0.5)):
        data = scene[name].data
        pictures[f"{name}: rgb"] = data.rgb[0].numpy()
        pictures[f"{name}: depth"] = depth_colors(data.depth[0].numpy(), white)
        pictures[f"{name}: segmentation"] = segmentation_colors(data.segmentation[0].numpy())
    return pictures


def draw_variants(path: Path) -> None:
    """Draw the example of `variants.md`, some time after its release."""
    page = (_DOCS / "how-to" / "variants.md").read_text(encoding="utf-8")
    example: dict[str, Any] = {}
    exec(page.split("```python\n")[1].split("```")[0], example)
    plane = TerrainEntityCfg(terrain_type="plane")
    entities = {"object": example["object_cfg"]}
    scene = Scene(
        SceneCfg(num_envs=12, env_spacing=0.3, terrain=plane, entities=entities), device="cpu"
    )
    paint_studio(scene.spec, 0.3)
    sim = Simulation(
        scene.num_envs,
        SimulationCfg(engine="native"),
        spec=scene.spec,
        variant_info=scene.collect_variant_info(),
        device="cpu",
    )
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.data.qpos[:, :3] = scene.env_origins + torch.tensor([0.0, 0.0, 0.1])
    sim.step(500)
    cfg = ViewerConfig(
        width=1440, height=600, max_extra_envs=11, origin_type=ViewerConfig.OriginType.WORLD,
        distance=1.25, elevation=-38.0, azimuth=90.0, lookat=(0.0, -0.03, 0.0),
    )  # fmt: skip
    renderer = OffscreenRenderer(sim.mj_model, cfg, scene)
    renderer.initialize()
    renderer.update(sim)
    image = Image.fromarray(renderer.render()).resize((720, 300), Image.Resampling.LANCZOS)
    image.save(path, optimize=True)
    renderer.close()
    print(f"{path}: {path.stat().st_size // 1024} kB")


def draw_terrains(path: Path) -> None:
    """Draw every terrain preset, from easy at the left to difficult at the right."""
    strips = {name: render_strip(preset()) for name, preset in ALL_TERRAIN_PRESETS.items()}
    rows = -(-len(strips) // _STRIPS_PER_ROW)
    width, height = _STRIPS_PER_ROW * _WIDTH, rows * (_HEIGHT + _TITLE)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    for index, (name, pixels) in enumerate(strips.items()):
        row, col = divmod(index, _STRIPS_PER_ROW)
        top = 1.0 - row / rows
        left, share = col / _STRIPS_PER_ROW, _TITLE / height
        axis = figure.add_axes(
            (left, top - share - _HEIGHT / height, _WIDTH / width, _HEIGHT / height)
        )
        axis.imshow(pixels, aspect="auto")
        axis.axis("off")
        figure.text(
            left + 0.5 / _STRIPS_PER_ROW, top - 1.2 * share, name,
            ha="center", va="bottom", fontsize=13, family="monospace",
        )  # fmt: skip
    figure.text(
        0.75, 0.5 / rows, "from left to right:\ndifficulty 0, 0.5 and 1,\n8 m x 8 m each",
        ha="center", va="center", fontsize=13, color="0.3",
    )  # fmt: skip
    figure.savefig(path)
    # A palette of 256 colors is a third of the size, and looks the same here.
    image = Image.open(path).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size // 1024} kB, {image.size[0]} x {image.size[1]}")


def render_strip(sub: SubTerrainCfg) -> np.ndarray:
    """Return (height, width, 3) of one kind of terrain at all difficulties."""
    model = _strip_spec(sub).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat = (0.0, -0.2, 0.0)
    camera.distance, camera.azimuth, camera.elevation = 46.0, 90.0, -36.0
    with open_renderer(model, _HEIGHT * _OVERSAMPLING, _WIDTH * _OVERSAMPLING) as renderer:
        renderer.update_scene(data, camera)
        pixels = renderer.render()
    small = Image.fromarray(pixels).resize((_WIDTH, _HEIGHT), Image.Resampling.LANCZOS)
    soft = ImageEnhance.Color(small).enhance(_SATURATION)
    return np.asarray(ImageEnhance.Brightness(soft).enhance(_BRIGHTNESS))


def _strip_spec(sub: SubTerrainCfg) -> mujoco.MjSpec:
    """Return a scene with one kind of terrain at all difficulties, lit from the left."""
    spec = mujoco.MjSpec()
    generator = TerrainGeneratorCfg(
        seed=0,
        curriculum=True,
        size=(_SIZE, _SIZE),
        num_rows=len(_DIFFICULTIES),
        difficulty_range=(_DIFFICULTIES[0], _DIFFICULTIES[-1]),
        border_width=0.4,
        border_height=0.6,
        sub_terrains={"shown": sub},
    )
    TerrainGenerator(generator).compile(spec)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(-10.0, -8.0, 20.0),
        dir=(0.6, 0.3, -0.74),
        diffuse=(0.8, 0.8, 0.78),
        specular=(0.0, 0.0, 0.0),
        castshadow=True,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=(1.0, 1.0, 1.0),
        width=16,
        height=96,
    )
    visual = spec.visual
    visual.headlight.ambient = (0.36, 0.36, 0.38)
    visual.headlight.diffuse = (0.1, 0.1, 0.1)
    visual.headlight.specular = (0.0, 0.0, 0.0)
    visual.quality.shadowsize = 8192
    # A narrow field of view from afar: perspective is equal along the strip.
    visual.global_.fovy = 7.9
    visual.global_.offwidth = _WIDTH * _OVERSAMPLING
    visual.global_.offheight = _HEIGHT * _OVERSAMPLING
    return spec


PICTURES = {
    "badges": draw_badges,
    "go1_learning": draw_learning,
    "terrains": draw_terrains,
    "variants": draw_variants,
    "cameras": draw_cameras,
}

if __name__ == "__main__":
    main(sys.argv[1:] or list(PICTURES))
