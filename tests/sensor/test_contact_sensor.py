"""Tests of contact data against plain MuJoCo and against values computed by hand."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.sensor import BuiltinSensor, ContactData
from mjlab.sensor.contact_sensor import FIELD_SIZES

from .contact_scenes import (
    BOX,
    DT,
    GRAVITY,
    LEGS,
    LOPSIDED,
    TERRAIN,
    body,
    build,
    compose,
    geom,
    plain_contacts,
    sense,
    settle,
    stack,
    subtree,
)

WEIGHT = 2 * GRAVITY
ALL_FIELDS = tuple(FIELD_SIZES)


def assert_close(actual: torch.Tensor, expected, atol: float = 1e-3) -> None:
    torch.testing.assert_close(
        actual, torch.as_tensor(expected, dtype=torch.float32), rtol=1e-3, atol=atol
    )


# Known by hand.


def test_a_box_on_the_ground_presses_its_weight_into_it():
    cfg = sense(geom("box"), TERRAIN, fields=ALL_FIELDS, reduce="none", num_slots=6)
    sim, scene = build(cfg, box=BOX)
    settle(sim)
    data = scene["touch"].data
    assert data.found[1].tolist() == [4, 4, 4, 4, 0, 0]
    assert_close(data.force[1, :, 0].sum(), WEIGHT)
    assert_close(data.normal[1, :4], [[0.0, 0.0, -1.0]] * 4)
    assert (data.dist[1, :4] < 0).all(), "it sinks in a little"
    assert_close(data.pos[1, :4].abs(), [[0.1, 0.1, 0.0]] * 4, atol=3e-3)
    for name in ALL_FIELDS:
        assert not getattr(data, name)[1, 4:].any(), f"{name} of an empty slot"


def test_the_net_force_is_what_the_primary_does_to_the_secondary():
    cfg = sense(geom("box"), TERRAIN, fields=ALL_FIELDS, reduce="netforce", num_slots=2)
    sim, scene = build(cfg, box=BOX)
    settle(sim)
    data = scene["touch"].data
    assert data.found.tolist() == [[4, 0]] * 2
    assert_close(data.force[0], [[0.0, 0.0, -WEIGHT], [0.0, 0.0, 0.0]])
    assert_close(data.pos[0, 0], [0.0, 0.0, 0.0], atol=2e-3)
    assert_close(data.dist[0], [0.0, 0.0])
    assert_close(data.normal[0, 0], [1.0, 0.0, 0.0])


def test_the_ground_as_primary_presses_back():
    cfg = sense(body("terrain", "terrain"), body("box"), reduce="netforce")
    sim, scene = build(cfg, box=BOX)
    settle(sim)
    assert_close(scene["touch"].data.force[0], [[0.0, 0.0, WEIGHT]])


def test_of_two_stacked_boxes_the_lower_one_carries_both():
    upper = BOX.replace("0 0 .0999", "0 0 .2997")
    sensors = [
        sense(geom("box", "low"), TERRAIN, reduce="netforce"),
        sense(geom("box", "low"), geom("box", "top"), reduce="netforce"),
        sense(geom("box", "low"), reduce="netforce"),
    ]
    for name, sensor in zip(("ground", "top", "all"), sensors, strict=True):
        sensor.name = name
    sim, scene = build(*sensors, low=BOX, top=upper)
    settle(sim, 800)
    assert_close(scene["ground"].data.force[0, 0], [0.0, 0.0, -2 * WEIGHT], atol=0.05)
    assert_close(scene["top"].data.force[0, 0], [0.0, 0.0, WEIGHT], atol=0.05)
    assert scene["ground"].data.found[0] == scene["top"].data.found[0] == 4
    assert scene["all"].data.found[0] == 8, "without a secondary, anything counts"


def test_a_ball_that_gravity_pulls_against_a_wall():
    wall = "<mujoco><worldbody><geom name='wall' type='box' size='.1 1 1' pos='.1 0 0'/></worldbody></mujoco>"
    ball = """<mujoco><worldbody><body name="ball" pos="-.05 0 0"><joint type="slide" axis="1 0 0"
      name="x" damping="5"/><geom name="ball" size=".05" mass="1.5"/></body></worldbody></mujoco>"""
    cfg = sense(geom("ball", "ball"), geom("wall", "wall"), fields=ALL_FIELDS)
    sim, scene = build(cfg, wall=wall, ball=ball, terrain=False, gravity=(GRAVITY, 0.0, 0.0))
    settle(sim)
    data = scene["touch"].data
    assert_close(data.normal[0, 0], [1.0, 0.0, 0.0])
    assert_close(data.force[0, 0], [1.5 * GRAVITY, 0.0, 0.0])
    assert_close(data.pos[0, 0], [0.0, 0.0, 0.0], atol=3e-3)


def test_a_subtree_senses_contacts_within_itself():
    cfg = sense(subtree("trunk", "robot"), subtree("trunk", "robot"), reduce="none", num_slots=3)
    other = sense(body("trunk", "robot"))
    other.name = "trunk_itself"
    sim, scene = build(cfg, other, robot=LEGS, terrain=False)
    sim.forward()
    assert not scene["touch"].data.found.any()
    sim.data.qpos[:, 2] = 5.0
    # Both feet meet in the middle.
    robot = scene["robot"]
    legs = LEGS.replace('type="slide"', 'type="slide" axis="0 1 0"')
    sim, scene = build(cfg, other, robot=legs, terrain=False)
    robot = scene["robot"]
    robot.write_joint_position_to_sim(torch.tensor([[-0.04, 0.04]] * 2))
    sim.forward()
    assert scene["touch"].data.found[0, 0] >= 1
    assert not scene["trunk_itself"].data.found.any(), "a body is not its subtree"


# Against the contact list of plain MuJoCo.


def lopsided(**fields):
    cfg = sense(geom("box"), TERRAIN, fields=ALL_FIELDS, num_slots=4, **fields)
    sim, scene = build(cfg, box=LOPSIDED)
    sim.step(nstep=100)
    sim.data.qvel[:, 0] += 0.1
    sim.forward()
    contacts = plain_contacts(sim, "box/box")
    assert len(contacts) >= 3, "the case is to have several contacts of different force"
    return scene["touch"].data, contacts


def assert_same_contacts(data: ContactData, contacts) -> None:
    n = len(contacts)
    assert data.found[0].tolist() == [n] * n + [0] * (4 - n)
    for field in ("dist", "pos", "normal", "tangent"):
        assert_close(getattr(data, field)[0, :n], stack(contacts, field), atol=1e-4)
    assert_close(data.force[0, :n, 0], stack(contacts, "normal_force"))


def test_no_reduction_reports_contacts_in_mujocos_order():
    data, contacts = lopsided(reduce="none")
    assert_same_contacts(data, contacts)


def test_mindist_reports_the_deepest_first():
    data, contacts = lopsided(reduce="mindist")
    assert_same_contacts(data, sorted(contacts, key=lambda one: one.dist))


def test_maxforce_reports_the_strongest_first():
    data, contacts = lopsided(reduce="maxforce")
    assert_same_contacts(data, sorted(contacts, key=lambda one: -sum(one.force**2)))


def test_netforce_is_the_sum_in_the_world_frame():
    data, contacts = lopsided(reduce="netforce")
    assert data.found[0].tolist() == [len(contacts), 0, 0, 0]
    assert_close(data.force[0, 0], stack(contacts, "force").sum(0))
    weights = stack(contacts, "force").norm(dim=1, keepdim=True)
    middle = (weights * stack(contacts, "pos")).sum(0) / weights.sum()
    assert_close(data.pos[0, 0], middle, atol=1e-3)


@settings(max_examples=12, deadline=None)
@given(
    tilt=st.floats(-0.5, 0.5), heading=st.floats(0, 2 * math.pi), ground_first=st.booleans(),
    turned=st.floats(0, math.pi), condim=st.sampled_from((3, 4, 6)),
)  # fmt: skip
def test_force_is_rotated_into_the_right_axes(tilt, heading, ground_first, turned, condim):
    """A sliding, turning box on a slope, whichever of the two geoms is the primary."""
    box = f"""<mujoco><worldbody><body name="box" pos="0 0 .1"><freejoint/>
      <geom name="box" type="box" size=".1 .1 .1" mass="1" condim="{condim}" friction=".5 .05 .05"/>
      <geom name="load" size=".02" pos=".05 .03 .15" mass="1"/></body></worldbody></mujoco>"""
    roles = (geom("terrain", None), geom("box")) if ground_first else (geom("box"), TERRAIN)
    cfg = sense(*roles, fields=ALL_FIELDS, reduce="none", num_slots=4, global_frame=True)
    gravity = (
        GRAVITY * math.sin(tilt) * math.cos(heading),
        GRAVITY * math.sin(tilt) * math.sin(heading),
        -GRAVITY * math.cos(tilt),
    )
    sim, scene = build(cfg, box=box, gravity=gravity, num_envs=1)
    sim.data.qpos[:, 3] = math.cos(turned / 2)
    sim.data.qpos[:, 6] = math.sin(turned / 2)
    sim.data.qvel[:, 0] = 0.3
    sim.data.qvel[:, 5] = 1.0
    sim.step(nstep=10)
    sim.forward()
    data = scene["touch"].data
    contacts = plain_contacts(sim, "terrain" if ground_first else "box/box")
    assert_close(data.force[0, : len(contacts)], stack(contacts, "force"), atol=2e-3)
    assert_close(data.torque[0, : len(contacts)], stack(contacts, "torque"), atol=2e-3)
    assert not data.force[0, len(contacts) :].any()


def test_history_is_in_the_world_frame_too():
    fields = ("found", "force", "normal", "tangent")
    cfg = sense(geom("box"), TERRAIN, fields=fields, global_frame=True, history_length=3)
    flat = BOX.replace(".0999", ".0199").replace(".1 .1 .1", ".1 .1 .02")
    sim, scene = build(cfg, box=flat)
    settle(sim)
    sim.data.qvel[:, 0] = 2.0
    sim.step()
    scene.update(DT)
    data = scene["touch"].data
    assert data.force[0, 0, 2] < -1.0, "the box lies on the ground"
    assert data.force[0, 0, 0] > 0.5, "it drags the ground along"
    assert torch.equal(data.force_history[:, :, 0], data.force)


# Shapes, layout and life cycle.


@pytest.mark.parametrize("slots", [1, 3])
def test_columns_are_primary_by_primary_and_slot_by_slot(slots):
    sensors = sense(
        geom(".*_foot", "robot"), fields=("force", "dist", "found", "pos"), num_slots=slots,
        history_length=2, reduce="mindist",
    )  # fmt: skip
    sim, scene = build(sensors, robot=LEGS)
    sensor = scene["touch"]
    assert sensor.primary_names == ["left_foot", "right_foot"]
    # The right foot alone touches the ground.
    sim.data.qpos[:, 2] = 0.11
    sim.data.qpos[:, 7:] = torch.tensor([0.1, 0.0])
    sim.forward()
    data = sensor.data
    columns = 2 * slots
    assert data.found.shape == data.dist.shape == (2, columns)
    assert data.force.shape == data.pos.shape == (2, columns, 3)
    assert data.force_history.shape == (2, columns, 2, 3)
    assert data.dist_history.shape == (2, columns, 2)
    assert data.torque is data.normal is data.tangent is data.torque_history is None
    assert data.current_air_time is None
    assert data.found[0].nonzero().flatten().tolist() == [slots]
    assert_close(data.pos[0, slots, 1], -0.05)
    assert_close(data.dist[0, slots], -0.01)


def test_helper_elements_are_there_and_cost_nothing_unless_requested():
    cfg = sense(geom(".*_foot", "robot"), TERRAIN, fields=("force", "found"), num_slots=2)
    sim, scene = build(cfg, robot=LEGS)
    names = ["touch_left_foot", "touch_right_foot"]
    assert list(scene.sensors) == ["touch", *names]
    for name in names:
        assert isinstance(scene[name], BuiltinSensor)
    element = sim.mj_model.sensor("touch_left_foot").id
    assert sim.mj_model.sensor_intprm[element].tolist()[:3] == [0b11, 2, 2]
    sim.data.qpos[:, 2] = 0.11
    sim.forward()
    # found and force of the first slot, then of the second.
    values = scene["touch_right_foot"].data
    data = scene["touch"].data
    assert torch.equal(values[:, [0, 4]], data.found[:, 2:])
    assert torch.equal(values[:, 1:4], data.force[:, 2])


def test_history_keeps_the_newest_substep_first():
    cfg = sense(geom("box"), TERRAIN, fields=("force", "torque", "dist"), history_length=3)
    sim, scene = build(cfg, box=BOX.replace(".0999", ".12"))
    seen = {name: [] for name in ("force", "torque", "dist")}
    for step in range(25):
        sim.step()
        scene.update(DT)
        data = scene["touch"].data
        for name, values in seen.items():
            values.insert(0, getattr(data, name).clone())
            history = getattr(data, f"{name}_history")
            for age in range(3):
                expected = values[age] if age <= step else torch.zeros_like(values[0])
                assert torch.equal(history[:, :, age], expected), (name, step, age)
    assert seen["force"][0].any()
    sim.forward()
    assert not torch.equal(scene["touch"].data.force, seen["force"][0]), "forward recomputes"
    assert torch.equal(scene["touch"].data.force_history[:, :, 0], seen["force"][0])


def test_reset_clears_the_given_rows_only():
    cfg = sense(geom("box"), TERRAIN, history_length=2, track_air_time=True)
    for rows in (torch.tensor([1]), slice(1, 2), torch.tensor([False, True, False])):
        sim, scene = build(cfg, box=BOX, num_envs=3)
        for _ in range(3):
            sim.step()
            scene.update(DT)
        sensor = scene["touch"]
        before = sensor.data
        sensor.reset(rows)
        after = sensor.data
        for name in ("force_history", "current_contact_time"):
            assert getattr(before, name)[1].any(), name
            assert not getattr(after, name)[1].any(), name
            for row in (0, 2):
                assert torch.equal(getattr(after, name)[row], getattr(before, name)[row]), name
        sensor.reset()
        assert not sensor.data.force_history.any()
        assert not sensor.data.current_contact_time.any()


def test_what_was_read_does_not_change_with_the_simulation():
    cfg = sense(geom("box"), TERRAIN, history_length=2, track_air_time=True)
    sim, scene = build(cfg, box=BOX.replace(".0999", ".11"))
    scene.update(DT)
    kept = scene["touch"].data
    before = {
        name: getattr(kept, name).clone() for name in vars(kept) if getattr(kept, name) is not None
    }
    for _ in range(30):
        sim.step()
        scene.update(DT)
    assert scene["touch"].data.found.any()
    for name, value in before.items():
        assert torch.equal(getattr(kept, name), value), name


def test_data_is_computed_once_for_each_state():
    cfg = sense(geom("box"), TERRAIN)
    sim, scene = build(cfg, box=BOX)
    first = scene["touch"].data
    assert scene["touch"].data is first
    sim.forward()
    assert scene["touch"].data is not first


def test_a_sensor_without_history_and_clocks_needs_no_substeps():
    assert not compose(sense(geom("box")), box=BOX)["touch"].needs_substep
    assert compose(sense(geom("box"), history_length=1), box=BOX)["touch"].needs_substep
    assert compose(sense(geom("box"), track_air_time=True), box=BOX)["touch"].needs_substep
    # There is nothing to keep a history of.
    unused = sense(geom("box"), fields=("found",), history_length=1)
    assert not compose(unused, box=BOX)["touch"].needs_substep


# Drawing.


class Board:
    """Remembers what was drawn, of the second environment."""

    meansize = 0.1

    def __init__(self) -> None:
        self.points: list = []
        self.arrows: list = []
        self.legend: list = []

    def get_env_indices(self, num_envs: int) -> tuple[int, ...]:
        return (1,)

    def add_legend(self, color, meaning) -> None:
        self.legend.append(meaning)

    def add_sphere(self, center, radius, color, label) -> None:
        self.points.append(center)

    def add_arrow(self, start, end, color, width, label) -> None:
        self.arrows.append(torch.as_tensor(end - start))


@pytest.mark.parametrize("reduce", ["none", "netforce"])
def test_contacts_are_drawn_where_the_config_says_debug(reduce):
    shown = sense(geom("box"), TERRAIN, fields=("dist",), reduce=reduce, num_slots=6, debug=True)
    hidden = sense(geom("box"), TERRAIN)
    hidden.name = "hidden"
    sim, scene = build(shown, hidden, box=BOX)
    settle(sim)
    sim.data.qpos[0, 2] = 5.0
    sim.forward()
    board = Board()
    for sensor in scene.sensors.values():
        sensor.debug_vis(board)
    assert len(board.points) == len(board.arrows) == (4 if reduce == "none" else 1)
    # 5 mm for each newton that holds the box up.
    assert_close(torch.stack(board.arrows).sum(0).float(), [0.0, 0.0, 0.005 * WEIGHT])
    data = scene["touch"].data
    assert data.dist is not None
    assert data.found is data.pos is data.force is None, "only what was asked for"


# Attributes of 1.6.


@pytest.mark.filterwarnings("ignore:.*older:FutureWarning")
def test_slots_are_live_views_of_each_field_of_each_primary():
    cfg = sense(geom("box"), TERRAIN, fields=("found", "force", "dist"), reduce="none", num_slots=4)
    sim, scene = build(cfg, box=BOX)
    sensor = scene["touch"]
    slots = {slot.field_name: slot for slot in sensor._slots}
    assert list(slots) == ["found", "force", "dist"]
    assert {slot.primary_name for slot in slots.values()} == {"box"}
    settle(sim)
    data = sensor.data
    assert_close(slots["found"].data_view, data.found)
    assert_close(slots["dist"].data_view, data.dist)
    assert_close(slots["force"].data_view, data.force.reshape(2, 12))
    assert slots["force"].data_view.abs().sum() > 1.0
    sim.mj_model.sensor(slots["found"].sensor_name)
