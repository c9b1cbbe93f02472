"""Convert joint angles to a reference motion: `uv run mjlab csv-to-npz --input-file FILE`."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import mujoco
from mjviser import ViserMujocoScene

from mjlab.cli.flags import parse_flags
from mjlab.cli.main import run_alias
from mjlab.compat import older_names
from mjlab.scripts.export_scene import robot_cfg
from mjlab.tasks.tracking.motion_file import Motion, npz_path, read_motion, write_motion
from mjlab.tasks.tracking.motion_order import Skeleton, arranged, plausible
from mjlab.tasks.tracking.motion_recording import (
    Recording,
    make_motion,
    read_csv,
    recording_of,
    resampled,
)
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.ranges import Positive, Range, check_ranges
from mjlab.utils.wandb import asking_wandb, check_wandb_login
from mjlab.viewer.page_server import check_address, page_url, serve_page

if TYPE_CHECKING:
    import viser

    from mjlab.entity import Entity

_WANDB_PROJECT = "csv_to_npz"
_ARTIFACT_TYPE = "motions"
# File name of mjlab 1.6, so that its `play` finds the motion.
_ARTIFACT_FILE = "motion.npz"
_VIDEO_SIZE = (480, 640)

__getattr__ = older_names(__name__)


@dataclass
class CsvToNpzConfig:
    """Flags of `csv_to_npz`."""

    input_file: str = ""
    """Recording: a .csv of poses, or a motion (.npz)."""
    output_file: str | None = None
    """Path of the motion. None: `output_name` in the working folder."""
    output_name: str | None = None
    """Name of the motion and of the uploaded artifact. None: name of the input."""
    input_fps: Positive = 30.0
    """Frame rate of a .csv (Hz); an .npz contains its frame rate."""
    output_fps: Positive = 50.0
    """Frame rate of the motion (Hz): the control rate of the task."""
    line_range: Annotated[tuple[int, int] | None, Range(1)] = None
    """First and last line (or frame), counted from 1, inclusive. None: all."""
    robot: str = "g1"
    """Robot: g1, go1, or `module:function` that returns an EntityCfg."""
    render: bool = False
    """Record the motion as a video beside the output."""
    view: bool = False
    """Serve a page in the browser that plays the motion."""
    port: int = 8080
    """Port of the page; the next free port if taken."""
    host: str = field(default="127.0.0.1", kw_only=True)
    """Address of the page. 0.0.0.0: all interfaces."""
    upload: bool = False
    """Upload the motion to Weights & Biases as an artifact, and link the artifact into the registry."""
    device: str | None = None
    """Ignored; accepted for scripts written for mjlab 1.6. The conversion takes seconds on the CPU."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab csv-to-npz`."""
    convert(parse_flags(CsvToNpzConfig, CsvToNpzConfig(), argv, prog=prog))


def convert(cfg: CsvToNpzConfig) -> Path:
    """Convert a recording and return the path of the motion.

    Raises:
        UserError, ValueError: invalid flag value.
        MotionFileError: the input is not a recording of this robot.
    """
    if not cfg.input_file:
        raise UserError("--input-file: expected a recording (.csv or .npz), got none.")
    check_ranges(cfg, vars(cfg))
    if cfg.upload:
        check_wandb_login("--upload")
    if cfg.view:
        check_address(cfg.host, cfg.port, "--")
    robot = robot_cfg(cfg.robot).build()
    source = Path(cfg.input_file)
    name = cfg.output_name or source.stem
    target = npz_path(cfg.output_file or f"{name}.npz")
    if target.resolve() == source.resolve():
        raise UserError(f"--output-file: expected a path other than the input, got {target}.")
    skeleton = Skeleton.of_entity(robot)
    model = skeleton.model
    recording = _read(cfg, source, skeleton)
    motion = make_motion(
        resampled(recording, cfg.output_fps), model, robot.joint_names, robot.body_names
    )
    path = write_motion(target, motion)
    print(
        f"Motion: {path}, {motion.num_frames} frames, {motion.num_frames / cfg.output_fps:.2f} s "
        f"at {cfg.output_fps:g} per second"
    )
    if cfg.render:
        record_motion(motion, robot, path.with_suffix(".mp4"))
    if cfg.upload:
        _upload(path, name)
    if cfg.view:
        show_motion(motion, _display_model(robot), cfg.host, cfg.port)
    return path


def _read(cfg: CsvToNpzConfig, source: Path, robot: Skeleton) -> Recording:
    if source.suffix != ".npz":
        recording = read_csv(source, cfg.input_fps, robot.joint_names, cfg.line_range)
        return plausible(source, recording, robot)
    motion = arranged(source, read_motion(source), robot, is_strict=True)
    recording = recording_of(motion, motion.fps or cfg.input_fps)
    if cfg.line_range is None:
        return recording
    first, last = cfg.line_range
    if not 1 <= first < last <= len(recording):
        raise UserError(
            f"--line-range: expected at least 2 of the frames 1 to {len(recording)} of {source}, got "
            f"{cfg.line_range}."
        )
    kept = slice(first - 1, last)
    return replace(
        recording,
        root_pos=recording.root_pos[kept],
        root_quat=recording.root_quat[kept],
        joint_pos=recording.joint_pos[kept],
    )


