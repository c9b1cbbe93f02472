"""Clips of an environment that something else steps."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.utils.wrappers import VideoRecorder
from mjlab.utils.wrappers.video_recorder import ClipWriter
from mjlab.viewer import RenderingUnavailableError

from ...viewer.viewer_fakes import FakeEnv, push  # noqa: TID252

ACTION = torch.zeros(1, 1)


class FilmedEnv(FakeEnv):
    """Renders its step count as brightness; environment 0's episodes last `episode` steps."""

    def __init__(self, episode: int = 1000, shape: tuple[int, int] = (16, 16)):
        super().__init__(1)
        self.episode = episode
        self.shape = shape

    def step(self, actions):
        obs, reward, _, truncated, extras = super().step(actions)
        return obs, reward, torch.tensor([self.num_steps % self.episode == 0]), truncated, extras

    def render(self):
        return np.full((*self.shape, 3), min(10 * self.num_steps, 255), dtype=np.uint8)


def frames(path: Path) -> np.ndarray:
    reader = imageio_ffmpeg.read_frames(path)
    width, height = next(reader)["size"]
    return np.array([np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader])


def fps(path: Path) -> float:
    return next(imageio_ffmpeg.read_frames(path))["fps"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


def test_of_a_batch_of_images_the_clip_shows_environment_0(tmp_path) -> None:
    class Batched(FilmedEnv):
        def render(self):
            return np.stack([super().render(), np.full((*self.shape, 3), 200, np.uint8)])

    env = VideoRecorder(Batched(), tmp_path, step_trigger=lambda n: n == 0, video_length=3)
    for _ in range(3):
        env.step(ACTION)
    [path] = env.written
    brightness = frames(path).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(brightness, [10, 20, 30], atol=3)


def test_a_clip_starts_at_its_step_and_holds_the_frames_after_each_step(tmp_path) -> None:
    env = VideoRecorder(
        FilmedEnv(), tmp_path / "clips", step_trigger=lambda n: n == 2, video_length=4
    )
    for _ in range(10):
        env.step(ACTION)
    assert names(tmp_path / "clips") == ["rl-video-step-2.mp4"]
    assert env.written == [tmp_path / "clips" / "rl-video-step-2.mp4"]
    brightness = frames(env.written[0]).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(brightness, [30, 40, 50, 60], atol=4)
    assert fps(env.written[0]) == pytest.approx(50.0)


def test_clips_end_with_their_episode(tmp_path) -> None:
    asked = []
    env = VideoRecorder(
        FilmedEnv(episode=5),
        tmp_path,
        episode_trigger=lambda n: asked.append(n) or n == 1,
        name_prefix="eval",
    )
    for _ in range(15):
        env.step(ACTION)
    assert asked == [0, 1, 2]
    assert names(tmp_path) == ["eval-episode-1.mp4"]
    assert len(frames(env.written[0])) == 5


def test_a_clip_shorter_than_its_episode_is_not_recorded_again_over_itself(tmp_path) -> None:
    env = VideoRecorder(
        FilmedEnv(episode=100), tmp_path, episode_trigger=lambda n: n == 0, video_length=3
    )
    for _ in range(9):
        env.step(ACTION)
    np.testing.assert_allclose(frames(env.written[0]).mean(axis=(1, 2, 3)), [10, 20, 30], atol=4)
    assert len(env.written) == 1


def test_the_step_wins_for_the_name_where_both_triggers_fire(tmp_path) -> None:
    env = VideoRecorder(
        FilmedEnv(), tmp_path, lambda n: True, lambda n: n % 10 == 0, video_length=2
    )
    for _ in range(3):
        env.step(ACTION)
    env.close()
    assert names(tmp_path)[0:2] == ["rl-video-episode-0.mp4", "rl-video-step-0.mp4"]


def test_closing_finishes_the_clip_and_closes_the_environment(tmp_path) -> None:
    inner = FilmedEnv()
    env = VideoRecorder(inner, tmp_path, step_trigger=lambda n: n == 0, video_length=100)
    for _ in range(3):
        env.step(ACTION)
    assert not (tmp_path / "rl-video-step-0.mp4").exists()  # Never a half-written file.
    env.close()
    assert inner.closed
    assert len(frames(tmp_path / "rl-video-step-0.mp4")) == 3
    assert names(tmp_path) == ["rl-video-step-0.mp4"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_step_that_fails_does_not_lose_the_clip(tmp_path, error) -> None:
    inner = FilmedEnv()
    env = VideoRecorder(inner, tmp_path, step_trigger=lambda n: n == 0, video_length=100)
    env.step(ACTION)
    env.step(ACTION)

    def fail(action):
        raise error("stop")

    inner.step = fail
    with pytest.raises(error):
        env.step(ACTION)
    assert len(frames(tmp_path / "rl-video-step-0.mp4")) == 2


def test_a_machine_that_cannot_render_is_said_once_and_stepping_goes_on(tmp_path, caplog) -> None:
    inner = FilmedEnv()

    def render():
        raise RenderingUnavailableError.offscreen("no EGL")

    inner.render = render
    env = VideoRecorder(inner, tmp_path, step_trigger=lambda n: True, video_length=2)
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            env.step(ACTION)
    assert inner.num_steps == 5
    assert caplog.text.count("No video is recorded") == 1
    assert "no EGL" in env.unavailable_reason
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_written_costs_the_video_and_not_the_run(tmp_path, caplog) -> None:
    (tmp_path / "file").touch()
    env = VideoRecorder(
        FilmedEnv(), tmp_path / "file" / "x", step_trigger=lambda n: n == 0, video_length=2
    )
    with caplog.at_level(logging.ERROR):
        for _ in range(4):
            env.step(ACTION)
    assert "Incomplete video" in caplog.text
    assert env.num_steps == 4


def test_it_stands_in_for_the_environment(tmp_path) -> None:
    inner = FilmedEnv()
    env = VideoRecorder(inner, tmp_path, step_trigger=lambda n: False)
    assert isinstance(env, ManagerBasedRlEnv)
    assert env.unwrapped is inner
    # Read from the environment, properties of the class included, and written to it.
    assert env.step_dt == 0.02
    assert env.num_envs == 1
    env.num_steps = 41
    assert inner.num_steps == 41
    env.note = "new"
    assert inner.note == "new"
    # Attributes that the recorder has or overrides stay with the recorder.
    env.written, env.render = [tmp_path], lambda: None
    assert not hasattr(inner, "written")
    assert env.written == [tmp_path]
    assert env.render() is None
    assert inner.render() is not None
    with pytest.raises(AttributeError):
        env.no_such_thing
    env.reset(seed=3)
    assert inner.num_resets == 1


def test_a_reset_ends_an_episodes_clip(tmp_path) -> None:
    env = VideoRecorder(FilmedEnv(), tmp_path, episode_trigger=lambda n: n == 0)
    env.reset()
    env.step(ACTION)
    env.step(ACTION)
    env.reset()
    assert len(frames(tmp_path / "rl-video-episode-0.mp4")) == 2


def test_files_are_logged_unless_told_otherwise(tmp_path, caplog) -> None:
    for disable in (False, True):
        env = VideoRecorder(
            FilmedEnv(),
            tmp_path / str(disable),
            step_trigger=lambda n: n == 0,
            video_length=1,
            disable_logger=disable,
        )
        with caplog.at_level(logging.INFO):
            env.step(ACTION)
    assert caplog.text.count("Wrote 1 frames") == 1


def test_a_recorder_without_triggers_raises(tmp_path) -> None:
    with pytest.raises(ValueError, match="episode_trigger or a step_trigger"):
        VideoRecorder(FilmedEnv(), tmp_path)


def test_odd_sizes_and_float_frames_are_written(tmp_path) -> None:
    clip = ClipWriter(tmp_path / "odd.mp4", fps=30)
    for value in (0.0, 0.5, 1.7):
        clip.add(np.full((15, 17, 3), value, dtype=np.float32))
    assert clip.close() == tmp_path / "odd.mp4"
    video = frames(tmp_path / "odd.mp4")
    assert video.shape == (3, 16, 18, 3)
    np.testing.assert_allclose(video.mean(axis=(1, 2, 3)), [0, 128, 255], atol=4)
    assert clip.close() is None


def test_a_frame_of_another_size_is_refused_with_both_sizes(tmp_path) -> None:
    clip = ClipWriter(tmp_path / "x.mp4", fps=30)
    clip.add(np.zeros((4, 4, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match=r"\(4, 4, 3\).*got \(8, 4, 3\)"):
        clip.add(np.zeros((8, 4, 3), dtype=np.uint8))
    with pytest.raises(ValueError, match="height, width, 3"):
        clip.add(np.zeros((4, 4), dtype=np.uint8))
    assert clip.close() is not None


def test_an_encoder_that_fails_is_an_error_and_leaves_no_file(tmp_path) -> None:
    clip = ClipWriter(tmp_path / "x.mp4", fps=30)
    clip.add(np.zeros((4, 4, 3), dtype=np.uint8))
    clip._encoder.kill()
    with pytest.raises(OSError, match="Cannot write the video"):
        clip.close()
    assert names(tmp_path) == []


def test_a_clip_is_finished_when_the_program_ends_without_closing_it(tmp_path) -> None:
    code = (
        "import sys, numpy as np; from pathlib import Path\n"
        "from mjlab.utils.wrappers.video_recorder import ClipWriter\n"
        "clip = ClipWriter(Path(sys.argv[1]) / 'x.mp4', 30)\n"
        "clip.add(np.zeros((4, 4, 3), np.uint8)); sys.exit(3)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 3
    assert len(frames(tmp_path / "x.mp4")) == 1


def test_the_partial_clip_of_a_killed_program_goes_with_the_next_clip(tmp_path) -> None:
    code = (
        "import sys, time, numpy as np; from pathlib import Path\n"
        "from mjlab.utils.wrappers.video_recorder import ClipWriter\n"
        "clip = ClipWriter(Path(sys.argv[1]) / 'x.mp4', 30)\n"
        "clip.add(np.zeros((4, 4, 3), np.uint8)); print('recording', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        other = ClipWriter(tmp_path / "y.mp4", 30)
        other.add(np.zeros((4, 4, 3), np.uint8))
        other.close()
        assert len(names(tmp_path)) == 2
    finally:
        process.kill()
        process.communicate()
    # The encoder may outlive its program by a moment, and make the file again.
    deadline = time.monotonic() + 20.0
    while names(tmp_path) != ["y.mp4", "z.gif"] and time.monotonic() < deadline:
        last = ClipWriter(tmp_path / "z.gif", 30)
        last.add(np.zeros((4, 4, 3), np.uint8))
        last.close()
    assert names(tmp_path) == ["y.mp4", "z.gif"]


@pytest.mark.usefixtures("gl")
def test_a_headless_run_can_be_filmed(tmp_path) -> None:
    from mjlab.viewer import OffscreenRenderer, run_headless

    inner = FakeEnv(2)
    renderer = OffscreenRenderer(inner.sim.mj_model, inner.cfg.viewer, inner.scene)
    renderer.initialize()

    def render():
        renderer.update(inner.sim)
        return renderer.render()

    inner.render = render
    env = VideoRecorder(inner, tmp_path, step_trigger=lambda n: n == 0, video_length=3)
    run_headless(env, push(), 3)
    renderer.close()
    video = frames(env.written[0])
    assert video.shape == (3, 240, 320, 3)
    assert video.std() > 5
