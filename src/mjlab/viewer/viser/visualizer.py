"""Debug visualizer for the browser, with one batch per kind of primitive."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import torch
import trimesh
import viser
import viser.transforms as vtf
from mjviser.conversions import is_fixed_body, merge_geoms

from mjlab.viewer.debug_visualizer import MIN_LENGTH, Color, DebugVisualizer, pose_ghost
from mjlab.viewer.model_sync import compute_poses, to_numpy

Array = np.ndarray | torch.Tensor

_HEAD_FRACTION = 0.2
_HEAD_WIDENING = 2.0
_MAX_GHOST_GEOM_GROUP = 2


class ViserDebugVisualizer(DebugVisualizer):
    """Debug visualizer that collects the items of a frame; `send` shows them in the browser.

    Opacity is per item, for arrows too.
    """

    def __init__(self, server: viser.ViserServer, model: mujoco.MjModel):
        self._server = server
        self._model = model
        self._meshes = {
            "shaft": trimesh.creation.cylinder(radius=1.0, height=1.0, sections=16),
            "head": trimesh.creation.cone(radius=1.0, height=1.0, sections=16),
            "sphere": trimesh.creation.icosphere(subdivisions=2, radius=1.0),
            "box": trimesh.creation.box(extents=(2.0, 2.0, 2.0)),
        }
        self.legend: dict[str, Color] = {}
        """Color by meaning, of the drawings of this frame."""
        self._batches: dict[str, _Batch] = {}
        self._arrows = _Arrows()
        self._debug_handles: dict[str, viser.BatchedMeshHandle] = {}
        self._ghosts: dict[int, tuple[mujoco.MjModel, mujoco.MjData, dict[int, str]]] = {}

    @property
    def meansize(self) -> float:
        return float(self._model.stat.meansize)

    def add_legend(self, color: Color, meaning: str) -> None:
        self.legend[meaning] = color

    def clear(self) -> None:
        self.legend = {}
        self._batches.clear()
        self._arrows = _Arrows()

    def clear_debug_all(self) -> None:
        """Remove everything drawn, including items on the page."""
        self.clear()
        for handle in self._debug_handles.values():
            handle.remove()
        self._debug_handles.clear()

    def add_ghost_mesh(
        self,
        qpos: Array,
        model: mujoco.MjModel,
        mocap_pos: Array | None = None,
        mocap_quat: Array | None = None,
        alpha: float = 0.5,
        label: str | None = None,
    ) -> None:
        if id(model) not in self._ghosts:
            shown = {
                geom_id: f"ghost/{id(model)}/{geom_id}"
                for geom_id in range(model.ngeom)
                if model.geom_group[geom_id] <= _MAX_GHOST_GEOM_GROUP
                and _geom_rgba(model, geom_id)[3] > 0
                and not is_fixed_body(model, int(model.geom_bodyid[geom_id]))
            }
            for geom_id, key in shown.items():
                self._meshes[key] = merge_geoms(model, [geom_id])
            # Keep a reference to the model, so that another model cannot reuse its id.
            self._ghosts[id(model)] = (model, mujoco.MjData(model), shown)
        _, data, shown = self._ghosts[id(model)]
        mocap = (None if pose is None else to_numpy(pose) for pose in (mocap_pos, mocap_quat))
        pose_ghost(data, to_numpy(qpos), *mocap)
        compute_poses(model, data)
        for geom_id, key in shown.items():
            body_id = model.geom_bodyid[geom_id]
            red, green, blue, _ = _geom_rgba(model, geom_id)
            self._add(
                key,
                data.xpos[body_id],
                data.xquat[body_id],
                (1.0, 1.0, 1.0),
                (red, green, blue, alpha),
            )

    def add_frame(
        self,
        position: Array,
        rotation_matrix: Array,
        scale: float = 0.3,
        label: str | None = None,
        axis_radius: float = 0.01,
        alpha: float = 1.0,
        axis_colors: tuple[tuple[float, float, float], ...] | None = None,
    ) -> None:
        position, rotation = to_numpy(position), to_numpy(rotation_matrix)
        super().add_frame(position, rotation, scale, label, axis_radius, alpha, axis_colors)

    def send(self, offset: np.ndarray) -> None:
        """Show the items of this frame, translated by `offset` (3,), and hide items not redrawn."""
        arrows, self._arrows = self._arrows, _Arrows()
        if arrows.starts:
            shafts, heads = (self._batches.get(key, _Batch()) for key in ("shaft", "head"))
            arrows.add_to(shafts, heads)
            if heads.positions:
                self._batches["shaft"], self._batches["head"] = shafts, heads
        for key, batch in self._batches.items():
            values = batch.arrays(offset)
            if key in self._debug_handles:
                for name, value in values.items():
                    setattr(self._debug_handles[key], name, value)
                continue
            mesh = self._meshes[key]
            self._debug_handles[key] = self._server.scene.add_batched_meshes_simple(
                f"/debug/{key}",
                np.asarray(mesh.vertices, dtype=np.float32),
                np.asarray(mesh.faces, dtype=np.uint32),
                **values,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
        for key, handle in self._debug_handles.items():
            if handle.visible != (key in self._batches):
                handle.visible = not handle.visible

    def _place(self, shape: str, center: Array, size: Array, mat: Array, color: Color) -> None:
        wxyz = vtf.SO3.from_matrix(to_numpy(mat).astype(float).reshape(3, 3)).wxyz
        self._add("box" if shape == "box" else "sphere", center, wxyz, size, color)

    def _connect(self, shape: str, start: Array, end: Array, radius: float, color: Color) -> None:
        start, end = (
            to_numpy(start).reshape(3).astype(float),
            to_numpy(end).reshape(3).astype(float),
        )
        if shape == "arrow":
            self._arrows.add(start, end, radius, color)
            return
        length = float(np.linalg.norm(end - start))
        if length >= MIN_LENGTH:
            [wxyz] = rotations_of_z((end - start)[None] / length)
            self._add("shaft", 0.5 * (start + end), wxyz, (radius, radius, length), color)

    def _add(self, key: str, position, wxyz, scale, color: Color) -> None:
        self._batches.setdefault(key, _Batch()).add(position, wxyz, scale, color)


@dataclass
class _Batch:
    """Items of one mesh: position, rotation, scale, color and opacity per item."""

    positions: list[np.ndarray] = field(default_factory=list)
    wxyzs: list[np.ndarray] = field(default_factory=list)
    scales: list[np.ndarray] = field(default_factory=list)
    colors: list[Color] = field(default_factory=list)

    def add(self, position, wxyz, scale, color: Color) -> None:
        self.positions.append(np.array(to_numpy(position), dtype=np.float32))
        self.wxyzs.append(wxyz)
        self.scales.append(to_numpy(scale))
        self.colors.append(color)

    def extend(self, positions, wxyzs, scales, colors: list[Color]) -> None:
        """Add n items, with one row of each array (n, ...) per item."""
        self.positions.extend(positions)
        self.wxyzs.extend(wxyzs)
        self.scales.extend(scales)
        self.colors.extend(colors)

    def arrays(self, offset: np.ndarray) -> dict[str, Any]:
        """Return the properties of viser's mesh handle, with positions translated by `offset`."""
        positions = np.array(self.positions, dtype=np.float32).reshape(-1, 3)
        rgba = np.clip(np.array(self.colors, dtype=np.float32), 0.0, 1.0)
        return {
            "batched_positions": positions + np.asarray(offset, dtype=np.float32),
            "batched_wxyzs": np.array(self.wxyzs, dtype=np.float32).reshape(-1, 4),
            "batched_scales": np.array(self.scales, dtype=np.float32).reshape(-1, 3),
            "batched_colors": (rgba[:, :3] * 255).astype(np.uint8),
            "batched_opacities": rgba[:, 3],
        }


