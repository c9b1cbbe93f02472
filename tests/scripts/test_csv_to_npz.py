"""Conversion of recordings to motions: losslessness, resampling, velocities, errors."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.scripts.csv_to_npz import CsvToNpzConfig, MotionPage, convert
from mjlab.tasks.tracking.motion_file import MotionFileError, read_motion
from mjlab.tasks.tracking.motion_recording import (
    Recording,
    angular_velocities,
    read_csv,
    recording_of,
    resampled,
    slerp,
    write_csv,
)
from mjlab.utils.errors import UserError

JOINTS = get_g1_robot_cfg().build().joint_names


def table(**changes) -> np.ndarray:
    """Return a table of a robot that turns about z and squats, in the layout of the task."""
    t = np.linspace(0.0, 1.0, 41)[:, None]
    half = 1.2 * t
    joints = np.tile(0.05 * np.arange(29) / 29, (41, 1))
    for side in ("left", "right"):
        for name, share in (("hip_pitch", -1.0), ("knee", 2.0), ("ankle_pitch", -0.8)):
            joints[:, JOINTS.index(f"{side}_{name}_joint")] = share * t[:, 0]
    quat = np.hstack((0.0 * t, 0.0 * t, np.sin(half), np.cos(half)))
    values = {"pos": np.hstack((t, 0.0 * t, 0.7 + 0.0 * t)), "quat": quat, "joints": joints}
    values |= changes
    return np.hstack(list(values.values()))


def breadth_first() -> list[int]:
    """Return the joints of the G1 from the pelvis outwards."""
    model = get_g1_robot_cfg().build().compile()

    def depth(body: int) -> int:
        return 0 if body == 0 else 1 + depth(model.body_parentid[body])

    return sorted(range(29), key=lambda joint: depth(model.jnt_bodyid[1 + joint]))


def motion_of(tmp_path, values: np.ndarray, header: str = ""):
    """Return the motion made from a table."""
    path = tmp_path / "table.csv"
    np.savetxt(path, values, delimiter=",", header=header, comments="")
    return converted(path, tmp_path)


def test_a_byte_order_mark_is_not_a_number(tmp_path):
    np.savetxt(tmp_path / "plain.csv", table(), delimiter=",")
    content = (tmp_path / "plain.csv").read_bytes()
    (tmp_path / "marked.csv").write_bytes(b"\xef\xbb\xbf" + content)
    plain, marked = (
        read_csv(tmp_path / f"{name}.csv", 30.0, JOINTS) for name in ("plain", "marked")
    )
    np.testing.assert_array_equal(marked.joint_pos, plain.joint_pos)
    np.testing.assert_array_equal(marked.root_pos, plain.root_pos)


@pytest.mark.parametrize("mark", ["", "# "])
def test_columns_are_found_by_the_names_of_a_header(tmp_path, mark):
    root = [
        f"root_{kind}_{axis}"
        for kind, axis in zip(["pos"] * 3 + ["rot"] * 4, "xyzxyzw", strict=True)
    ]
    names = [*root, *(name.replace("_joint", "_dof") for name in JOINTS), "frame"]
    values = np.hstack((table(), np.arange(41)[:, None]))
    order = [36, *range(35, 6, -1), 6, 3, 4, 5, 0, 1, 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = motion_of(tmp_path, table())
        motion = motion_of(tmp_path, values[:, order], mark + ",".join(names[i] for i in order))
    np.testing.assert_allclose(motion.body_pos_w, expected.body_pos_w, atol=1e-6)
    np.testing.assert_allclose(motion.joint_pos, expected.joint_pos, atol=1e-6)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_quaternions_may_stand_before_positions(tmp_path, order):
    expected = motion_of(tmp_path, table())
    quat = [f"q{letter}" for letter in order]
    columns = [*("xyzw".index(letter) + 3 for letter in order), 0, 1, 2, *range(7, 36)]
    header = ",".join([*quat, "x", "y", "z", *JOINTS])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = motion_of(tmp_path, table()[:, columns], header)
    np.testing.assert_allclose(motion.body_pos_w, expected.body_pos_w, atol=1e-6)


def test_headers_without_the_joints_warn(tmp_path):
    expected = motion_of(tmp_path, table())
    names = [*("x", "y", "z", "qx", "qy", "qz", "qw"), "other", *JOINTS[1:]]
    with pytest.warns(UserWarning, match=f"{JOINTS[0]}.*order of the robot") as warned:
        motion = motion_of(tmp_path, table(), ",".join(names))
    assert len(warned) == 1
    np.testing.assert_array_equal(motion.body_pos_w, expected.body_pos_w)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = motion_of(tmp_path, table(), ",".join(map(str, range(36))))
    np.testing.assert_array_equal(motion.body_pos_w, expected.body_pos_w)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v[:, [0, 1, 2, 6, 3, 4, 5, *range(7, 36)]], "w x y z"),
        (lambda v: np.hstack((v[:, :7], np.rad2deg(v[:, 7:]))), "degrees"),
        (lambda v: np.hstack((v[:, :7], v[:, 7:][:, breadth_first()])), "breadth-first"),
        (lambda v: np.hstack((v[:, :3], 1.1 * v[:, 3:7], v[:, 7:])), "norm 1.1; normalized"),
    ],
    ids=["wxyz", "degrees", "breadth_first", "norm"],
)
def test_other_conventions_are_converted_with_a_warning(tmp_path, change, message):
    expected = motion_of(tmp_path, table())
    with pytest.warns(UserWarning, match=message) as warned:
        motion = motion_of(tmp_path, change(table()))
    assert len(warned) == 1
    np.testing.assert_allclose(motion.body_pos_w, expected.body_pos_w, atol=1e-5)


def test_joints_far_beyond_their_limits_are_named(tmp_path):
    values = table()
    values[:, 7 + JOINTS.index("left_knee_joint")] = -1.5
    with pytest.warns(UserWarning, match="'left_knee_joint': 1.4"):
        motion_of(tmp_path, values)


def recording(frames=91, fps=30.0, speed=1.0) -> Recording:
    """Return a robot that goes along a curve, turns about a skew axis, and moves all joints."""
    t = np.arange(frames)[:, None] / fps
    axis = np.array([0.3, -0.4, 0.8]) / np.linalg.norm([0.3, -0.4, 0.8])
    half = 0.5 * speed * np.sin(1.3 * t)
    return Recording(
        fps=fps,
        root_pos=np.hstack((0.8 * t, np.sin(t), 0.75 + 0.05 * np.cos(2.0 * t))),
        root_quat=np.hstack((np.cos(half), np.sin(half) * axis)),
        joint_pos=0.4 * np.sin(2.0 * t + np.arange(29)),
    )


@pytest.fixture
def csv(tmp_path) -> Path:
    path = tmp_path / "dance.csv"
    write_csv(path, recording())
    return path


def converted(csv, tmp_path, **flags):
    target = tmp_path / "out" / "dance.npz"
    convert(CsvToNpzConfig(input_file=str(csv), output_file=str(target), **flags))
    return read_motion(target)


def angles(one, other) -> np.ndarray:
    """Return the angles between unit quaternions, in degrees."""
    chord = np.minimum(np.linalg.norm(one - other, axis=-1), np.linalg.norm(one + other, axis=-1))
    return np.degrees(4.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0)))


@pytest.mark.parametrize(
    ("output_fps", "source_step", "motion_step"),
    [(30.0, 1, 1), (50.0, 3, 5), (60.0, 1, 2), (120.0, 1, 4)],
)
def test_to_a_motion_and_back_nothing_is_lost(csv, tmp_path, output_fps, source_step, motion_step):
    motion = converted(csv, tmp_path, output_fps=output_fps)
    back = tmp_path / "back.csv"
    write_csv(back, recording_of(motion, output_fps))
    source, again = read_csv(csv, 30.0, JOINTS), read_csv(back, output_fps, JOINTS)
    # The times that both have; the last pose begins no interval.
    times = slice(None, -1 if source_step == 1 else None, source_step)
    wanted = source.root_pos[times][: len(again.root_pos[::motion_step])]
    count = len(wanted)
    assert count >= 30
    assert np.abs(again.root_pos[::motion_step] - wanted).max() < 1e-4
    assert angles(again.root_quat[::motion_step], source.root_quat[times][:count]).max() < 0.01
    joints = np.degrees(again.joint_pos[::motion_step] - source.joint_pos[times][:count])
    assert np.abs(joints).max() < 0.01


@pytest.mark.parametrize("fps", [30.0, 50.0, 120.0])
def test_velocities_are_the_finite_differences_of_positions(csv, tmp_path, fps):
    motion = converted(csv, tmp_path, output_fps=fps)
    for position, velocity in (
        (motion.joint_pos, motion.joint_vel),
        (motion.body_pos_w, motion.body_lin_vel_w),
    ):
        expected = np.gradient(position.astype(np.float64), 1.0 / fps, axis=0)
        assert np.sqrt(np.mean((expected - velocity) ** 2)) < 0.02 * np.ptp(velocity)
    angular = np.stack(
        [
            angular_velocities(motion.body_quat_w[:, i].astype(np.float64), 1.0 / fps)
            for i in range(30)
        ],
        axis=1,
    )
    error = np.sqrt(np.mean((angular - motion.body_ang_vel_w) ** 2))
    assert error < 0.02 * np.ptp(motion.body_ang_vel_w)


def test_a_motion_has_the_layout_that_the_task_reads(csv, tmp_path):
    motion = converted(csv, tmp_path)
    # 91 poses at 30 per second are 3 s.
    assert (motion.fps, motion.num_frames) == (50.0, 150)
    assert motion.joint_pos.shape == motion.joint_vel.shape == (150, 29)
    assert motion.body_pos_w.shape == (150, 30, 3)
    assert motion.body_quat_w.shape == (150, 30, 4)
    assert motion.joint_names == JOINTS
    assert motion.body_names[0] == "pelvis"
    np.testing.assert_allclose(motion.body_pos_w[0, 0], [0.0, 0.0, 0.8], atol=1e-6)


@pytest.mark.parametrize(
    ("poses", "fps_in", "fps_out", "frames"),
    [(301, 30, 50, 500), (301, 30, 30, 300), (2, 30, 50, 2), (120, 120, 50, 50), (91, 60, 50, 75)],
)
def test_the_number_of_frames_is_that_of_the_interface(poses, fps_in, fps_out, frames):
    assert len(resampled(recording(poses, fps_in), fps_out)) == frames


def test_a_slow_turn_is_even(tmp_path):
    """At 0.05 rad/s, neighbours at 30 per second are 1.7e-3 rad apart."""
    t = np.arange(91)[:, None] / 30.0
    quat = np.hstack((np.cos(0.025 * t), 0.0 * t, 0.0 * t, np.sin(0.025 * t)))
    slow = Recording(
        fps=30.0, root_pos=np.zeros((91, 3)), root_quat=quat, joint_pos=np.zeros((91, 29))
    )
    rates = angular_velocities(resampled(slow, 50.0).root_quat, 0.02)
    np.testing.assert_allclose(rates[:, 2], 0.05, rtol=1e-6)


def test_angular_velocities_are_those_of_an_accelerating_turn():
    """Differences over 2 dt are exact for a constant acceleration; both ends repeat a neighbor."""
    dt, axis = 0.02, np.array([0.3, -0.4, 0.8]) / np.linalg.norm([0.3, -0.4, 0.8])
    t = np.arange(40)[:, None] * dt
    half, rate = 0.5 * (0.7 * t + 1.5 * t**2), 0.7 + 3.0 * t
    turn = np.hstack((np.cos(half), np.sin(half) * axis))
    expected = rate[[1, *range(1, 39), 38]] * axis
    np.testing.assert_allclose(angular_velocities(turn, dt), expected, atol=1e-9)
    two = angular_velocities(turn[:2], dt)
    np.testing.assert_allclose(two, 0.5 * (rate[:1] + rate[1:2]) * axis * [[1.0], [1.0]], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    angle=st.one_of(st.floats(1e-9, 1e-3), st.floats(1e-3, 3.1)),
    share=st.floats(0.0, 1.0),
    flip=st.booleans(),
)
def test_slerp_turns_by_the_share_of_the_angle_the_short_way(angle, share, flip):
    start = np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    end = np.array([np.cos(0.2 + angle / 2), np.sin(0.2 + angle / 2), 0.0, 0.0])
    result = slerp(start, -end if flip else end, np.array([share]))
    expected = [np.cos(0.2 + share * angle / 2), np.sin(0.2 + share * angle / 2), 0.0, 0.0]
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_a_range_of_lines_is_both_ends_included_counted_from_one(csv, tmp_path):
    motion = converted(csv, tmp_path, line_range=(11, 41), output_fps=30.0)
    assert motion.num_frames == 30
    source = read_csv(csv, 30.0, JOINTS)
    np.testing.assert_allclose(motion.joint_pos[0], source.joint_pos[10], atol=1e-6)


def test_a_motion_can_be_brought_to_another_rate(csv, tmp_path):
    first = converted(csv, tmp_path, output_fps=100.0)
    target = tmp_path / "half.npz"
    convert(CsvToNpzConfig(input_file=str(tmp_path / "out" / "dance.npz"), output_file=str(target)))
    second = read_motion(target)
    assert second.fps == 50.0
    np.testing.assert_allclose(second.joint_pos, first.joint_pos[: 2 * 150 : 2], atol=1e-6)


def test_the_output_goes_where_it_was_asked_to_and_nowhere_else(csv, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "wandb", None)
    path = convert(CsvToNpzConfig(input_file=str(csv)))
    assert path == Path("dance.npz")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dance.csv", "dance.npz"]
    path = convert(CsvToNpzConfig(input_file=str(csv), output_name="waltz"))
    assert path == Path("waltz.npz")


def test_a_motion_is_uploaded_only_on_request(csv, tmp_path, monkeypatch):
    calls = []

    class Artifact:
        def __init__(self, name, type):
            calls.append((name, type))

        def add_file(self, path, name):
            calls.append((Path(path).name, name))

    run = SimpleNamespace(
        log_artifact=lambda artifact: artifact,
        link_artifact=lambda artifact, target_path: calls.append(target_path),
        finish=lambda: calls.append("finished"),
    )
    wandb = SimpleNamespace(init=lambda project, name: run, Artifact=Artifact)
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    converted(csv, tmp_path)
    assert not calls
    converted(csv, tmp_path, upload=True)
    assert calls == [
        ("dance", "motions"),
        ("dance.npz", "motion.npz"),
        "wandb-registry-motions/dance",
        "finished",
    ]


def test_a_video_is_written_beside_the_output(csv, tmp_path, monkeypatch):
    frames = []
    renderer = SimpleNamespace(
        update_scene=lambda *args: None,
        render=lambda: frames.append(1) or np.zeros((48, 64, 3), np.uint8),
        close=lambda: None,
    )
    monkeypatch.setattr("mjlab.viewer.offscreen_renderer.open_renderer", lambda *args: renderer)
    converted(csv, tmp_path, line_range=(1, 13), render=True)
    assert len(frames) == 20
    assert (tmp_path / "out" / "dance.mp4").stat().st_size > 500


def a_line(**changes) -> str:
    values = [0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0, *[0.0] * 29]
    for column, value in changes.items():
        values[int(column[1:])] = value
    return ",".join(map(str, values))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least 2 poses, got 0"),
        (a_line(), "at least 2 poses, got 1"),
        ("1,2,3\n4,5,6\n", "expected 36 columns, got 3"),
        (a_line().replace(",", " "), "is not a table of numbers"),
        (f"{a_line()}\n{a_line(c8=float('nan'))}", "Line 2 of .* NaN"),
        (f"{a_line(c8=1e39)}\n{a_line()}", "joint_pos .*float32.* infinite"),
        (f"{a_line(c8=3e38)}\n{a_line(c8=-3e38)}", "joint_vel .*float32.* infinite"),
        (f"{a_line()}\n{a_line(c6=0.0)}", "Line 2 of .* norm 0"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(MotionFileError, match=message):
        convert(CsvToNpzConfig(input_file=str(path), output_file=str(tmp_path / "out.npz")))
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"input_file": ""}, "--input-file: .* got none"),
        ({"input_file": "none.csv"}, "none.csv"),
        ({"input_fps": 0.0}, "--input-fps: expected a finite number > 0, got 0.0"),
        ({"output_fps": -50.0}, "--output-fps: .* got -50.0"),
        ({"line_range": (5, 200)}, "line_range: .*1 to 91 of .*got 5 to 200"),
        ({"line_range": (0, 5)}, r"--line-range: .* got \(0, 5\)"),
        ({"robot": "h1"}, "Unknown robot 'h1'; did you mean 'g1'"),
        ({"robot": "no.such:robot"}, "'no.such:robot' cannot be imported: No module named 'no'"),
        ({"robot": "go1"}, "expected 19 columns, got 36"),
    ],
)
def test_flags_that_make_no_sense_are_refused(csv, tmp_path, flags, message):
    cfg = CsvToNpzConfig(
        **{"input_file": str(csv), "output_file": str(tmp_path / "o.npz"), **flags}
    )
    with pytest.raises((UserError, ValueError), match=message):
        convert(cfg)


def test_lines_of_a_range_are_told_as_in_the_file(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text("\n".join([a_line()] * 6 + [a_line(c9=float("nan"))] + [a_line(c6=0.0)]))
    cfg = CsvToNpzConfig(input_file=str(path), output_file=str(tmp_path / "o.npz"))
    cfg.line_range = (3, 7)
    with pytest.raises(MotionFileError, match="Line 7 of .* NaN"):
        convert(cfg)
    cfg.line_range = (8, 8)
    with pytest.raises(MotionFileError, match="at least 2 poses, got 1"):
        convert(cfg)
    path.write_text("\n".join([a_line()] * 6 + [a_line(c6=0.5)]))
    cfg.line_range = (3, 7)
    with pytest.warns(UserWarning, match="Line 7 of .* norm 0.5; normalized"):
        convert(cfg)


def test_a_recording_shorter_than_two_frames_is_told(csv, tmp_path):
    cfg = CsvToNpzConfig(
        input_file=str(csv), output_file=str(tmp_path / "o.npz"), line_range=(1, 2), output_fps=10.0
    )
    with pytest.raises(ValueError, match="10 per second, got 1 from 2 poses at 30"):
        convert(cfg)


def test_an_upload_that_fails_is_one_message_and_keeps_the_motion(csv, tmp_path, monkeypatch):
    def init(project, name):
        raise RuntimeError("No API key configured")

    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    with pytest.raises(ConnectionError, match="Upload of .*dance.npz: .*No API key.*wandb login"):
        converted(csv, tmp_path, upload=True)
    assert read_motion(tmp_path / "out" / "dance.npz").num_frames == 150


def test_the_input_is_not_overwritten(csv, tmp_path, monkeypatch):
    converted(csv, tmp_path)
    monkeypatch.chdir(tmp_path / "out")
    with pytest.raises(UserError, match="--output-file: .* got .*npz"):
        convert(CsvToNpzConfig(input_file="dance.npz"))
    before = Path("dance.npz").read_bytes()
    with pytest.raises(UserError, match="--output-file: .* got .*npz"):
        convert(CsvToNpzConfig(input_file="dance.npz", output_file="dance", output_fps=25.0))
    assert Path("dance.npz").read_bytes() == before


def test_the_page_plays_the_motion_and_follows_the_slider(csv, tmp_path):
    motion = converted(csv, tmp_path)
    widgets, drawn = {}, []

    class Widget(SimpleNamespace):
        def on_update(self, callback):
            self.callback = callback

    def add(label, *values):
        widgets[label] = Widget(value=values[-1])
        return widgets[label]

    page = MotionPage.__new__(MotionPage)
    scene = SimpleNamespace(update_from_mjdata=lambda data: drawn.append(data.qpos.copy()))
    server = SimpleNamespace(gui=SimpleNamespace(add_checkbox=add, add_slider=add))
    model = get_g1_robot_cfg().build().compile()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjlab.scripts.csv_to_npz.ViserMujocoScene", lambda *a, **k: scene)
        page.__init__(server, motion, model)
    page.advance(0.5)
    assert page.frame == widgets["Frame"].value == 25
    np.testing.assert_allclose(drawn[-1][7:], motion.joint_pos[25], atol=1e-6)
    page.advance(2.7)
    assert page.frame == 10
    widgets["Frame"].value = 90
    widgets["Frame"].callback(SimpleNamespace(client=object()))
    page.advance(1.0)
    assert page.frame == 90
    assert not widgets["Play"].value
    assert len(drawn) == 3


def test_its_help_needs_nothing_heavy():
    code = (
        "import sys; from mjlab.cli import main as cli; cli._dispatch(['csv-to-npz', '--help']); "
        "assert not {'torch', 'mujoco', 'tyro'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--input-file FILE" in done.stdout


@pytest.mark.filterwarnings("ignore:.*older:FutureWarning")
def test_run_sim_writes_the_motion_of_a_scene_whatever_the_order_of_joints(
    csv, tmp_path, monkeypatch
):
    from mjlab.scripts.csv_to_npz import run_sim

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    expected = converted(csv, tmp_path)
    backwards = tmp_path / "backwards.csv"
    table = np.loadtxt(csv, delimiter=",")
    np.savetxt(backwards, np.hstack((table[:, :7], table[:, :6:-1])), delimiter=",")
    g1 = get_g1_robot_cfg().build()
    defaults = SimpleNamespace(default_joint_pos=torch.zeros(1, 29))
    robot = SimpleNamespace(cfg=g1.cfg, find_joints=g1.find_joints, data=defaults)
    run_sim(None, {"robot": robot}, JOINTS[::-1], str(backwards), 30.0, 50.0, "dance", False, None)
    for path in (tmp_path / "dance.npz", tmp_path / "temporary" / "motion.npz"):
        motion = read_motion(path)
        np.testing.assert_allclose(motion.joint_pos, expected.joint_pos, atol=1e-6)
        np.testing.assert_allclose(motion.body_pos_w, expected.body_pos_w, atol=1e-6)
