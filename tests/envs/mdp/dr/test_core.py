"""Laws that every function of the randomization table obeys, on both engines."""

from __future__ import annotations

import inspect
import pickle
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjlab.envs.mdp import dr
from mjlab.envs.mdp.dr._core import select
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

TABLE = {f.row.name: f.row for f in vars(dr).values() if hasattr(f, "row")}
FIELD_TERMS = sorted(name for name, row in TABLE.items() if not row.rotation)
ROTATION_TERMS = sorted(name for name, row in TABLE.items() if row.rotation)
ENGINES = ("native", "warp")
# Geoms with a size that geom_size supports.
PRIMITIVES = ("box", "sphere", "capsule", "cylinder", "ellipsoid")
LAWS = settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

pytestmark = pytest.mark.filterwarnings("ignore:dr.body_mass changes masses")


def snapshot(world: Any, name: str) -> torch.Tensor:
    return getattr(world.sim.model, TABLE[name].field).clone()


def prepare(world: Any, *names: str) -> None:
    for name in names:
        world.sim.expand_model_fields(TABLE[name].fields)


@pytest.mark.parametrize("engine", ENGINES)
def test_every_term_changes_the_chosen_environments_only(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    prepare(world, *TABLE)
    ids = torch.tensor([1, 3])
    for name in FIELD_TERMS:
        before = snapshot(world, name)
        getattr(dr, name)(world, ids, ranges=(1.1, 1.3), asset_cfg=_resolved(world, name))
        changed = (snapshot(world, name) != before).flatten(1).any(dim=1)
        assert changed.tolist() == [False, True, False, True], name


@pytest.mark.parametrize("engine", ENGINES)
def test_every_rotation_changes_the_chosen_environments_only(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    prepare(world, *ROTATION_TERMS)
    for name in ROTATION_TERMS:
        before = snapshot(world, name)
        getattr(dr, name)(world, torch.tensor([2]), roll_range=(0.1, 0.2))
        changed = (snapshot(world, name) != before).flatten(1).any(dim=1)
        assert changed.tolist() == [False, False, True, False], name


@pytest.mark.parametrize("name", FIELD_TERMS)
def test_public_functions_look_as_if_written_by_hand(name: str) -> None:
    function = getattr(dr, name)
    parameters = inspect.signature(function).parameters
    expected = [
        "env",
        "env_ids",
        "ranges",
        "asset_cfg",
        "distribution",
        "operation",
        "axes",
        "shared_random",
        "isotropic",
    ]
    assert list(parameters) == expected[: len(parameters)]
    assert len(parameters) >= 8
    assert parameters["operation"].default == TABLE[name].operation
    assert parameters["distribution"].default == "uniform"
    assert function.__name__ == name
    assert function.__module__.startswith("mjlab.envs.mdp.dr.")
    assert pickle.loads(pickle.dumps(function)) is function
    assert function.__doc__
    assert set(TABLE[name].fields) <= set(function.model_fields)


def test_mujoco_names_are_the_same_functions() -> None:
    assert dr.body_ipos is dr.body_com_offset
    assert dr.dof_damping is dr.joint_damping
    assert dr.tendon_frictionloss is dr.tendon_friction
    assert dr.body_mass.__module__ == "mjlab.envs.mdp.dr.body"


@LAWS
@given(
    name=st.sampled_from([name for name in FIELD_TERMS if TABLE[name].operation != "abs"]),
    low=st.floats(0.5, 1.5),
    width=st.floats(0.0, 0.5),
    operation=st.sampled_from(["add", "scale"]),
)
def test_repeating_does_not_drift_from_the_default(
    make_world: Any, name: str, low: float, width: float, operation: str
) -> None:
    world = _shared_world(make_world)
    default = world.sim.get_default_field(TABLE[name].field)
    bounds = (low, low + width)
    for _ in range(5):
        getattr(dr, name)(
            world, None, ranges=bounds, operation=operation, asset_cfg=_resolved(world, name)
        )
    ends = [default + b if operation == "add" else default * b for b in bounds]
    low_end, high_end = torch.minimum(*ends), torch.maximum(*ends)
    columns = _columns(world, name)
    now = snapshot(world, name)[:, columns]
    assert bool((now >= low_end[columns] - 1e-5).all())
    assert bool((now <= high_end[columns] + 1e-5).all())


@LAWS
@given(data=st.data())
def test_terms_on_different_axes_compose(make_world: Any, data: st.DataObject) -> None:
    world = _shared_world(make_world)
    # A direction is one quantity: its axes cannot be set independently.
    names = [n for n in FIELD_TERMS if snapshot(world, n).ndim > 2 and not TABLE[n].unit]
    name = data.draw(st.sampled_from(names))
    size = snapshot(world, name).shape[-1]
    first, second = data.draw(st.permutations(range(size)).map(lambda p: p[:2]))
    term, chosen = getattr(dr, name), _resolved(world, name)
    term(world, None, ranges={first: (0.4, 0.9)}, operation="abs", asset_cfg=chosen)
    before = snapshot(world, name)
    term(world, None, ranges=(0.2, 0.3), axes=[second], operation="scale", asset_cfg=chosen)
    now = snapshot(world, name)
    others = [axis for axis in range(size) if axis != second]
    assert torch.equal(now[..., others], before[..., others])
    written = now[:, _columns(world, name), first]
    assert bool(((written >= 0.4) & (written <= 0.9)).all())


@LAWS
@given(
    name=st.sampled_from(FIELD_TERMS),
    rows=st.sets(st.integers(0, 3)),
    distribution=st.sampled_from(["uniform", "log_uniform", "gaussian"]),
    shared=st.booleans(),
)
def test_only_chosen_environments_and_objects_change(
    make_world: Any, name: str, rows: set[int], distribution: str, shared: bool
) -> None:
    world = _shared_world(make_world)
    before = snapshot(world, name)
    getattr(dr, name)(
        world,
        torch.tensor(sorted(rows), dtype=torch.long),
        ranges=(0.3, 0.6),
        distribution=distribution,
        shared_random=shared,
        asset_cfg=_resolved(world, name),
    )
    keep = torch.ones(before.shape[:2], dtype=torch.bool)
    for row in rows:
        keep[row, _columns(world, name)] = False
    assert torch.equal(snapshot(world, name)[keep], before[keep])


def test_shared_random_gives_all_objects_one_value(make_world: Any) -> None:
    world = make_world(num_envs=3)
    world.apply(dr.geom_friction, ranges=(0.3, 1.2), shared_random=True)
    friction = world.sim.model.geom_friction[..., 0]
    assert bool((friction == friction[:, :1]).all())
    assert len(friction[:, 0].unique()) == 3


def test_ranges_may_be_lists(make_world: Any) -> None:
    world = make_world()
    world.apply(dr.joint_damping, ranges=[0.5, 0.5])
    assert bool((world.sim.model.dof_damping[:, 6:] == 0.5).all())
    world.apply(dr.body_com_offset, ranges={0: [1.0, 1.0]}, operation="abs")
    assert bool((world.sim.model.body_ipos[:, 1:, 0] == 1.0).all())


def test_name_patterns_replace_the_selection(make_world: Any) -> None:
    world = make_world()
    world.apply(
        dr.joint_damping,
        ranges={"hip": (1.0, 1.0), ".*e": (2.0, 2.0)},
        asset_cfg=SceneEntityCfg("robot", joint_names=("ankle",)),
    )
    expected = torch.tensor([1.0, 2.0, 2.0]).expand(4, 3)
    assert torch.equal(world.sim.model.dof_damping[:, 6:], expected)
    with pytest.raises(ValueError, match=r"'elbow' matches no joint.*hip"):
        world.apply(dr.joint_damping, ranges={"elbow": (1.0, 1.0)})


def test_bad_axes_and_ranges_are_named(make_world: Any) -> None:
    world = make_world()
    with pytest.raises(ValueError, match=r"geom_friction axes.*\[3\]"):
        world.apply(dr.geom_friction, ranges=(0.0, 1.0), axes=[3])
    with pytest.raises(ValueError, match=r"ranges: .*\[1\]"):
        world.apply(dr.geom_friction, ranges={0: (0.0, 1.0)}, axes=[0, 1])
    with pytest.raises(ValueError, match=r"pair of numbers.*0\.5"):
        world.apply(dr.geom_friction, ranges=0.5)
    with pytest.raises(ValueError, match="Unknown operation 'multiply'.*abs.*add.*scale"):
        world.apply(dr.geom_friction, ranges=(0.0, 1.0), operation="multiply")


@pytest.mark.parametrize(
    "params", [{"ranges": (0.7, 0.7), "axes": [1]}, {"ranges": {7: (0.7, 0.7)}}]
)
def test_axes_of_one_number_per_object(make_world: Any, params: dict[str, Any]) -> None:
    world = make_world()
    world.apply(dr.joint_damping, **params)
    assert world.sim.model.dof_damping[:, 6:].flatten().unique().tolist() == pytest.approx([0.7])


def test_a_field_that_is_not_declared_is_expanded(make_world: Any, caplog: Any) -> None:
    world = make_world()
    dr.joint_damping(world, None, ranges=(1.0, 2.0), operation="abs")
    damping = world.sim.model.dof_damping
    assert len(damping[:, -1].unique()) == world.num_envs
    assert caplog.text.count("requires_model_fields('dof_damping')") == 1


def test_quaternions_start_from_the_default_every_time(make_world: Any) -> None:
    world = make_world()
    default = world.sim.get_default_field("body_quat")
    for _ in range(3):
        world.apply(dr.body_quat, yaw_range=(0.3, 0.3))
    angle = 2.0 * torch.acos((world.sim.model.body_quat * default).sum(-1).abs().clamp(max=1.0))
    torch.testing.assert_close(angle[:, 1:], torch.full((4, 4), 0.3), atol=1e-3, rtol=0)


def test_quaternion_perturbation_is_about_the_parents_axes(make_world: Any) -> None:
    world = make_world()
    world.sim.expand_model_fields(("site_quat",))
    # Turning a quarter about the parent's x and then about its z takes y to z, and leaves it there.
    world.apply(dr.site_quat, roll_range=(torch.pi / 2,) * 2, yaw_range=(torch.pi / 2,) * 2)
    world.sim.forward()
    site_in_torso = world.sim.data.xmat[:, 1].transpose(-1, -2) @ world.sim.data.site_xmat[:, 0]
    expected = torch.tensor([0.0, 0.0, 1.0]).expand(4, 3)
    torch.testing.assert_close(site_in_torso[..., 1], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_event_manager_recomputes_constants(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine)
    manager = world.events(
        mass=EventTermCfg(
            func=dr.body_mass,
            mode="startup",
            params={"ranges": (2.0, 2.0), "asset_cfg": SceneEntityCfg("robot")},
        )
    )
    before = world.sim.model.body_subtreemass.clone()
    manager.apply("startup")
    torch.testing.assert_close(world.sim.model.body_subtreemass[:, 1:], 2.0 * before[:, 1:])


def test_a_shifted_centre_of_mass_changes_the_motion(make_world: Any) -> None:
    world = make_world(num_envs=2)
    hips = SceneEntityCfg("robot", body_names=("foot",))
    world.apply(dr.body_com_offset, torch.tensor([1]), ranges={0: (0.1, 0.1)}, asset_cfg=hips)
    world.sim.forward()
    com = world.sim.data.xipos[:, 4, 0].clone()
    torch.testing.assert_close(com[1] - com[0], torch.tensor(0.1), atol=1e-5, rtol=0)
    # The spring of the bent hip swings the leg.
    world.sim.data.qpos[:, 7] = 0.5
    world.sim.forward()
    ankle = world.robot.data.joint_acc[:, 2]
    assert abs(ankle[0] - ankle[1]) > 0.1


def test_frames_that_the_compiler_merged_can_be_moved_apart(make_world: Any) -> None:
    # The thigh's capsule is at the origin of its body, and so is the body's center of mass.
    world = make_world(num_envs=2)
    ids = torch.tensor([1])
    thigh = SceneEntityCfg("robot", geom_names=("capsule",))
    world.apply(dr.geom_pos, ids, ranges={0: (0.1, 0.1)}, asset_cfg=thigh)
    world.apply(dr.site_pos, ids, ranges={0: (0.2, 0.2)})
    world.sim.forward()
    geom, site = world.sim.data.geom_xpos[:, 3, 0], world.sim.data.site_xpos[:, 0, 0]
    assert (geom[1] - geom[0]).item() == pytest.approx(0.1)
    assert (site[1] - site[0]).item() == pytest.approx(0.2)


def chain(mass: float, com: float, damping: float, armature: float) -> str:
    return f"""<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/>
    <inertial pos="0 0 -.2" mass="1" diaginertia=".1 .1 .1"/>
    <body name="lower" pos="0 0 -.4">
    <joint name="b" axis="0 1 0" damping="{damping}" armature="{armature}"/>
    <inertial pos="{com} 0 -.2" mass="{mass}" diaginertia=".1 .1 .1"/></body>
    </body></worldbody></mujoco>"""


def test_a_randomized_robot_moves_like_one_built_that_way(make_world: Any) -> None:
    world = make_world(chain(1.0, 0.0, 0.1, 0.01))
    lower = SceneEntityCfg("robot", body_names=("lower",), joint_names=("b",))
    ids = torch.tensor([2])
    world.apply(dr.body_mass, ids, ranges=(3.0, 3.0), asset_cfg=lower)
    world.apply(dr.body_com_offset, ids, ranges={0: (0.15, 0.15)}, asset_cfg=lower)
    world.apply(dr.joint_damping, ids, ranges=(0.5, 0.5), asset_cfg=lower)
    world.apply(dr.joint_armature, ids, ranges=(0.05, 0.05), asset_cfg=lower)
    built = make_world(chain(3.0, 0.15, 0.5, 0.05))
    for each in (world, built):
        each.sim.data.qpos[:] = torch.tensor([0.5, -0.7])
        each.sim.data.qvel[:] = torch.tensor([1.0, -2.0])
        each.sim.step(20)
    torch.testing.assert_close(world.sim.data.qpos[2], built.sim.data.qpos[0], atol=1e-5, rtol=1e-5)
    for field in ("dof_invweight0", "body_invweight0", "body_subtreemass"):
        torch.testing.assert_close(
            getattr(world.sim.model, field)[2], built.sim.get_default_field(field), msg=field
        )
    # The robot is unchanged in the other environments.
    plain = make_world(chain(1.0, 0.0, 0.1, 0.01))
    plain.sim.data.qpos[:] = torch.tensor([0.5, -0.7])
    plain.sim.data.qvel[:] = torch.tensor([1.0, -2.0])
    plain.sim.step(20)
    torch.testing.assert_close(world.sim.data.qpos[0], plain.sim.data.qpos[0])


def test_body_mass_warns_that_inertia_stays(make_world: Any) -> None:
    world = make_world()
    with pytest.warns(UserWarning, match="pseudo_inertia"):
        world.apply(dr.body_mass, ranges=(0.9, 1.1))


def _resolved(world: Any, name: str) -> SceneEntityCfg:
    geoms = PRIMITIVES if name == "geom_size" else None
    cfg = SceneEntityCfg("robot", geom_names=geoms)
    cfg.resolve(world.scene)
    return cfg


def _columns(world: Any, name: str) -> list[int]:
    return select(world, None, _resolved(world, name), TABLE[name].kind).columns.tolist()


_WORLDS: dict[str, Any] = {}


def _shared_world(make_world: Any) -> Any:
    """Return one world for all examples of the laws, with every field expanded."""
    if "world" not in _WORLDS:
        _WORLDS["world"] = make_world()
        prepare(_WORLDS["world"], *TABLE)
    return _WORLDS["world"]
