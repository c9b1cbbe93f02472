"""Which environments and which objects of an entity a randomization touches."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from mjlab.envs.mdp._indexing import resolve_env_ids

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

# Numbers a joint contributes to qpos and to qvel, by mjtJoint: free, ball, slide, hinge.
_QPOS_WIDTH = {0: 7, 1: 4, 2: 1, 3: 1}
_DOF_WIDTH = {0: 6, 1: 3, 2: 1, 3: 1}


@dataclass(frozen=True)
class ObjectKind:
    """A kind of MuJoCo object: where its ids are in configs, entities and the model."""

    name: str
    """What error messages call it."""
    cfg_ids: str
    """Attribute of `SceneEntityCfg` with the ids inside the entity."""
    entity_names: str
    """Attribute of `Entity` with the names, in the order of those ids."""
    global_ids: str
    """Attribute of `EntityIndexing` with the ids in the model, in that order too."""
    start: str | None = None
    """For values stored by address: the `MjModel` field with the first address of a joint."""
    width: dict[int, int] | None = None
    """For values stored by address: the number of addresses, by joint type."""


BODY = ObjectKind("body", "body_ids", "body_names", "body_ids")
GEOM = ObjectKind("geom", "geom_ids", "geom_names", "geom_ids")
SITE = ObjectKind("site", "site_ids", "site_names", "site_ids")
JOINT = ObjectKind("joint", "joint_ids", "joint_names", "joint_ids")
DOF = ObjectKind("joint", "joint_ids", "joint_names", "joint_ids", "jnt_dofadr", _DOF_WIDTH)
QPOS = ObjectKind("joint", "joint_ids", "joint_names", "joint_ids", "jnt_qposadr", _QPOS_WIDTH)
TENDON = ObjectKind("tendon", "tendon_ids", "tendon_names", "tendon_ids")
CAMERA = ObjectKind("camera", "camera_ids", "camera_names", "cam_ids")
LIGHT = ObjectKind("light", "light_ids", "light_names", "light_ids")
MATERIAL = ObjectKind("material", "material_ids", "material_names", "mat_ids")
TEXTURE = ObjectKind("texture", "texture_ids", "texture_names", "tex_ids")
PAIR = ObjectKind("pair", "pair_ids", "pair_names", "pair_ids")


@dataclass(frozen=True)
class Selection:
    """Rows (environments) and columns (places in a model field) to write."""

    env: ManagerBasedRlEnv
    entity: Entity
    kind: ObjectKind
    rows: torch.Tensor
    """Environment ids, int64 (R,)."""
    local_ids: torch.Tensor
    """Ids of the objects inside the entity, int64 (K,)."""
    columns: torch.Tensor
    """Indices into the second dimension of the model field, int64 (C,). C = K, except where a
    joint has several addresses."""

    @property
    def index(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Index of the block of rows and columns: (R, 1) and (1, C)."""
        return self.rows[:, None], self.columns[None, :]

    @property
    def shape(self) -> tuple[int, int]:
        """(R, C)."""
        return len(self.rows), len(self.columns)

    @property
    def names(self) -> list[str]:
        """Names of the selected objects."""
        names = getattr(self.entity, self.kind.entity_names)
        return [names[i] for i in self.local_ids.tolist()]


def select(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    asset_cfg: SceneEntityCfg,
    kind: ObjectKind,
    pattern: str | None = None,
) -> Selection:
    """Resolve ids to a `Selection`.

    Args:
        env_ids: Environments; None means all.
        asset_cfg: Entity and, without a pattern, its selected objects.
        pattern: Regular expression that object names of the entity must match in full; it
            replaces the selection of `asset_cfg`.

    Raises `ValueError` if a pattern matches nothing.
    """
    entity: Entity = env.scene[asset_cfg.name]
    all_ids: torch.Tensor = getattr(entity.data.indexing, kind.global_ids)
    # Names are looked up for patterns only: randomization may run at nearly every step.
    local_ids = (
        _local_ids(getattr(asset_cfg, kind.cfg_ids), len(all_ids))
        if pattern is None
        else _matching_ids(pattern, getattr(entity, kind.entity_names), kind, asset_cfg.name)
    )
    ids = torch.tensor(local_ids, dtype=torch.long, device=env.device)
    global_ids = all_ids[ids].long()
    columns = global_ids if kind.start is None else _addresses(env, kind, global_ids)
    return Selection(env, entity, kind, resolve_env_ids(env, env_ids), ids, columns)


def _local_ids(ids: slice | int | Sequence[int] | torch.Tensor, count: int) -> list[int]:
    if isinstance(ids, slice):
        return list(range(count))[ids]
    if isinstance(ids, torch.Tensor):
        return ids.tolist()
    return [ids] if isinstance(ids, int) else list(ids)


def _matching_ids(pattern: str, names: Sequence[str], kind: ObjectKind, entity: str) -> list[int]:
    ids = [i for i, name in enumerate(names) if re.fullmatch(pattern, name)]
    if not ids:
        raise ValueError(
            f"ranges: the pattern {pattern!r} matches no {kind.name} of entity {entity!r}. "
            f"Available: {list(names)}."
        )
    return ids


def _addresses(env: ManagerBasedRlEnv, kind: ObjectKind, joints: torch.Tensor) -> torch.Tensor:
    """Return every address of the joints: one of a hinge or slide, several of a ball joint."""
    assert kind.start is not None
    assert kind.width is not None
    model = env.sim.mj_model
    starts, types = getattr(model, kind.start), model.jnt_type
    addresses = [
        int(starts[joint]) + k
        for joint in joints.tolist()
        for k in range(kind.width[int(types[joint])])
    ]
    return torch.tensor(addresses, dtype=torch.long, device=env.device)
