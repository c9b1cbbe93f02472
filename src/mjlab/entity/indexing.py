"""Where an entity's elements are in the compiled model."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import mujoco
import torch

from mjlab.utils.indexing import as_columns
from mjlab.utils.mujoco import (
    control_columns,
    dof_width,
    force_columns,
    moving_dofs,
    qpos_width,
)

Ids: TypeAlias = torch.Tensor | slice | Sequence[int] | None
"""A selection: None for all, a slice, or whole numbers (list, tensor) or a boolean mask."""

IdsT = TypeVar("IdsT", bound="Ids | int")

_OBJECT_TYPES = {
    "bodies": mujoco.mjtObj.mjOBJ_BODY,
    "joints": mujoco.mjtObj.mjOBJ_JOINT,
    "geoms": mujoco.mjtObj.mjOBJ_GEOM,
    "sites": mujoco.mjtObj.mjOBJ_SITE,
    "tendons": mujoco.mjtObj.mjOBJ_TENDON,
    "cameras": mujoco.mjtObj.mjOBJ_CAMERA,
    "lights": mujoco.mjtObj.mjOBJ_LIGHT,
    "meshes": mujoco.mjtObj.mjOBJ_MESH,
    "materials": mujoco.mjtObj.mjOBJ_MATERIAL,
    "textures": mujoco.mjtObj.mjOBJ_TEXTURE,
    "pairs": mujoco.mjtObj.mjOBJ_PAIR,
    "actuators": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "equalities": mujoco.mjtObj.mjOBJ_EQUALITY,
    "sensors": mujoco.mjtObj.mjOBJ_SENSOR,
}
# Fields of `EntityIndexing` besides bodies and joints.
_FURTHER_KINDS = (
    "geoms", "sites", "tendons", "cameras", "lights", "materials", "textures", "pairs", "actuators",
)  # fmt: skip


@dataclass(eq=False)
class EntityIndexing:
    """Spec elements of one entity and their ids and addresses in the compiled model.

    Ids are int32 tensors of global ids, in spec order.
    """

    bodies: tuple[mujoco.MjsBody, ...]
    """All bodies but the world; the first is the root."""
    joints: tuple[mujoco.MjsJoint, ...]
    """All joints but the free one."""
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
    """Columns of `ctrl` of `actuators` in turn; an actuator may have none, one or several."""
    force_ids: torch.Tensor
    """Columns of `actuator_force` of `actuators` in turn; three for an orientation, else one."""
    joint_ids: torch.Tensor
    mocap_id: int | None
    """Index into `mocap_pos`, or None if the root is no mocap body."""
    joint_q_adr: torch.Tensor
    """Addresses in `qpos`, without the free joint."""
    joint_v_adr: torch.Tensor
    """Addresses in `qvel`, without the free joint."""
    free_joint_q_adr: torch.Tensor
    """The free joint's 7 addresses in `qpos`, or none."""
    free_joint_v_adr: torch.Tensor
    """The free joint's 6 addresses in `qvel`, or none."""
    body_tree_ids: torch.Tensor
    """For each body, the top-level body of its tree: `cvel` refers to that tree's centre of mass."""
    geom_body_ids: torch.Tensor
    """For each geom, the body it belongs to."""
    geom_tree_ids: torch.Tensor
    """For each geom, the top-level body of its tree."""
    site_body_ids: torch.Tensor
    """For each site, the body it belongs to."""
    site_tree_ids: torch.Tensor
    """For each site, the top-level body of its tree."""
    moved_bodies: torch.Tensor
    """(nj, number of bodies) float32, 1 where a degree of freedom of `joint_v_adr` moves a body."""

    def force_columns(self, actuator_ids: IdsT) -> IdsT | list[int]:
        """Return the columns of `EntityData.actuator_force` of some of the entity's actuators."""
        return _columns_of(self._forces, actuator_ids)

    def control_columns(self, actuator_ids: IdsT) -> IdsT | list[int]:
        """Return the positions in `ctrl_ids` of the controls of some of the entity's actuators."""
        return _columns_of(self._controls, actuator_ids)

    @property
    def root_body_id(self) -> int:
        """Global id of the root body."""
        return self._root_id

    _root_id: int = -1
    _forces: tuple[range, ...] = ()
    """For each of `actuators`, its columns among `force_ids`."""
    _controls: tuple[range, ...] = ()
    """For each of `actuators`, its columns among `ctrl_ids`."""


