"""Motion files: write and read, and one clear error for files that do not match the robot."""

from __future__ import annotations

import contextlib
import re

import numpy as np
import pytest
import torch
from tracking_tasks import part_of

from mjlab.tasks.tracking.mdp.motion_library import MotionLoader
from mjlab.tasks.tracking.motion_file import (
    MotionFileError,
    check_rate,
    read_motion,
    write_motion,
)
from mjlab.tasks.tracking.motion_sources import find_motions, shipped_motions

ARRAYS = ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")
SQUAT = read_motion(shipped_motions()["squat"])


def arrays(**changes) -> dict:
    """Return the content of a good file of ten frames, as other tools write it, with changes."""
    content = {"fps": np.array([50])} | {key: getattr(SQUAT, key)[:10].copy() for key in ARRAYS}
    content.update(changes)
    return {key: value for key, value in content.items() if value is not None}


def saved(tmp_path, **changes):
    path = tmp_path / "motion.npz"
    np.savez(path, **arrays(**changes))
    return path


def test_what_is_written_is_read(tmp_path):
    path = write_motion(tmp_path / "folder" / "again", SQUAT)
    again = read_motion(path)
    assert path.name == "again.npz"
    assert (again.fps, again.joint_names, again.body_names) == (
        50.0,
        SQUAT.joint_names,
        SQUAT.body_names,
    )
    for key in ARRAYS:
        np.testing.assert_allclose(getattr(again, key), getattr(SQUAT, key), atol=1e-6)
        assert getattr(again, key).dtype == np.float32


def test_the_same_motion_gives_the_same_bytes(tmp_path):
    one, other = (write_motion(tmp_path / name, SQUAT) for name in ("one", "other"))
    assert one.read_bytes() == other.read_bytes()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["one.npz", "other.npz"]


def test_a_file_of_another_tool_loads_as_it_is(tmp_path):
    path = saved(tmp_path, joint_pos=SQUAT.joint_pos[:10].astype(np.float64))
    motion = read_motion(path)
    assert (motion.fps, motion.num_frames, motion.joint_names) == (50.0, 10, ())
    check_rate(path, motion, 0.02)


def test_a_file_without_a_rate_is_taken_at_that_of_the_task(tmp_path):
    path = saved(tmp_path, fps=None)
    motion = read_motion(path)
    assert motion.fps is None
    check_rate(path, motion, 0.01)


def with_nan() -> np.ndarray:
    values = SQUAT.body_lin_vel_w[:10].copy()
    values[7, 3, 1] = np.nan
    return values


def with_long_quaternion() -> np.ndarray:
    values = SQUAT.body_quat_w[:10].copy()
    values[4, 2] *= 1.1
    return values


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_vel": None}, r"missing \['joint_vel'\].*csv-to-npz"),
        (
            {"joint_vel": SQUAT.joint_vel[:9]},
            r"joint_vel: expected .* \(10, 29\), got float32 \(9, 29\)",
        ),
        (
            {"body_pos_w": SQUAT.body_pos_w[:10, :5]},
            r"body_quat_w: expected .* \(10, 5, 4\), got .* \(10, 30, 4\)",
        ),
        (
            {"joint_pos": SQUAT.joint_pos[0]},
            r"joint_pos: expected numbers \(frames, joints\), got .* \(29,\)",
        ),
        (
            {"body_quat_w": SQUAT.body_pos_w[:10]},
            r"body_quat_w: .* \(10, 30, 4\), got .* \(10, 30, 3\)",
        ),
        ({key: getattr(SQUAT, key)[:0] for key in ARRAYS}, "at least 1 frame, got 0"),
        ({"joint_pos": np.full((10, 29), "a")}, "joint_pos: expected numbers .* got <U1"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path, changes, message):
    with pytest.raises(MotionFileError, match=message):
        read_motion(saved(tmp_path, **changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_lin_vel_w": with_nan()}, "body_lin_vel_w .*got 1 .*NaN or infinite.* frame 7"),
        ({"joint_vel": np.full((10, 29), 1e39)}, "float32.*got 290 .*NaN or infinite"),
        ({"joint_vel": SQUAT.joint_vel[:12]}, "'joint_vel'.* more frames"),
        ({"fps": np.array([1e39])}, "fps expected one .* > 0"),
        ({"fps": np.array([0.0])}, "fps expected one .* > 0"),
        ({"fps": np.array([50, 60])}, "fps expected one .* > 0"),
        ({"joint_names": np.array(["a", "b"])}, r"joint_names .* \(2,\)"),
        ({"body_names": np.arange(30)}, "body_names of int64"),
    ],
)
def test_odd_content_is_one_warning(tmp_path, changes, message):
    with pytest.warns(UserWarning, match=message) as warned:
        motion = read_motion(saved(tmp_path, **changes))
    assert len(warned) == 1
    assert motion.num_frames == 10
    assert (motion.fps, motion.joint_names) == (None if "fps" in changes else 50.0, ())
    np.testing.assert_array_equal(motion.joint_pos, SQUAT.joint_pos[:10])


