"""Comparison of a robot's compiled model with a table of its parameters.

A table is a YAML file in `figures/`: bodies with their joints, geoms, sites and cameras, then
sensors, equalities, contact excludes and totals. What it leaves out has MuJoCo's default. The geoms of a table
are those that can touch something; others are drawn only, and the table says how far they reach
(`visual_extent`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

FIGURES = Path(__file__).parent / "figures"

# The tables are printed with seven digits, or seven decimals in a quaternion.
RELATIVE, ABSOLUTE = 2e-6, 2e-7

VISUAL_GROUP, SITE_GROUP = 2, 5
_IDENTITY = [1.0, 0.0, 0.0, 0.0]
_ZERO = [0.0, 0.0, 0.0]
# Number of sizes by geom type; MuJoCo stores three, and fills the rest.
_NUM_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
# Mass of bodies without a mass in the table.
_MASSLESS = {"mass": 0.0, "inertia": _ZERO}
# Number of polynomial coefficients of a joint equality constraint.
_NUM_COEFFICIENTS = 5
_NOT_FIGURES = {"source_of_figures", "conventions"}


def load_table(robot: str) -> dict[str, Any]:
    """Return the table of a robot, as "unitree_go1"."""
    return yaml.safe_load((FIGURES / f"{robot}.yaml").read_text())


def differences(spec: mujoco.MjSpec, table: dict[str, Any]) -> list[str]:
    """Return, one line each, where the model that `spec` compiles to differs from the table."""
    model = spec.compile()
    return [*compare(figures_of(model), table), *_unusual(model)]


def compare(figures: dict[str, Any], table: dict[str, Any]) -> list[str]:
    """Return differences between the parameters of a model and the table, one line each."""
    expected = {key: value for key, value in table.items() if key not in _NOT_FIGURES}
    expected["bodies"] = [_completed(body) for body in table["bodies"]]
    for kind in ("sensors", "equalities", "contact_excludes"):
        expected.setdefault(kind, [])
    return list(_compare(expected, figures, ""))


def figures_of(model: mujoco.MjModel) -> dict[str, Any]:
    """Return all parameters of a model in the form of a table."""
    return {
        "bodies": [_body(model, index) for index in range(1, model.nbody)],
        "sensors": [_sensor(model, index) for index in range(model.nsensor)],
        "equalities": [_equality(model, index) for index in range(model.neq)],
        "contact_excludes": [
            [model.body(signature >> 16).name, model.body(signature & 0xFFFF).name]
            for signature in model.exclude_signature
        ],
        "totals": {
            "mass_kg": float(model.body_mass.sum()),
            "nq": model.nq,
            "nv": model.nv,
            "nbody": model.nbody,
        },
    }


def _body(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    figures = _figures(model, "body", index, "pos", "quat", "mass", "ipos", "iquat", "inertia")
    placed = ("pos", "quat")
    for field in placed:
        figures[f"inertial_{field}"] = figures.pop(f"i{field}")
        if model.body_mass[index] == 0.0:
            # Without mass, it is anywhere.
            del figures[f"inertial_{field}"]
    figures["parent"] = model.body(model.body_parentid[index]).name
    felt = (model.geom_bodyid == index) & (model.geom_group != VISUAL_GROUP)
    return figures | {
        "joints": [_joint(model, i) for i in np.flatnonzero(model.jnt_bodyid == index)],
        "geoms": [_geom(model, i) for i in np.flatnonzero(felt)],
        "sites": [
            _figures(model, "site", i, *placed) for i in np.flatnonzero(model.site_bodyid == index)
        ],
        "cameras": [
            _figures(model, "cam", i, *placed, "fovy", "resolution")
            for i in np.flatnonzero(model.cam_bodyid == index)
        ],
    }


def _joint(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    kind = mujoco.mjtJoint(model.jnt_type[index]).name.removeprefix("mjJNT_").lower()
    if kind == "free":
        return {**_figures(model, "jnt", index), "type": kind}
    figures = _figures(model, "jnt", index, "pos", "axis", "range")
    if not model.jnt_limited[index]:
        figures["range"] = None
    return {**figures, "type": kind}


def _geom(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    kind = mujoco.mjtGeom(model.geom_type[index]).name.removeprefix("mjGEOM_").lower()
    figures = _figures(model, "geom", index, "pos", "quat", "size", "group")
    return {**figures, "type": kind, "size": figures["size"][: _NUM_SIZES[kind]]}


def _figures(model: mujoco.MjModel, kind: str, index: int, *fields: str) -> dict[str, Any]:
    values = {field: getattr(model, f"{kind}_{field}")[index].tolist() for field in fields}
    return {"name": getattr(model, kind)(index).name, **values}


def _sensor(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    kind = mujoco.mjtSensor(model.sensor_type[index]).name.removeprefix("mjSENS_").lower()
    found = {
        "name": model.sensor(index).name,
        "type": kind,
        "object": mujoco.mj_id2name(model, model.sensor_objtype[index], model.sensor_objid[index]),
    }
    if model.sensor_refid[index] >= 0:
        reference = model.sensor_reftype[index], model.sensor_refid[index]
        found["reference"] = mujoco.mj_id2name(model, *reference)
    return found


def _equality(model: mujoco.MjModel, index: int) -> dict[str, Any]:
    if model.eq_type[index] != mujoco.mjtEq.mjEQ_JOINT:
        raise ValueError("Of equalities, only the coupling of two joints is compared here.")
    figures = _figures(model, "eq", index, "type", "solref", "solimp")
    return figures | {
        "obj1": model.joint(model.eq_obj1id[index]).name,
        "obj2": model.joint(model.eq_obj2id[index]).name,
        "data": model.eq_data[index, :_NUM_COEFFICIENTS].tolist(),
    }


def _completed(body: dict[str, Any]) -> dict[str, Any]:
    """Return a body of a table with what it leaves out."""
    body = {key: value for key, value in body.items() if key != "visual_extent"}
    placed = {"pos": _ZERO, "quat": _IDENTITY}
    for kind in ("geoms", "sites", "cameras"):
        body[kind] = [placed | element for element in body.get(kind, [])]
    body["joints"] = [
        joint if joint["type"] == "free" else {"pos": _ZERO, "range": None} | joint
        for joint in body.get("joints", [])
    ]
    return placed | ({} if "mass" in body else _MASSLESS) | body


def _compare(expected: Any, found: Any, path: str) -> Iterator[str]:
    if isinstance(expected, dict) and isinstance(found, dict):
        for key in [*expected, *(key for key in found if key not in expected)]:
            inner = f"{path}.{key}".lstrip(".")
            if key not in expected or key not in found:
                yield f"{inner}: only in {'the table' if key in expected else 'the model'}"
            else:
                yield from _compare(expected[key], found[key], inner)
    elif isinstance(expected, list) and expected and isinstance(expected[0], dict):
        yield from _compare_named(expected, found, path)
    elif not _equal(expected, found, is_rotation=path.endswith("quat")):
        yield f"{path}: {found}, in the table {expected}"


def _compare_named(expected: list[Any], found: list[Any], path: str) -> Iterator[str]:
    names = [[element["name"] for element in elements] for elements in (found, expected)]
    if names[0] != names[1]:
        yield f"{path}: {names[0]}, in the table {names[1]}"
        return
    for one, other in zip(expected, found, strict=True):
        yield from _compare(one, other, f"{path}[{one['name']}]")


def _equal(expected: Any, found: Any, is_rotation: bool) -> bool:
    if expected is None or found is None or isinstance(expected, (str, bool)):
        return expected == found
    if np.shape(expected) != np.shape(found):
        return False
    if np.asarray(expected).dtype.kind == "U":
        return expected == found
    # A quaternion and its negative are the same rotation.
    signs = (1.0, -1.0) if is_rotation else (1.0,)
    return any(
        np.allclose(sign * np.asarray(found), expected, rtol=RELATIVE, atol=ABSOLUTE)
        for sign in signs
    )


def _unusual(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what no robot has: things that the tables do not mention, since they are default."""
    for field in ("damping", "frictionloss", "armature"):
        if np.any(getattr(model, f"dof_{field}")):
            yield f"joints have {field}; that is for actuators to bring"
    if np.any(model.jnt_stiffness):
        yield "joints have springs"
    plain = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    for field in ("jnt_solref", "jnt_solimp", "geom_solref", "geom_solimp", "geom_margin"):
        if not np.all(getattr(model, field) == getattr(plain, field)):
            yield f"{field} is not MuJoCo's default"
    if np.any(model.site_group != SITE_GROUP):
        yield f"sites are not all in group {SITE_GROUP}"
    visual = model.geom_group == VISUAL_GROUP
    if np.any(model.geom_contype[visual] | model.geom_conaffinity[visual]):
        yield "geoms that are drawn only can touch something"
    for count in ("nu", "nkey"):
        if getattr(model, count):
            yield f"{count} is {getattr(model, count)}; actuators and poses are for the config"