class Addresses:
    """Positions along one axis of a simulation field, and selections of them.

    Positions that follow each other are handed out as a slice, so that reading a field gives a
    view of it and nothing is copied.
    """

    def __init__(self, positions: Sequence[int] | torch.Tensor, device: str) -> None:
        host = positions.tolist() if isinstance(positions, torch.Tensor) else list(positions)
        self._host = [int(position) for position in host]
        self._device = device
        self.tensor = torch.tensor(self._host, dtype=torch.int64, device=device)
        self.all: slice | torch.Tensor = as_columns(self._host, device)
        self.constant = self._host[0] if len(set(self._host)) == 1 else None

    def __len__(self) -> int:
        return len(self._host)

    def select(self, ids: Ids = None) -> tuple[slice | torch.Tensor, int]:
        """Return the index of the chosen positions, and how many there are."""
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
    """Find the elements of an entity's `spec` in the compiled `model`.

    Raises:
        ValueError: an element is not in the model, or is unnamed in a spec that was not compiled.
    """

    def tensor(values: Iterable[int]) -> torch.Tensor:
        return torch.tensor([int(v) for v in values], dtype=torch.int32, device=device)

    elements: dict[str, tuple[Any, ...]] = {
        "bodies": tuple(spec.bodies[1:]),
        "joints": tuple(joint for joint in spec.joints if joint is not free_joint),
        **{kind: tuple(getattr(spec, kind)) for kind in _FURTHER_KINDS},
    }
    actuators = elements.pop("actuators")
    ids = {kind: element_ids(model, kind, found) for kind, found in elements.items()}
    actuator_ids = element_ids(model, "actuators", actuators) if is_actuated else []
    joints = [(int(model.jnt_type[i]), i) for i in ids["joints"]]
    dofs = [model.jnt_dofadr[i] + k for kind, i in joints for k in range(dof_width(kind))]
    moved = moving_dofs(model)[ids["bodies"]][:, dofs].T
    free = [] if free_joint is None else element_ids(model, "joints", (free_joint,))
    geom_bodies = [int(model.geom_bodyid[i]) for i in ids["geoms"]]
    site_bodies = [int(model.site_bodyid[i]) for i in ids["sites"]]
    root = ids["bodies"][0]
    mocap_id = int(model.body_mocapid[root])
    return EntityIndexing(
        **elements,
        actuators=actuators if is_actuated else None,
        body_ids=tensor(ids["bodies"]),
        geom_ids=tensor(ids["geoms"]),
        site_ids=tensor(ids["sites"]),
        tendon_ids=tensor(ids["tendons"]),
        cam_ids=tensor(ids["cameras"]),
        light_ids=tensor(ids["lights"]),
        mat_ids=tensor(ids["materials"]),
        tex_ids=tensor(ids["textures"]),
        pair_ids=tensor(ids["pairs"]),
        actuator_ids=tensor(actuator_ids),
        ctrl_ids=tensor(control_columns(model, actuator_ids)),
        force_ids=tensor(force_columns(model, actuator_ids)),
        joint_ids=tensor(ids["joints"]),
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
    """Return the ids of spec elements in `model`: by name, or by spec order without a name.

    Raises:
        ValueError: an element is not in the model, or is unnamed in a spec that was not compiled.
    """
    object_type = _OBJECT_TYPES[kind]
    name = object_type.name.removeprefix("mjOBJ_").lower()
    ids = []
    for element in elements:
        found = element.id
        if element.name:
            found = mujoco.mj_name2id(model, object_type, element.name)
            if found < 0:
                raise ValueError(
                    f"The compiled model has no {name} {element.name!r}. Initialize an entity with "
                    "the model that was compiled from the spec it belongs to."
                )
        elif found < 0:
            raise ValueError(
                f"A {name} without a name cannot be found in the model, because its spec was changed "
                "after it was compiled. Compile that spec, not a copy of it."
            )
        ids.append(found)
    return ids


def _columns_of(own: tuple[range, ...], actuator_ids: IdsT) -> IdsT | list[int]:
    """Return the columns of actuators that own some each; the ids themselves if each owns one."""
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
    """Return ranges of these widths that follow each other from 0."""
    return tuple(
        range(a, b) for a, b in itertools.pairwise(itertools.accumulate(widths, initial=0))
    )