@dataclass
class _Arrows:
    """Arrows of a frame. Directions are computed in one batch, because frames have many arrows."""

    starts: list[np.ndarray] = field(default_factory=list)
    ends: list[np.ndarray] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    colors: list[Color] = field(default_factory=list)

    def add(self, start: np.ndarray, end: np.ndarray, width: float, color: Color) -> None:
        self.starts.append(start)
        self.ends.append(end)
        self.widths.append(width)
        self.colors.append(color)

    def add_to(self, shafts: _Batch, heads: _Batch) -> None:
        """Add the shafts and heads of the arrows that have a direction."""
        starts = np.array(self.starts, dtype=float).reshape(-1, 3)
        vectors = np.array(self.ends, dtype=float).reshape(-1, 3) - starts
        lengths = np.linalg.norm(vectors, axis=1)
        kept = np.flatnonzero(lengths >= MIN_LENGTH)
        starts, lengths = starts[kept], lengths[kept, None]
        axes = vectors[kept] / lengths
        wxyzs = rotations_of_z(axes)
        widths = np.array(self.widths, dtype=float)[kept, None]
        colors = [self.colors[i] for i in kept]
        shaft, head = (1.0 - _HEAD_FRACTION) * lengths, _HEAD_FRACTION * lengths
        shafts.extend(
            starts + 0.5 * shaft * axes, wxyzs, np.hstack((widths, widths, shaft)), colors
        )
        radii = _HEAD_WIDENING * widths
        heads.extend(starts + shaft * axes, wxyzs, np.hstack((radii, radii, head)), colors)


def _geom_rgba(model: mujoco.MjModel, geom_id: int) -> np.ndarray:
    material = model.geom_matid[geom_id]
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom_id]


def rotations_of_z(axes: np.ndarray) -> np.ndarray:
    """Return the quaternions that rotate z onto unit vectors (n, 3), w first, (n, 4)."""
    # Shortest-arc quaternion, before normalization: (1 + z·a, z × a).
    wxyzs = np.zeros((len(axes), 4))
    wxyzs[:, 0] = 1.0 + axes[:, 2]
    wxyzs[:, 1], wxyzs[:, 2] = -axes[:, 1], axes[:, 0]
    lengths = np.linalg.norm(wxyzs, axis=1)
    # Antiparallel (a = -z): rotate by π about x.
    opposite = lengths < 1e-8
    wxyzs[opposite], lengths[opposite] = (0.0, 1.0, 0.0, 0.0), 1.0
    return wxyzs / lengths[:, None]
