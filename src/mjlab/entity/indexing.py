"""Ids and addresses of an entity's elements in the compiled model."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import mujoco
import torch

from mjlab.utils.indexing import as_columns
from mjlab.utils.mujoco import (
    OBJECT_TYPES,
    control_columns,
    dof_width,
    force_columns,
    moving_dofs,
    qpos_width,
)

Ids: TypeAlias = torch.Tensor | slice | Sequence[int] | None
"""Selection: None (all), a slice, integers (list, tensor) or a boolean mask."""

IdsT = TypeVar("IdsT", bound="Ids | int")

# Fields of `EntityIndexing` with elements, and with their ids.
_ID_FIELDS = {
    "bodies": "body_ids",
    "joints": "joint_ids",
    "geoms": "geom_ids",
    "sites": "site_ids",
    "tendons": "tendon_ids",
    "cameras": "cam_ids",
    "lights": "light_ids",
    "materials": "mat_ids",
    "textures": "tex_ids",
    "pairs": "pair_ids",
}


@dataclass(eq=False)
class EntityIndexing:
    """Spec elements of one entity and their ids and addresses in the compiled model.

    Ids are int32 tensors of global ids, in spec order.
    """

    bodies: tuple[mujoco.MjsBody, ...]
    """Bodies without the world. The root is the body of the free joint, else the first."""
    joints: tuple[mujoco.MjsJoint, ...]
    """Hinges and slides."""
    geoms: tuple[mujoco.MjsGeom, ...]
    sites: tuple[mujoco.MjsSite, ...]
    tendons: tuple[mujoco.MjsTendon, ...]
    cameras: tuple[mujoco.MjsCamera, ...]
    lights: tuple[mujoco.MjsLight, ...]
    materials: tuple[mujoco.MjsMaterial, ...]
    textures: tuple[mujoco.MjsTexture, ...]
    pairs: tuple[mujoco.MjsPair, ...]
    actuators: tuple[mujoco.MjsActuator, ...] | None
    """All actuators of the spec, or None if the entity has no configured actuators."""
    body_ids: torch.Tensor
    geom_ids: torch.Tensor
    site_ids: torch.Tensor
    tendon_ids: torch.Tensor
    cam_ids: torch.Tensor
    light_ids: torch.Tensor
    mat_ids: torch.Tensor
    tex_ids: torch.Tensor
    pair_ids: torch.Tensor
    actuator_ids: torch.Tensor
    """Ids of `actuators`; empty if that is None."""
    ctrl_ids: torch.Tensor
    """Columns of `ctrl` of `actuators`, in order; an actuator may have none, one or several."""
    force_ids: torch.Tensor
    """Columns of `actuator_force` of `actuators`, in order; three for an orientation, else one."""
    joint_ids: torch.Tensor
    mocap_id: int | None
    """Index into `mocap_pos`; None if the root is not a mocap body."""
    joint_q_adr: torch.Tensor
    """Addresses in `qpos`, without the free joint."""
    joint_v_adr: torch.Tensor
    """Addresses in `qvel`, without the free joint."""
    free_joint_q_adr: torch.Tensor
    """The 7 addresses of the free joint in `qpos`; empty without a free joint."""
    free_joint_v_adr: torch.Tensor
    """The 6 addresses of the free joint in `qvel`; empty without a free joint."""
    body_tree_ids: torch.Tensor
    """Top-level body of each body's tree. `cvel` refers to the center of mass of that tree."""
    geom_body_ids: torch.Tensor
    """Body of each geom."""
    geom_tree_ids: torch.Tensor
    """Top-level body of each geom's tree."""
    site_body_ids: torch.Tensor
    """Body of each site."""
    site_tree_ids: torch.Tensor
    """Top-level body of each site's tree."""
    moved_bodies: torch.Tensor
    """1 if a degree of freedom of `joint_v_adr` moves a body, else 0; (nj, nb) float32."""

    def force_columns(self, actuator_ids: IdsT) -> IdsT | list[int]:
        """Return the columns of `EntityData.actuator_force` of actuators `actuator_ids`."""
        return _columns_of(self._forces, actuator_ids)

    def control_columns(self, actuator_ids: IdsT) -> IdsT | list[int]:
        """Return the positions in `ctrl_ids` of the controls of actuators `actuator_ids`."""
        return _columns_of(self._controls, actuator_ids)

    @property
    def root_body_id(self) -> int:
        """Global id of the root body."""
        return self._root_id

    _root_id: int = -1
    _forces: tuple[range, ...] = ()
    """Range in `force_ids` of each of `actuators`."""
    _controls: tuple[range, ...] = ()
    """Range in `ctrl_ids` of each of `actuators`."""


class Addresses:
    """Positions along one axis of a simulation field.

    Contiguous positions are returned as a slice, so that reading a field gives a view, not a copy.
    """

    def __init__(self, positions: Sequence[int] | torch.Tensor, device: str) -> None:
        host = positions.tolist() if isinstance(positions, torch.Tensor) else list(positions)
        self._host = [int(position) for position in host]
        self._device = device
        self.tensor = torch.tensor(self._host, dtype=torch.int64, device=device)
        self.all: slice | torch.Tensor = as_columns(self._host, device)

    def __len__(self) -> int:
        return len(self._host)

    def select(self, ids: Ids = None) -> tuple[slice | torch.Tensor, int]:
        """Return the index of the selected positions, and their number."""
        if ids is None:
            return self.all, len(self._host)
        if isinstance(ids, torch.Tensor):
            chosen = self.tensor[ids]
            return chosen, chosen.shape[0]
        host = self._host[ids] if isinstance(ids, slice) else [self._host[int(i)] for i in ids]
        return as_columns(host, self._device), len(host)


