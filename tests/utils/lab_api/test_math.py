"""Laws of rotations and poses, and agreement with scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mjlab.utils.lab_api import math as m

laws = settings(deadline=None, max_examples=40)

TIGHT = {"atol": 1e-9, "rtol": 0.0}


def _tensor(seed: int, *shape: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def _quat(seed: int, n: int = 6) -> torch.Tensor:
    """Random unit quaternions, and with them the awkward ones."""
    half = math.sqrt(0.5)
    awkward = [[1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [half, 0, -half, 0]]
    awkward += [[math.cos(1e-9), math.sin(1e-9), 0, 0], [math.cos(1e-4), 0, math.sin(1e-4), 0]]
    quats = torch.cat((_tensor(seed, n, 4), torch.tensor(awkward, dtype=torch.float64)))
    return quats / quats.norm(dim=-1, keepdim=True)


def _scipy(quat: torch.Tensor) -> Rotation:
    return Rotation.from_quat(m.convert_quat(quat).numpy())


def assert_close(actual, expected, **tolerance) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected), **{**TIGHT, **tolerance})


def assert_same_rotation(q1: torch.Tensor, q2: torch.Tensor) -> None:
    assert_close((q1 * q2).sum(-1).abs(), torch.ones_like(q1[..., 0]))


seeds = st.integers(0, 10_000)


@laws
@given(seeds)
def test_quaternions_are_a_group_that_acts_on_vectors(seed):
    a, b, c = _quat(seed), _quat(seed + 1), _quat(seed + 2)
    v = _tensor(seed, len(a), 3)
    one = m.default_orientation(len(a), "cpu").double()
    assert_close(m.quat_mul(m.quat_mul(a, b), c), m.quat_mul(a, m.quat_mul(b, c)))
    assert_close(m.quat_mul(a, one), a)
    assert_close(m.quat_mul(a, m.quat_inv(a)), one)
    assert_close(m.quat_conjugate(a), m.quat_inv(a))
    assert_close(m.quat_apply(m.quat_mul(a, b), v), m.quat_apply(a, m.quat_apply(b, v)))
    assert_close(m.quat_apply_inverse(a, m.quat_apply(a, v)), v)
    assert_close(m.quat_apply(a, v).norm(dim=-1), v.norm(dim=-1))


@laws
@given(seeds)
def test_rotations_agree_with_scipy(seed):
    q1, q2 = _quat(seed), _quat(seed + 1)
    v = _tensor(seed, len(q1), 3)
    r1, r2 = _scipy(q1), _scipy(q2)
    assert_close(m.matrix_from_quat(q1), r1.as_matrix())
    assert_close(m.quat_apply(q1, v), r1.apply(v.numpy()))
    assert_close(m.quat_apply_inverse(q1, v), r1.inv().apply(v.numpy()))
    product = torch.from_numpy((r1 * r2).as_quat())
    assert_same_rotation(m.quat_mul(q1, q2), m.convert_quat(product, to="wxyz"))
    # At angle pi, both directions of the axis are valid, so only angles are compared.
    assert_close(m.axis_angle_from_quat(q1).norm(dim=-1), r1.magnitude())
    assert_close(m.quat_error_magnitude(q1, q2), (r1 * r2.inv()).magnitude(), atol=1e-7)


@laws
@given(seeds)
def test_euler_angles_agree_with_scipy(seed):
    roll, pitch, yaw = _tensor(seed, 3, 8)
    quat = m.quat_from_euler_xyz(roll, pitch, yaw)
    rotation = Rotation.from_euler("xyz", torch.stack((roll, pitch, yaw), -1).numpy())
    assert_close(m.matrix_from_quat(quat), rotation.as_matrix())
    back = m.quat_from_euler_xyz(*m.euler_xyz_from_quat(quat))
    assert_same_rotation(back, quat)
    for convention in ("XYZ", "ZYX", "ZXZ"):
        angles = _tensor(seed, 4, 3)
        expected = Rotation.from_euler(convention, angles.numpy()).as_matrix()
        assert_close(m.matrix_from_euler(angles, convention), expected)


def test_euler_angles_broadcast():
    yaw = torch.linspace(-1.0, 1.0, 5)
    expected = m.quat_from_euler_xyz(torch.full((5,), 0.1), torch.zeros(5), yaw)
    assert_close(m.quat_from_euler_xyz(torch.tensor(0.1), torch.zeros(1), yaw), expected)


def test_euler_angles_can_be_wrapped_and_the_pole_is_finite():
    quat = m.quat_from_euler_xyz(*torch.tensor([[-0.1], [-0.2], [-0.3]]))
    wrapped = torch.cat(m.euler_xyz_from_quat(quat, wrap_to_2pi=True))
    assert_close(wrapped, 2 * math.pi - torch.tensor([0.1, 0.2, 0.3]), atol=1e-6)
    pole = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5) * (1 + 1e-7), 0.0])
    assert math.isclose(m.euler_xyz_from_quat(pole)[1], math.pi / 2, abs_tol=1e-3)


@laws
@given(seeds)
def test_conversions_survive_round_trips(seed):
    quat = _quat(seed)
    assert_same_rotation(m.quat_from_matrix(m.matrix_from_quat(quat)), quat)
    assert_close(m.matrix_from_quat(3.0 * quat), m.matrix_from_quat(quat))
    rotation_vector = m.axis_angle_from_quat(quat)
    angle = rotation_vector.norm(dim=-1)
    assert angle.max() <= math.pi + 1e-9
    assert_same_rotation(m.quat_from_angle_axis(angle, rotation_vector), quat)
    assert_close(m.convert_quat(m.convert_quat(quat), to="wxyz"), quat)
    unique = m.quat_unique(quat)
    assert (unique[:, 0] >= 0).all()
    assert_same_rotation(unique, quat)


@laws
@given(seeds)
def test_the_quaternion_of_a_matrix_has_its_largest_component_positive(seed):
    quat = m.quat_from_matrix(m.matrix_from_quat(_quat(seed)))
    largest = quat.abs().argmax(dim=-1, keepdim=True)
    assert (quat.gather(-1, largest) > 0).all()


def test_the_first_component_of_the_quaternion_of_a_matrix_can_be_negative():
    quat = m.normalize(torch.tensor([-0.1, 0.9, 0.2, 0.1]))
    assert_close(m.quat_from_matrix(m.matrix_from_quat(quat)), quat, atol=1e-6)


@laws
@given(seeds)
def test_box_minus_and_plus_undo_each_other_in_world_axes(seed):
    a, b = _quat(seed), _quat(seed + 1)
    delta = m.quat_box_minus(a, b)
    assert_same_rotation(m.quat_box_plus(b, delta), a)
    assert_same_rotation(m.quat_mul(m.quat_from_angle_axis(delta.norm(dim=-1), delta), b), a)
    assert_close(m.quat_box_plus(b, torch.full((len(b), 3), 1e-7).double()), b)


def test_small_rotation_vectors_are_precise_in_float32():
    vector = torch.tensor([[3e-7, -2e-7, 1e-7], [1e-3, 0.0, 2e-3], [0.0, 0.0, 0.0]])
    quat = m.quat_from_angle_axis(vector.norm(dim=-1), vector)
    torch.testing.assert_close(m.axis_angle_from_quat(quat), vector, rtol=1e-4, atol=1e-12)


@laws
@given(seeds)
def test_yaw_is_what_is_left_of_the_heading(seed):
    quat = _quat(seed, 20)[:20]
    forward = torch.tensor([1.0, 0.0, 0.0]).double().expand(20, 3)
    heading = m.quat_apply(quat, forward)[:, :2]
    turned = m.quat_apply(m.yaw_quat(quat), forward)
    assert_close(turned[:, :2], heading / heading.norm(dim=-1, keepdim=True), atol=1e-7)
    assert_close(m.quat_apply_yaw(quat, forward), turned)
    assert_close(m.yaw_quat(m.yaw_quat(quat)), m.yaw_quat(quat))


def test_one_quaternion_rotates_many_vectors_and_shapes_are_kept():
    quat, vec = _quat(0)[:4], _tensor(1, 2, 2, 3)
    expected = m.quat_apply(quat, vec.reshape(4, 3)).reshape(2, 2, 3)
    assert_close(m.quat_apply(quat, vec), expected)
    assert_close(m.quat_apply(quat[:1], vec), m.quat_apply(quat[0].expand(2, 2, 4), vec))
    assert_close(m.quat_apply(quat[:2].unsqueeze(1), vec)[1], m.quat_apply(quat[1], vec[1]))
    assert m.quat_apply(quat[0], vec[0, 0]).shape == (3,)


@pytest.mark.parametrize(("q", "v"), [((3, 4), (5, 3)), ((2, 4), (2, 2, 3)), ((3, 3), (3, 3))])
def test_sizes_that_do_not_fit_are_refused(q, v):
    with pytest.raises(ValueError, match=r"one per vector or one for all"):
        m.quat_apply(torch.ones(q), torch.ones(v))


def test_products_need_equal_shapes():
    with pytest.raises(ValueError, match=r"equal shapes, got \[3, 4\] and \[1, 4\]"):
        m.quat_mul(torch.ones(3, 4), torch.ones(1, 4))


@laws
@given(seeds, st.floats(0, 1))
def test_slerp_agrees_with_scipy_and_leaves_its_arguments_alone(seed, tau):
    """The defect: q2 was negated in place when the dot product was negative."""
    for q1, q2 in zip(_quat(seed), _quat(seed + 1), strict=True):
        if abs(float(torch.dot(q1, q2))) < 1e-6:
            continue  # Half a turn apart: both ways are short.
        before = (q1.clone(), q2.clone())
        result = m.quat_slerp(q1, q2, tau)
        assert torch.equal(q1, before[0])
        assert torch.equal(q2, before[1])
        first, second = _scipy(q1), _scipy(q2)
        step = Rotation.from_rotvec(tau * (second * first.inv()).as_rotvec())
        expected = m.convert_quat(torch.from_numpy((step * first).as_quat()), to="wxyz")
        assert_same_rotation(result, expected)


def test_slerp_ends_and_equal_rotations():
    q1, q2 = _quat(0)[:2]
    q2 = -q2 if torch.dot(q1, q2) > 0 else q2
    assert torch.equal(m.quat_slerp(q1, q2, 0.0), q1)
    assert torch.equal(m.quat_slerp(q1, q2, 1.0), q2)
    for same in (q1, -q1):
        assert torch.equal(m.quat_slerp(q1, same, 0.5), q1)
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        m.quat_slerp(q1.expand(2, 4), q1.expand(2, 4), 0.5)


@laws
@given(st.floats(-50, 50))
def test_wrapped_angles_are_the_same_angles(angle):
    wrapped = m.wrap_to_pi(torch.tensor([angle], dtype=torch.float64))
    assert abs(float(wrapped)) <= math.pi
    assert math.isclose(math.cos(float(wrapped)), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(float(wrapped)), math.sin(angle), abs_tol=1e-9)


def test_odd_multiples_of_pi_keep_their_sign():
    pi = math.pi
    wrapped = m.wrap_to_pi(torch.tensor([pi, -pi, 0.0], dtype=torch.float64))
    assert wrapped.tolist() == [pi, -pi, 0.0]
    odd = torch.tensor([3 * pi, -3 * pi], dtype=torch.float64)
    assert_close(m.wrap_to_pi(odd).abs(), torch.full((2,), pi, dtype=torch.float64))


@laws
@given(seeds)
def test_frames_combine_and_subtract(seed):
    q1, q2 = _quat(seed), _quat(seed + 1)
    t1, t2 = _tensor(seed, len(q1), 3), _tensor(seed + 1, len(q1), 3)
    t02, q02 = m.combine_frame_transforms(t1, q1, t2, q2)
    t12, q12 = m.subtract_frame_transforms(t1, q1, t02, q02)
    assert_close(t12, t2)
    assert_same_rotation(q12, q2)
    pose = m.make_pose(t1, m.matrix_from_quat(q1)) @ m.make_pose(t2, m.matrix_from_quat(q2))
    assert_close(m.unmake_pose(pose)[0], t02)
    assert_close(m.unmake_pose(pose)[1], m.matrix_from_quat(q02))
    # None stands for zero and identity.
    zero, one = torch.zeros_like(t1), m.default_orientation(len(q1), "cpu").double()
    for function in (m.combine_frame_transforms, m.subtract_frame_transforms):
        for given_none, spelled in zip(function(t1, q1), function(t1, q1, zero, one), strict=True):
            assert_close(given_none, spelled)


@laws
@given(seeds)
def test_the_pose_error_takes_one_pose_to_the_other(seed):
    q1, q2 = _quat(seed), _quat(seed + 1)
    t1, t2 = _tensor(seed, len(q1), 3), _tensor(seed + 1, len(q1), 3)
    shift, vector = m.compute_pose_error(t1, q1, t2, q2)
    assert_close(vector, m.quat_box_minus(q2, q1))
    moved, turned = m.apply_delta_pose(t1, q1, torch.cat((shift, vector), dim=-1))
    assert_close(moved, t2)
    assert_same_rotation(turned, q2)
    _, quat = m.compute_pose_error(t1, q1, t2, q2, rot_error_type="quat")
    assert_same_rotation(m.quat_mul(quat, q1), q2)


def test_an_unknown_kind_of_pose_error_is_refused():
    t, q = torch.zeros(1, 3), torch.ones(1, 4)
    with pytest.raises(ValueError, match="'quat', 'axis_angle'"):
        m.compute_pose_error(t, q, t, q, rot_error_type="euler")  # ty: ignore[invalid-argument-type]


def test_a_twist_is_that_of_a_point_on_the_body():
    quat, spin, arm = _quat(0)[:1], _tensor(1, 1, 3), _tensor(2, 1, 3)
    v1, w1 = m.rigid_body_twist_transform(_tensor(3, 1, 3), spin, arm, quat)
    assert_close(m.quat_apply(quat, w1), spin)
    assert_close(m.quat_apply(quat, v1), _tensor(3, 1, 3) + torch.linalg.cross(spin, arm))


def test_points_are_transformed_in_every_combination_of_shapes():
    points, pos, quat = _tensor(0, 5, 3), _tensor(1, 2, 3), _quat(2)[:2]
    expected = torch.stack([m.quat_apply(quat[i].expand(5, 4), points) + pos[i] for i in range(2)])
    assert_close(m.transform_points(points, pos, quat), expected)
    assert_close(m.transform_points(points.expand(2, 5, 3), pos, quat), expected)
    assert_close(m.transform_points(points, pos[1], quat[1]), expected[1])
    assert_close(m.transform_points(points, pos[0], quat), expected - pos[:, None] + pos[0])
    assert_close(m.transform_points(points), points)
    assert_close(m.transform_points(points[None], pos, quat), expected)


def test_identity_poses_are_recognised():
    zero, one = torch.zeros(3, 3), m.default_orientation(3, "cpu")
    assert m.is_identity_pose(zero, one)
    assert m.is_identity_pose(zero, -one)
    assert not m.is_identity_pose(zero + 0.1, one)
    assert not m.is_identity_pose(zero, one.roll(1, dims=1))


@laws
@given(seeds)
def test_pose_matrices(seed):
    quat = _quat(seed)
    pose = m.make_pose(_tensor(seed, len(quat), 3), m.matrix_from_quat(quat))
    eye = torch.eye(4).double().expand_as(pose)
    assert_close(m.pose_inv(pose) @ pose, eye)
    a, b = pose[0], pose[1]
    assert_close(m.pose_in_A_to_pose_in_B(pose, a), a @ pose)
    moved = m.transform_poses_from_frame_A_to_frame_B(pose, a, b)
    assert_close(m.pose_inv(b) @ moved, m.pose_inv(a) @ pose)


def test_shapes_of_poses_are_checked():
    with pytest.raises(ValueError, match=r"got \[2, 3\] and \[3, 3, 3\]"):
        m.make_pose(torch.ones(2, 3), torch.ones(3, 3, 3))
    with pytest.raises(ValueError, match=r"\[4, 4\]"):
        m.quat_from_matrix(torch.eye(4))


@pytest.mark.parametrize("axis_angle", [True, False])
def test_interpolated_rotations_turn_by_equal_steps(axis_angle):
    first, last = m.matrix_from_quat(_quat(4)[:2])
    path = m.interpolate_rotations(first, last, 5, axis_angle)
    assert path.shape == (6, 3, 3)
    assert_close(path[0], first)
    assert_close(path[5], last)
    quats = m.quat_from_matrix(path)
    steps = m.quat_error_magnitude(quats[1:], quats[:-1])
    assert_close(steps, steps[:1].expand(5))


def test_interpolated_poses_go_straight():
    quats = _quat(4)[:2]
    ends = m.make_pose(_tensor(5, 2, 3), m.matrix_from_quat(quats))
    poses, between = m.interpolate_poses(ends[0], ends[1], num_steps=3)
    assert (poses.shape, between) == ((5, 4, 4), 3)
    assert_close(poses[0], ends[0])
    assert_close(poses[-1], ends[1])
    assert_close(poses[2, :3, 3], ends[:, :3, 3].mean(0))
    distance = float((ends[1] - ends[0])[:3, 3].norm())
    _, between = m.interpolate_poses(ends[0], ends[1], step_size=distance / 2.5)
    assert between == 3
    torch.manual_seed(0)
    perturbed, _ = m.interpolate_poses(ends[0], ends[1], num_steps=3, perturb=True)
    assert_close(perturbed[[0, -1]], poses[[0, -1]])
    shift = (perturbed - poses)[1:-1, :3, 3].norm(dim=-1)
    assert (shift > 0).all()
    assert shift.max() <= distance / 8 + 1e-9
    for options in ({}, {"num_steps": 2, "step_size": 0.1}):
        with pytest.raises(ValueError, match="either num_steps or step_size"):
            m.interpolate_poses(ends[0], ends[1], **options)


# View direction and up axis of each convention.
LOOKS = {"opengl": ([0, 0, -1], [0, 1, 0]), "ros": ([0, 0, 1], [0, -1, 0])}
LOOKS["world"] = ([1, 0, 0], [0, 0, 1])


@pytest.mark.parametrize("origin", LOOKS)
@pytest.mark.parametrize("target", LOOKS)
def test_a_camera_looks_the_same_way_in_every_convention(origin, target):
    quat = _quat(0)
    converted = m.convert_camera_frame_orientation_convention(quat, origin, target)
    for before, after in zip(LOOKS[origin], LOOKS[target], strict=True):
        directions = [torch.tensor(v).double().expand(len(quat), 3) for v in (before, after)]
        assert_close(m.quat_apply(converted, directions[1]), m.quat_apply(quat, directions[0]))


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_a_camera_looks_at_its_target_upright(up_axis):
    eyes, targets = _tensor(0, 5, 3), _tensor(1, 5, 3)
    up = torch.tensor([0.0, up_axis == "Y", up_axis == "Z"]).double()
    targets[0] = eyes[0] - up  # Straight down.
    matrix = m.create_rotation_matrix_from_view(eyes, targets, up_axis)
    assert_close(matrix @ matrix.transpose(1, 2), torch.eye(3).double().expand(5, 3, 3), atol=1e-7)
    assert_close(torch.linalg.det(matrix), torch.ones(5).double(), atol=1e-7)
    toward = m.normalize(targets - eyes)
    assert_close(-matrix[:, :, 2], toward, atol=1e-7)
    assert_close(matrix[1:, :, 0] @ up, torch.zeros(4).double(), atol=1e-7)
    assert (matrix[1:, :, 1] @ up > 0).all()
    with pytest.raises(ValueError, match="'Y', 'Z'"):
        m.create_rotation_matrix_from_view(eyes, targets, "X")  # ty: ignore[invalid-argument-type]


@pytest.mark.parametrize("convention", ["XXZ", "xyz", "XY"])
def test_unknown_euler_conventions_are_refused(convention):
    with pytest.raises(ValueError, match="three letters"):
        m.matrix_from_euler(torch.zeros(3), convention)


def test_ranges_and_vectors():
    low, high = torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 4.0])
    x = torch.tensor([[0.0, 3.5], [-5.0, 9.0]])
    assert_close(m.unscale_transform(m.scale_transform(x, low, high), low, high), x, atol=1e-6)
    assert m.scale_transform(torch.stack((low, high)), low, high).tolist() == [[-1, -1], [1, 1]]
    assert m.saturate(x, low, high).tolist() == [[0, 3.5], [-1, 4]]
    assert m.copysign(2.0, torch.tensor([-1.0, 3.0])).tolist() == [-2, 2]
    assert m.normalize(torch.zeros(2, 3)).tolist() == [[0, 0, 0]] * 2
    a, b = _tensor(0, 4, 3), _tensor(1, 4, 3)
    crossed = (m.skew_symmetric_matrix(a) @ b.unsqueeze(-1)).squeeze(-1)
    assert_close(crossed, torch.linalg.cross(a, b))
    assert_close(m.skew_symmetric_matrix(a[0]), m.skew_symmetric_matrix(a[:1]))
    assert m.quat_apply(torch.tensor([0, 0, 0, 1]), torch.tensor([1, 2, 3])).tolist() == [-1, -2, 3]


def test_reordering_takes_arrays_and_checks_its_arguments():
    assert m.convert_quat(np.array([1, 2, 3, 4])).tolist() == [2, 3, 4, 1]
    assert m.convert_quat(torch.tensor([[1, 2, 3, 4]]), to="wxyz").tolist() == [[4, 1, 2, 3]]
    with pytest.raises(ValueError, match="'xyzw', 'wxyz'"):
        m.convert_quat(torch.ones(4), to="wxy")  # ty: ignore[invalid-argument-type]
    with pytest.raises(ValueError, match=r"got \(3,\)"):
        m.convert_quat(torch.ones(3))


# Task packages compile functions when they are imported. Not those that take sizes, names or arrays.
NOT_SCRIPTED = {
    "compute_pose_error",
    "convert_camera_frame_orientation_convention",
    "convert_quat",
    "create_rotation_matrix_from_view",
    "interpolate_poses",
    "interpolate_rotations",
    "quat_slerp",
}
SCRIPTED = [n for n in m.__all__ if n not in NOT_SCRIPTED and not n.startswith("sample_")]
# Arguments of those with other arguments than quaternions.
_Q, _V, _R = m.normalize(_tensor(7, 4, 4)), _tensor(8, 4, 3), m.matrix_from_quat(_quat(9)[:4])
_K = torch.tensor([[9.0, 0.1, 2.0], [0.0, 8.0, 3.0], [0.0, 0.0, 1.0]]).double()
ARGUMENTS = {
    "apply_delta_pose": (_V, _Q, _tensor(1, 4, 6)),
    "combine_frame_transforms": (_V, _Q, _V, _Q),
    "copysign": (2.0, _V),
    "default_orientation": (3, "cpu"),
    "generate_random_rotation": (),
    "generate_random_transformation_matrix": (),
    "generate_random_translation": (),
    "is_identity_pose": (_V, _Q),
    "make_pose": (_V, _R),
    "matrix_from_euler": (_V, "XZX"),
    "matrix_product": (_R, _R),
    "orthogonalize_perspective_depth": (_tensor(2, 2, 3, 4), _K),
    "pose_in_A_to_pose_in_B": (_R, _R),
    "pose_inv": (m.make_pose(_V, _R),),
    "project_points": (_V, _K),
    "quat_from_angle_axis": (_V[:, 0], _V),
    "quat_from_euler_xyz": tuple(_V.T),
    "quat_from_matrix": (_R,),
    "random_orientation": (3, "cpu"),
    "random_yaw_orientation": (3, "cpu"),
    "rigid_body_twist_transform": (_V, _V, _V, _Q),
    "saturate": (_V, -_V.abs(), _V.abs()),
    "scale_transform": (_V, -_V.abs(), _V.abs()),
    "skew_symmetric_matrix": (_V,),
    "subtract_frame_transforms": (_V, _Q, _V, _Q),
    "transform_points": (_V, _V, _Q),
    "transform_poses_from_frame_A_to_frame_B": (m.make_pose(_V, _R),) * 3,
    "unmake_pose": (m.make_pose(_V, _R),),
    "unproject_depth": (_tensor(2, 2, 3, 4), _K, False),
    "unscale_transform": (_V, -_V.abs(), _V.abs()),
}
ARGUMENTS |= dict.fromkeys(("quat_box_minus", "quat_error_magnitude", "quat_mul"), (_Q, _Q.flip(0)))
ARGUMENTS |= dict.fromkeys(("quat_apply", "quat_apply_inverse", "quat_apply_yaw"), (_Q, _V))
ARGUMENTS |= dict.fromkeys(("quat_rotate", "quat_rotate_inverse", "quat_box_plus"), (_Q, _V))


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
@pytest.mark.parametrize("name", SCRIPTED)
def test_functions_compile_with_torchscript(name):
    function = getattr(m, name)
    arguments = ARGUMENTS.get(name, (_Q,))
    torch.manual_seed(0)
    expected = function(*arguments)
    torch.manual_seed(0)
    torch.testing.assert_close(torch.jit.script(function)(*arguments), expected)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
def test_compiled_rotations_broadcast():
    rotate = torch.jit.script(m.quat_apply)
    for quat in (_Q[:1], _Q[0], _Q.reshape(2, 2, 4), _Q[:2, None]):
        vec = _V if quat.numel() == 4 else _V.reshape(2, 2, 3)
        assert_close(rotate(quat, vec), m.quat_apply(quat, vec))
    with pytest.raises(torch.jit.Error, match="one per vector or one for all"):
        rotate(_Q[:3], _V)