def test_long_quaternions_are_normalized(tmp_path):
    with pytest.warns(UserWarning, match=r"frame 4, body 2 .* 1.1"):
        motion = read_motion(saved(tmp_path, body_quat_w=with_long_quaternion()))
    np.testing.assert_allclose(motion.body_quat_w, SQUAT.body_quat_w[:10], atol=1e-6)


def test_a_single_frame_stands_still(tmp_path):
    with pytest.warns(UserWarning, match="1 frame"):
        motion = read_motion(saved(tmp_path, **{key: getattr(SQUAT, key)[:1] for key in ARRAYS}))
    np.testing.assert_array_equal(motion.body_pos_w, SQUAT.body_pos_w[[0, 0]])


def test_other_keys_and_object_names_are_ignored(tmp_path):
    names = np.array(SQUAT.joint_names, dtype=object)
    motion = read_motion(saved(tmp_path, joint_names=names, notes=np.array([{}], dtype=object)))
    assert motion.joint_names == ()
    assert read_motion(saved(tmp_path, joint_names=names.astype("S"))).joint_names == (
        SQUAT.joint_names
    )


def test_a_pickle_is_not_executed(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the file was executed",))

    path = saved(tmp_path, joint_pos=np.array([Trap()], dtype=object))
    with pytest.raises(MotionFileError, match="cannot be read as a motion"):
        read_motion(path)


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut short"])
def test_a_damaged_file_is_refused(tmp_path, content):
    path = tmp_path / "motion.npz"
    path.write_bytes(content)
    with pytest.raises(MotionFileError, match="cannot be read as a motion"):
        read_motion(path)
    with pytest.raises(MotionFileError, match="cannot be read as a motion.*No such file"):
        read_motion(tmp_path / "other.npz")


def test_another_rate_is_a_warning():
    with pytest.warns(UserWarning, match="fps: expected 30,.* got 50; .*--output-fps 30"):
        check_rate("squat.npz", SQUAT, 1 / 30)


def test_motions_are_found_by_name_by_file_and_by_folder(tmp_path):
    one = part_of("wave", slice(0, 5), tmp_path / "b.npz")
    other = part_of("wave", slice(0, 5), tmp_path / "a.npz")
    assert find_motions("squat") == [shipped_motions()["squat"]]
    assert find_motions(f"wave, {one}") == [shipped_motions()["wave"], one]
    assert find_motions(str(tmp_path)) == [other, one]


def test_a_path_with_a_comma_is_one_path(tmp_path):
    path = part_of("wave", slice(0, 5), tmp_path / "a, b.npz")
    assert find_motions(str(path)) == [path]
    other = part_of("wave", slice(0, 5), tmp_path / "c,d, e.npz")
    assert find_motions(f"squat,{path} , {other},wave") == [
        shipped_motions()["squat"], path, other, shipped_motions()["wave"],
    ]  # fmt: skip
    with pytest.raises(MotionFileError, match="motion 'b.npz'"):
        find_motions(f"squat,b.npz,{other}")


def test_a_list_may_be_longer_than_a_path(tmp_path):
    names = [tmp_path / f"{'x' * 100}{i}.npz" for i in range(60)]
    part_of("wave", slice(0, 5), names[0])
    for name in names[1:]:
        name.write_bytes(names[0].read_bytes())
    assert find_motions(",".join(map(str, names))) == names
    with pytest.raises(MotionFileError, match="motion 'yyy"):
        find_motions("y" * 5000)


def test_bodies_that_a_file_lacks_are_told():
    path = shipped_motions()["wave"]
    assert MotionLoader(path, torch.tensor([0, 29])).body_pos_w.shape == (261, 2, 3)
    for wrong in (30, -1):
        with pytest.raises(MotionFileError, match=rf"in \[0, 29\], got \[{wrong}\]"):
            MotionLoader(path, torch.tensor([0, wrong]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "motion_file: .*side_step, slow_walk, squat"),
        ("sqat", "'sqat'.*did you mean 'squat'"),
        ("squat,dance.npz", "motion 'dance.npz'"),
    ],
)
def test_motions_that_are_not_there_are_told(text, message):
    with pytest.raises(MotionFileError, match=message):
        find_motions(text)


def test_a_folder_without_motions_is_told(tmp_path):
    with pytest.raises(MotionFileError, match=r"Folder .*expected motions \(.npz\), got none"):
        find_motions(str(tmp_path))


@pytest.mark.parametrize("field", [28, 30, 32, 46])
def test_damage_to_the_directory_of_an_archive_is_found(tmp_path, field):
    """The directory at the end names each entry, and has the lengths of three texts."""
    path = write_motion(tmp_path / "motion.npz", SQUAT)
    good = path.read_bytes()
    entries = [match.start() for match in re.finditer(rb"PK\x01\x02", good)]
    assert len(entries) == 9
    for entry in entries:
        damaged = bytearray(good)
        damaged[entry + field] ^= 64
        path.write_bytes(damaged)
        with contextlib.suppress(MotionFileError):
            read = read_motion(path)
            assert (read.joint_names, read.body_names) == (SQUAT.joint_names, SQUAT.body_names)
            assert read.fps == SQUAT.fps
