"""Construction of variant entities."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import Entity, EntityArticulationInfoCfg, VariantEntityCfg, VariantMetadata
from mjlab.entity.variants import (
    SlotKey,
    allocate_worlds,
    build_merged_variant_spec,
    validate_variant_specs,
)
from mjlab.utils.spec_config import CollisionCfg

from .variant_objects import BALL, BEADS, BOX, MESH, THINGS, make_scene, simulate, thing


def metadata_of(entity: Entity) -> VariantMetadata:
    assert entity.variant_metadata is not None
    return entity.variant_metadata


# Assignment.

weights = st.lists(st.integers(0, 20), min_size=1, max_size=6).filter(any)


@given(weights=weights, num_envs=st.integers(1, 200))
def test_quotas_of_variants(weights: list[int], num_envs: int) -> None:
    worlds = allocate_worlds(tuple(map(float, weights)), num_envs)
    assert worlds == sorted(worlds)
    assert len(worlds) == num_envs
    quotas = [Fraction(w * num_envs, sum(weights)) for w in weights]
    extra = [worlds.count(k) - int(quota) for k, quota in enumerate(quotas)]
    assert set(extra) <= {0, 1}
    remainders = [quota - int(quota) for quota in quotas]
    rounded_up = [(remainders[k], -k) for k, more in enumerate(extra) if more]
    not_rounded = [(remainders[k], -k) for k, more in enumerate(extra) if not more]
    # Larger remainders first, and of equal ones the earlier variant.
    assert not rounded_up or not not_rounded or min(rounded_up) > max(not_rounded)


def test_assignment_is_equal_weighted_or_chosen() -> None:
    def assigned(assignment) -> list[int]:
        cfg = VariantEntityCfg(variants=BEADS, assignment=assignment)
        return metadata_of(cfg.build()).assign_worlds(5).tolist()

    assert assigned(None) == [0, 0, 0, 1, 1]
    assert assigned({"large": 4.0}) == [0, 1, 1, 1, 1]
    assert assigned({"small": 0.0}) == [1, 1, 1, 1, 1]
    assert assigned(lambda n: [i % 2 for i in range(n)]) == [0, 1, 0, 1, 0]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ({"huge": 1.0}, r"assignment 'huge'.*\['small', 'large'\]"),
        ({"small": -1.0}, r">= 0.*got \(-1.0, 1.0\)"),
        ({"small": 0.0, "large": 0.0}, "not all zero"),
        ({"small": float("nan")}, "finite.*nan"),
    ],
)
def test_weights_that_make_no_sense_are_refused(assignment, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        entity = VariantEntityCfg(variants=BEADS, assignment=assignment).build()
        metadata_of(entity).assign_worlds(2)


@pytest.mark.parametrize(
    ("found", "message"),
    [
        (lambda n: [0] * (n - 1), r"expected 4 integers.*shape \(3,\)"),
        (lambda n: [0, 1, 2, -1], r"indices 0 to 1 .*\[-1, 2\]"),
        (lambda n: [0.5] * n, "expected 4 integers.*float64"),
    ],
)
def test_functions_that_assign_nonsense_are_refused(found, message: str) -> None:
    entity = VariantEntityCfg(variants=BEADS, assignment=found).build()
    with pytest.raises(ValueError, match=message):
        metadata_of(entity).assign_worlds(4)


# Bad input.


def test_a_config_takes_its_specs_from_variants_alone() -> None:
    with pytest.raises(ValueError, match="VariantEntityCfg.variants.*at least one"):
        VariantEntityCfg().build()
    with pytest.raises(ValueError, match=r"variants\['a'\].*mujoco.MjSpec, got int"):
        VariantEntityCfg(variants={"a": lambda: 3}).build()  # ty: ignore[invalid-argument-type]
    with pytest.raises(ValueError, match=re.escape("cfg.build()")):
        Entity(VariantEntityCfg(variants=BEADS))


HINGE = '<joint name="hinge"'
BAD_SIBLINGS = {
    "joints": ({HINGE: '<joint name="door"'}, "the same joints.*'door'.*'hinge'"),
    "types of joints": ({HINGE: '<joint type="slide" name="hinge"'}, "the same joints.*mjJNT_SLIDE"),
    "bodies": ({'<body name="lid"': '<body name="cap"'}, "the same bodies.*/thing/cap.*/thing/lid"),
    "inertials": (
        {'<site name="grip"': '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><site name="grip"'},
        "the same kinds of inertial.*diaginertia.*derived from geoms",
    ),
    "actuators": (
        {"</worldbody>": '</worldbody><actuator><motor name="m" joint="hinge"/></actuator>'},
        "the same actuators.*'m'",
    ),
    "a fixed base": ({'<freejoint name="root"/>': ""}, "'odd'.*free joint.*<freejoint/>"),
    "two roots": ({"</worldbody>": '<body name="more"/></worldbody>'}, "top-level body, got 2"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD_SIBLINGS)
def test_variants_need_one_structure(what: str) -> None:
    changes, message = BAD_SIBLINGS[what]
    odd = thing("odd", '<geom size=".1"/>', **changes)
    with pytest.raises(ValueError, match=f"(?s).*{message}") as caught:
        VariantEntityCfg(variants={"box": BOX, "odd": odd}).build()
    assert "odd" in str(caught.value)


def test_sites_of_the_first_variant_count() -> None:
    odd = thing("odd", '<geom size=".1"/>', **{'name="grip"': 'name="handle"'})
    with pytest.warns(UserWarning, match="'box' and 'odd' have different sites.*'handle'"):
        entity = VariantEntityCfg(variants={"box": BOX, "odd": odd}).build()
    assert "grip" in entity.site_names
    assert "handle" not in entity.site_names


def test_references_to_a_geom_of_every_variant_follow_it() -> None:
    xml = (
        '<mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>'
        '<body name="b"><freejoint/><geom name="g" type="mesh" mesh="m" mass="1" pos="0 0 {}"/>'
        '</body></worldbody><sensor><framepos name="q" objtype="geom" objname="g"/></sensor></mujoco>'
    )
    variants = {
        name: lambda height=height: mujoco.MjSpec.from_string(xml.format(height))
        for name, height in (("low", 0.2), ("high", 0.7))
    }
    sim = simulate(make_scene(2, {"r": VariantEntityCfg(variants=variants)}))
    sim.forward()
    heights = sim.data.sensordata[:, 2]
    assert (heights[1] - heights[0]).item() == pytest.approx(0.5)


def test_references_to_geoms_that_differ_are_refused() -> None:
    sensor = {
        "</worldbody>": '</worldbody><sensor><framepos name="s" objtype="geom" objname="shell"/>'
        "</sensor>"
    }
    shell = '<geom name="shell" type="{}" size=".1 .1 .1"/>'
    box, ball = (thing(t, shell.format(t), **sensor) for t in ("box", "sphere"))
    with pytest.raises(ValueError, match="'a': sensor 's' refers to geom 'shell'"):
        VariantEntityCfg(variants={"a": box, "b": ball}).build()


def test_an_error_in_an_editor_names_the_variant() -> None:
    cfg = VariantEntityCfg(
        variants={"box": BOX, "ball": BALL},
        articulation=EntityArticulationInfoCfg(
            actuators=(
                BuiltinPositionActuatorCfg(
                    target_names_expr=("nothing",), stiffness=1.0, damping=1.0
                ),
            )
        ),
    )
    with pytest.raises(ValueError, match="Variant 'box'.*nothing"):
        cfg.build()


def test_validation_can_be_asked_for_alone() -> None:
    validate_variant_specs(list(THINGS), [make() for make in THINGS.values()])
    with pytest.raises(ValueError, match="'door'"):
        odd = thing("odd", "", **{HINGE: '<joint name="door"'})
        validate_variant_specs(["box", "odd"], [BOX(), odd()])


# Merging.


def test_meshes_and_primitives_that_differ_share_slots_by_what_cannot_vary() -> None:
    spec, metadata = build_merged_variant_spec(VariantEntityCfg(variants=THINGS))
    assert metadata.variant_names == tuple(THINGS)
    assert [slot.key for slot in metadata.slots] == [
        *(SlotKey("/thing", "visual", k) for k in range(3)),
        *(SlotKey("/thing", "collision", k) for k in range(5)),
    ]
    # Box; sphere of the ball and the dumbbell; its one of another priority; mesh; mesh of condim 4.
    collision = [[geom is not None for geom in own][3:] for own in metadata.variant_slot_specs]
    assert collision == [
        [True, False, False, False, False],
        [False, True, False, False, False],
        [False, True, True, False, False],
        [False, False, False, True, False],
        [False, False, False, False, True],
    ]  # fmt: skip
    names = {geom.name for geom in spec.geoms}
    assert names == {"cover", *(slot.template_geom_name for slot in metadata.slots)}
    assert metadata.slots[3].template_geom_name == "mjlab/pad/thing/collision/0"
    assert metadata.slots[3].source_geom_names == ("shell", None, None, None, None)
    assert metadata.num_mesh_geoms == 4
    assert metadata.variant_mesh_names[3] == (None, "steep", *(None,) * 4, "wedge", None)
    # Visual meshes of other groups.
    assert metadata.variant_mesh_names[4] == (None, None, "wedge", *(None,) * 4, "steep")


def test_meshes_alone_fill_as_many_slots_as_the_richest_variant_has() -> None:
    one = thing("one", '<geom type="mesh" mesh="wedge"/>')
    three = thing("three", '<geom type="mesh" mesh="wedge"/>' * 3)
    _, metadata = build_merged_variant_spec(VariantEntityCfg(variants={"1": one, "3": three}))
    assert [slot.template_geom_name for slot in metadata.slots] == [
        f"mjlab/pad/thing/collision/{k}" for k in range(3)
    ]
    assert [len([n for n in names if n]) for names in metadata.variant_mesh_names] == [1, 3]


def test_primitives_that_all_variants_have_keep_their_names() -> None:
    entity = VariantEntityCfg(variants=BEADS).build()
    assert entity.geom_names == ("bead",)
    assert not metadata_of(entity).slots
    assert "cover" in VariantEntityCfg(variants=THINGS).build().geom_names


def test_slots_are_found_by_their_whole_names() -> None:
    entity = VariantEntityCfg(variants={"box": BOX, "ball": BALL}).build()
    _, names = entity.find_geoms(("mjlab/pad/thing/collision/.*",))
    assert names == ["mjlab/pad/thing/collision/0", "mjlab/pad/thing/collision/1"]


def test_pads_of_variants_have_no_mass() -> None:
    scene = make_scene(2, {"thing": VariantEntityCfg(variants=THINGS)})
    alone = BOX().compile()
    merged = scene.spec.compile()
    np.testing.assert_allclose(merged.body("thing/thing").mass, alone.body("thing").mass)
    np.testing.assert_allclose(merged.body("thing/thing").inertia, alone.body("thing").inertia)


def test_every_mesh_that_can_touch_something_has_its_convex_hull() -> None:
    names = ("wedge", "steep")
    variants = {name: thing(name, f'<geom type="mesh" mesh="{name}"/>') for name in names}
    model = make_scene(2, {"thing": VariantEntityCfg(variants=variants)}).spec.compile()
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH).sum() == 1
    for name in names:
        mesh = model.mesh(f"thing/{name}/{name}")
        assert model.mesh_graphadr[mesh.id] >= 0
        assert model.mesh_polynum[mesh.id] == 4


def test_assets_with_one_name_in_two_variants_stay_apart(tmp_path) -> None:
    cube = "\n".join(f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    faces = "f 1 2 4\nf 1 4 3\nf 5 7 8\nf 5 8 6\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\n"
    faces += "f 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"
    xml = '<mujoco><asset><mesh file="part.obj" scale="{0} {0} {0}"/></asset><worldbody>'
    xml += '<body name="b"><freejoint/><geom type="mesh" mesh="part"/></body></worldbody></mujoco>'
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "part.obj").write_text(f"{cube}\n{faces}")
    (tmp_path / "disk" / "scene.xml").write_text(xml.format(2))
    in_memory = {"part.obj": f"{cube}\n{faces}".replace("v 1", "v 3").encode()}
    variants = {
        "disk": lambda: mujoco.MjSpec.from_file(str(tmp_path / "disk" / "scene.xml")),
        "memory": lambda: mujoco.MjSpec.from_string(xml.format(1), assets=in_memory),
    }
    for order in (("disk", "memory"), ("memory", "disk")):
        cfg = VariantEntityCfg(variants={name: variants[name] for name in order})
        model = make_scene(2, {"b": cfg}).spec.compile()
        sizes = {
            name: np.ptp(
                model.mesh_vert[
                    (first := model.mesh_vertadr[mesh := model.mesh(f"b/{name}/part").id]) :
                    first + model.mesh_vertnum[mesh]
                ],
                axis=0,
            ).round(3).tolist()
            for name in order
        }  # fmt: skip
        assert sorted(sizes["disk"]) == [2, 2, 2]
        assert sorted(sizes["memory"]) == [1, 1, 3]


def test_editors_are_applied_to_each_variant_by_the_names_in_its_own_spec() -> None:
    cfg = VariantEntityCfg(
        variants={"box": BOX, "ball": BALL, "mesh": MESH},
        collisions=(CollisionCfg(geom_names_expr=("shell",), condim=6, contype=1, conaffinity=3,
                                 priority=2, disable_other_geoms=True),),
    )  # fmt: skip
    metadata = metadata_of(cfg.build())
    collision = [slot.key.role == "collision" for slot in metadata.slots]
    box, ball, mesh = (
        [geom for geom, collides in zip(own, collision, strict=True) if collides and geom]
        for own in metadata.variant_slot_specs
    )
    assert [(g.condim, g.conaffinity, g.priority) for g in (*box, *ball)] == [(6, 3, 2)] * 2
    # The mesh has no name, so it is one of the others.
    assert mesh == []


def test_the_example_of_the_documentation_does_what_the_page_says() -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "variants.md").read_text(
        encoding="utf-8"
    )
    example: dict = {}
    exec(page.split("```python\n")[1].split("```")[0], example)
    entity = example["object_cfg"].build()
    assert metadata_of(entity).assign_worlds(12).tolist() == [0] * 6 + [1] * 3 + [2] * 3
    assert "mjlab/pad/object/collision/0" in entity.geom_names
    assert entity.find_geoms(("mjlab/pad/.*/collision/.*",))[1] == list(entity.geom_names)