def build_indexing(
    spec: mujoco.MjSpec,
    free_joint: mujoco.MjsJoint | None,
    is_actuated: bool,
    model: mujoco.MjModel,
    device: str,
) -> EntityIndexing:
    """Locate the elements of an entity's `spec` in the compiled `model`.

    Raises:
        ValueError: an element is not in the model, or is unnamed in a spec that was not compiled.
    """

    def tensor(values: Iterable[int]) -> torch.Tensor:
        return torch.tensor([int(v) for v in values], dtype=torch.int32, device=device)

    elements: dict[str, Any] = {kind: tuple(getattr(spec, kind)) for kind in _ID_FIELDS}
    elements["bodies"] = elements["bodies"][1:]
    scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    elements["joints"] = tuple(joint for joint in spec.joints if joint.type in scalar)
    elements["actuators"] = tuple(spec.actuators) if is_actuated else None
    ids = {kind: element_ids(model, kind, found or ()) for kind, found in elements.items()}
    actuator_ids = ids["actuators"]
    joints = [(int(model.jnt_type[i]), i) for i in ids["joints"]]
    dofs = [model.jnt_dofadr[i] + k for kind, i in joints for k in range(dof_width(kind))]
    moved = moving_dofs(model)[ids["bodies"]][:, dofs].T
    free = [] if free_joint is None else element_ids(model, "joints", (free_joint,))
    geom_bodies = [int(model.geom_bodyid[i]) for i in ids["geoms"]]
    site_bodies = [int(model.site_bodyid[i]) for i in ids["sites"]]
    root = ids["bodies"][0] if not free else int(model.jnt_bodyid[free[0]])
    mocap_id = int(model.body_mocapid[root])
    return EntityIndexing(
        **elements,
        **{field: tensor(ids[kind]) for kind, field in _ID_FIELDS.items()},
        actuator_ids=tensor(actuator_ids),
        ctrl_ids=tensor(control_columns(model, actuator_ids)),
        force_ids=tensor(force_columns(model, actuator_ids)),
        mocap_id=mocap_id if mocap_id >= 0 else None,
        joint_q_adr=tensor(
            model.jnt_qposadr[i] + k for kind, i in joints for k in range(qpos_width(kind))
        ),
        joint_v_adr=tensor(dofs),
        free_joint_q_adr=tensor(model.jnt_qposadr[i] + k for i in free for k in range(7)),
        free_joint_v_adr=tensor(model.jnt_dofadr[i] + k for i in free for k in range(6)),
        body_tree_ids=tensor(model.body_rootid[i] for i in ids["bodies"]),
        geom_body_ids=tensor(geom_bodies),
        geom_tree_ids=tensor(model.body_rootid[i] for i in geom_bodies),
        site_body_ids=tensor(site_bodies),
        site_tree_ids=tensor(model.body_rootid[i] for i in site_bodies),
        moved_bodies=torch.from_numpy(moved).float().to(device),
        _root_id=root,
        _forces=_ranges(int(model.actuator_outnum[i]) for i in actuator_ids),
        _controls=_ranges(int(model.actuator_ctrlnum[i]) for i in actuator_ids),
    )


def element_ids(model: mujoco.MjModel, kind: str, elements: Iterable[Any]) -> list[int]:
    """Return the ids of spec elements in `model`, by name, or by spec order for unnamed elements.

    Raises:
        ValueError: an element is not in the model, or is unnamed in a spec that was not compiled.
    """
    object_type = OBJECT_TYPES[kind]
    name = object_type.name.removeprefix("mjOBJ_").lower()
    ids = []
    for element in elements:
        # Unnamed elements are known by their number, which only compiling the spec itself gives.
        found = mujoco.mj_name2id(model, object_type, element.name) if element.name else element.id
        if found < 0:
            raise ValueError(
                f"The compiled model has no {name} {element.name or '(unnamed)'!r}; initialize an entity "
                "with the model compiled from its current spec, not from a copy."
            )
        ids.append(found)
    return ids


def _columns_of(own: tuple[range, ...], actuator_ids: IdsT) -> IdsT | list[int]:
    """Return the columns `own` of actuators; the ids themselves if each actuator has one column."""
    if actuator_ids is None or all(len(columns) == 1 for columns in own):
        return actuator_ids
    if isinstance(actuator_ids, torch.Tensor):
        ids = torch.arange(len(own))[actuator_ids.cpu()].tolist()
    elif isinstance(actuator_ids, slice):
        ids = range(len(own))[actuator_ids]
    elif isinstance(actuator_ids, int):
        ids = (actuator_ids,)
    else:
        ids = actuator_ids
    return [column for i in ids for column in own[i]]


def _ranges(widths: Iterable[int]) -> tuple[range, ...]:
    """Return contiguous ranges of the given widths, starting at 0."""
    return tuple(
        range(a, b) for a, b in itertools.pairwise(itertools.accumulate(widths, initial=0))
    )
