"""What each variant of an entity puts into the fields of a compiled model."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjlab.entity.indexing import element_id
from mjlab.sim.randomization import CONSTANTS_AT_QPOS0, FIXED_CONSTANTS, VariantColumns
from mjlab.utils.mujoco import control_columns, dof_width, force_columns, qpos_width

# Kinds of elements, with the beginning of the names of their model fields.
KINDS = {
    "bodies": ("body_", mujoco.mjtObj.mjOBJ_BODY),
    "joints": ("jnt_", mujoco.mjtObj.mjOBJ_JOINT),
    "geoms": ("geom_", mujoco.mjtObj.mjOBJ_GEOM),
    "sites": ("site_", mujoco.mjtObj.mjOBJ_SITE),
    "cameras": ("cam_", mujoco.mjtObj.mjOBJ_CAMERA),
    "lights": ("light_", mujoco.mjtObj.mjOBJ_LIGHT),
    "tendons": ("tendon_", mujoco.mjtObj.mjOBJ_TENDON),
    "actuators": ("actuator_", mujoco.mjtObj.mjOBJ_ACTUATOR),
    "equalities": ("eq_", mujoco.mjtObj.mjOBJ_EQUALITY),
    "sensors": ("sensor_", mujoco.mjtObj.mjOBJ_SENSOR),
}
# Real fields are figures. Of whole numbers, most are addresses; these are figures too.
_WHOLE_FIGURES = frozenset(
    {"jnt_limited", "jnt_actfrclimited", "jnt_actgravcomp", "site_type", "site_group", "cam_mode"}
    | {"cam_projection", "cam_resolution", "light_mode", "light_type", "light_active"}
    | {"light_castshadow", "tendon_limited", "tendon_actfrclimited", "actuator_ctrllimited"}
    | {"actuator_forcelimited", "actuator_actlimited", "actuator_dyntype", "actuator_gaintype"}
    | {"actuator_biastype", "actuator_actearly", "eq_active0"}
)
# These follow from the others, and are computed for the whole scene.
_DERIVED = frozenset({"body_margin", "dof_length", "dof_M0", "actuator_length0"}) | (
    frozenset((*FIXED_CONSTANTS, *CONSTANTS_AT_QPOS0)) - {"actuator_biasprm", "eq_data"}
)
# One row a control, or a force, of which an actuator may have several.
_CONTROL_FIELDS = frozenset({"actuator_ctrllimited", "actuator_ctrlrange"})
_FORCE_FIELDS = frozenset({"actuator_gear", "actuator_lengthrange"})
_ASSET_FIELDS = {
    "geom_matid": ("materials", mujoco.mjtObj.mjOBJ_MATERIAL),
    "site_matid": ("materials", mujoco.mjtObj.mjOBJ_MATERIAL),
    "tendon_matid": ("materials", mujoco.mjtObj.mjOBJ_MATERIAL),
    "geom_dataid": ("meshes", mujoco.mjtObj.mjOBJ_MESH),
}
# What a geom has where it is not there: no extent, no mesh, no colour. The rest stays as it is in
# another variant.
_ABSENT = {"geom_size": 0, "geom_rbound": 0, "geom_aabb": 0, "geom_dataid": -1, "geom_matid": -1}


class VariantTable:
    """Values of all variants, each compiled alone, with the merged elements that they are for."""

    def __init__(
        self,
        models: list[mujoco.MjModel],
        elements: dict[str, list[tuple[Any, list[int]]]],
        assets: dict[str, list[list[Any]]],
    ) -> None:
        """Hold them.

        Args:
            models: Each variant compiled alone.
            elements: By kind, elements of the merged spec, each with its id in every model; -1
                where a variant does not have it. The first body is the root.
            assets: By kind, for each variant, the merged element of each of its meshes and
                materials.
        """
        self._models, self._elements, self._assets = models, elements, assets
        self._root = elements["bodies"][0][0]

    def columns(self, model: mujoco.MjModel) -> list[VariantColumns]:
        """Return what each variant puts into `model`, compiled from a spec with the merged one."""
        ids = {
            kind: np.array([element_id(model, KINDS[kind][1], e) for e, _ in pairs], dtype=int)
            for kind, pairs in self._elements.items()
        }
        assets = {
            field: [
                np.array([element_id(model, kind, e) for e in own] + [-1])
                for own in self._assets[name]
            ]
            for field, (name, kind) in _ASSET_FIELDS.items()
        }
        return [self._columns_of(k, model, ids, assets) for k in range(len(self._models))]

    def _columns_of(
        self,
        k: int,
        model: mujoco.MjModel,
        ids: dict[str, np.ndarray],
        assets: dict[str, list[np.ndarray]],
    ) -> VariantColumns:
        fields: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for kind, pairs in self._elements.items():
            # Of what this variant does not have, the figures come from one that does.
            sources = [_first_with(own, k) for _, own in pairs]
            for name in self._fields_of(kind):
                values = [getattr(self._models[j], name)[i] for j, i in sources]
                if name in assets:
                    values = [assets[name][j][i] for (j, _), i in zip(sources, values, strict=True)]
                if len(values):
                    fields[name] = ids[kind], np.stack(values)
        fields |= self._by_address(k, model, ids["joints"], ids["actuators"])
        # Where the root starts is the entity's initial state, the same for all.
        for name in ("body_pos", "body_quat"):
            targets, values = fields[name]
            fields[name] = targets[1:], values[1:]
        absent = np.array([own[k] < 0 for _, own in self._elements["geoms"]], dtype=bool)
        if absent.any():
            for name, value in _ABSENT.items():
                fields[name][1][absent] = value
            fields["geom_rgba"][1][absent, 3] = 0.0
        return VariantColumns(fields, ids["geoms"][absent])

    def _fields_of(self, kind: str) -> list[str]:
        """Return the fields with one row for each element of a kind, that hold figures."""
        prefix, model = KINDS[kind][0], self._models[0]
        names = [name for name in dir(model) if name.startswith(prefix)]
        return [
            name
            for name in names
            if isinstance(array := getattr(model, name), np.ndarray)
            and name not in _DERIVED | _CONTROL_FIELDS | _FORCE_FIELDS
            and (array.dtype.kind == "f" or name in _WHOLE_FIGURES or name in _ASSET_FIELDS)
        ]

    def _by_address(
        self, k: int, model: mujoco.MjModel, joints: np.ndarray, actuators: np.ndarray
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the fields with rows for degrees of freedom, positions, controls and forces."""
        own = self._models[k]
        there = [ids[k] for _, ids in self._elements["actuators"]]
        places: dict[str, list[tuple[int, int]]] = {
            "dof": [],
            "qpos": [],
            "control": _pairs(control_columns(model, actuators), control_columns(own, there)),
            "force": _pairs(force_columns(model, actuators), force_columns(own, there)),
        }
        for joint, (_, ids) in zip(joints, self._elements["joints"], strict=True):
            kind, joint_there = int(model.jnt_type[joint]), ids[k]
            for j in range(dof_width(kind)):
                places["dof"].append((model.jnt_dofadr[joint] + j, own.jnt_dofadr[joint_there] + j))
            if kind != mujoco.mjtJoint.mjJNT_FREE:
                for j in range(qpos_width(kind)):
                    places["qpos"].append(
                        (model.jnt_qposadr[joint] + j, own.jnt_qposadr[joint_there] + j)
                    )
        names = {"qpos0": "qpos", "qpos_spring": "qpos"}
        names |= {name: "dof" for name in dir(own) if name.startswith("dof_")}
        names |= dict.fromkeys(_CONTROL_FIELDS, "control") | dict.fromkeys(_FORCE_FIELDS, "force")
        fields = {}
        for name, kind in names.items():
            array = getattr(own, name)
            is_figure = array.dtype.kind == "f" or name in _WHOLE_FIGURES
            if places[kind] and is_figure and name not in _DERIVED:
                here, rows = np.array(places[kind], dtype=int).T
                fields[name] = here, array[rows]
        return fields


def _pairs(here: list[int], there: list[int]) -> list[tuple[int, int]]:
    return list(zip(here, there, strict=True))


def _first_with(ids: list[int], k: int) -> tuple[int, int]:
    """Return the variant to take figures from, `k` if it can be, and the id of the element in it."""
    if ids[k] >= 0:
        return k, ids[k]
    return next((j, i) for j, i in enumerate(ids) if i >= 0)