def _display_model(robot: Entity) -> mujoco.MjModel:
    """Return the model of the robot with a floor and a light."""
    spec = robot.cfg.build().spec
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE)
    floor.size, floor.rgba = (10.0, 10.0, 0.1), (0.75, 0.78, 0.82, 1.0)
    spec.worldbody.add_light(pos=(1.0, -1.0, 4.0), dir=(-0.2, 0.2, -1.0))
    return spec.compile()


def record_motion(motion: Motion, robot: Entity, path: Path) -> None:
    """Write a video of the motion."""
    from mjlab.utils.wrappers.video_recorder import ClipWriter
    from mjlab.viewer.offscreen_renderer import open_renderer

    model = _display_model(robot)
    data, camera, option = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvOption()
    camera.distance, camera.azimuth, camera.elevation = 3.0, 120.0, -10.0
    renderer = open_renderer(model, *_VIDEO_SIZE)
    writer = ClipWriter(path, motion.fps or 50.0)
    try:
        for frame in range(motion.num_frames):
            pose(model, data, motion, frame)
            camera.lookat = data.subtree_com[0]
            renderer.update_scene(data, camera, option)
            writer.add(renderer.render())
    finally:
        renderer.close()
        written = writer.close()
    print(f"Video:  {written}")


def pose(model: mujoco.MjModel, data: mujoco.MjData, motion: Motion, frame: int) -> None:
    """Set the pose of a frame of the motion. The first joint of the robot must be free."""
    data.qpos[:3], data.qpos[3:7] = motion.body_pos_w[frame, 0], motion.body_quat_w[frame, 0]
    data.qpos[7:] = motion.joint_pos[frame]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


def _upload(path: Path, name: str) -> None:
    """Upload a motion as an artifact, and link the artifact into the registry of motions.

    Raises:
        WandbError: the upload failed.
    """
    with asking_wandb(f"Upload of {path}") as wandb:
        run = wandb.init(project=_WANDB_PROJECT, name=name)
        try:
            artifact = wandb.Artifact(name=name, type=_ARTIFACT_TYPE)
            artifact.add_file(str(path), name=_ARTIFACT_FILE)
            logged = run.log_artifact(artifact)
            run.link_artifact(logged, target_path=f"wandb-registry-{_ARTIFACT_TYPE}/{name}")
        finally:
            run.finish()
    print_notice(f"Uploaded as wandb-registry-{_ARTIFACT_TYPE}/{name}.")


# Page.


def show_motion(motion: Motion, model: mujoco.MjModel, host: str, port: int) -> None:
    """Serve the page until Ctrl-C."""
    server = serve_page(host, port)
    page = MotionPage(server, motion, model)
    print(f"Open {page_url(server)} in a browser. Ctrl-C ends.", flush=True)
    last = time.perf_counter()
    try:
        while True:
            now = time.perf_counter()
            page.advance(now - last)
            last = now
            time.sleep(1.0 / 50.0)
    finally:
        server.stop()


class MotionPage:
    """Page that plays a motion, or shows the frame selected by a slider."""

    def __init__(self, server: viser.ViserServer, motion: Motion, model: mujoco.MjModel) -> None:
        """Add robot and controls.

        Args:
            server: Server of the page.
            motion: Motion to play.
            model: Model of the robot and its surroundings. The first joint must be the robot's free joint.
        """
        self._motion, self._model = motion, model
        self._data = mujoco.MjData(model)
        self._scene = ViserMujocoScene(server, model, num_envs=1)
        self._playing = server.gui.add_checkbox("Play", True)
        self._speed = server.gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        self._slider = server.gui.add_slider("Frame", 0, motion.num_frames - 1, 1, 0)
        self._slider.on_update(self._on_slider)
        self._frame = 0.0
        self._shown: int | None = None

    @property
    def frame(self) -> int:
        """Index of the current frame."""
        return int(self._frame)

    def advance(self, seconds: float) -> None:
        """Advance the motion by `seconds` and show the current frame; restart at the end."""
        if self._playing.value:
            self._frame += seconds * (self._motion.fps or 50.0) * self._speed.value
            self._frame %= self._motion.num_frames
            self._slider.value = self.frame
        if self._shown != self.frame:
            self._shown = self.frame
            pose(self._model, self._data, self._motion, self.frame)
            self._scene.update_from_mjdata(self._data)

    def _on_slider(self, event: Any) -> None:
        # Updates made by the page itself have client None.
        if event.client is not None:
            self._playing.value = False
            self._frame = float(self._slider.value)


def main() -> None:
    """Entry point of `csv-to-npz`."""
    run_alias("csv-to-npz")


if __name__ == "__main__":
    main()
