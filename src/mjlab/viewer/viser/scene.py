"""3-D scene of the browser viewer: mjviser's scene with a camera and debug drawings.

`MjlabViserScene` is the scene; `GeomVariants` draws per-environment shapes.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
import viser
import viser.transforms as vtf
from mjviser import ViserMujocoScene
from mjviser.conversions import group_geoms_by_visual_compat, merge_geoms

from mjlab.viewer.camera import (
    CameraView,
    first_moving_body,
    resolve_camera,
    whole_model_view,
)
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS as VIEWER_MODEL_FIELDS
from mjlab.viewer.model_sync import copy_state, host_model, sync_model_fields, to_numpy
from mjlab.viewer.viser.look import set_look, set_plain_look, without_metal
from mjlab.viewer.viser.visualizer import ViserDebugVisualizer

log = logging.getLogger(__name__)

_FOV_RANGE = (20, 150)
_DEFAULT_FOV = 60.0
_CONTACT_WIDENING = 4.2

_SHAPE_FIELDS = frozenset(
    {"geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_matid", "geom_dataid", "mat_rgba"}
)
_MAX_SHAPES = 256
_CHECK_PERIOD_S = 1.0


class MjlabViserScene(ViserMujocoScene, ViserDebugVisualizer):
    """mjviser's scene of all environments, with a debug visualizer and a camera.

    Following a body moves the scene, not the camera, so that the user keeps control of the camera.
    `add_*` queues debug drawings; `update*` shows them until `clear`. Controls of the page redraw
    the last state in a thread of the server. If another thread owns the state, use
    `set_refresh_handler` to make controls only request a redraw.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        mj_model: mujoco.MjModel,
        num_envs: int,
        sim_model: Any | None = None,
        expanded_fields: set[str] | None = None,
        *,
        view: CameraView | None = None,
        geom_group: tuple[int, ...] = (1, 1, 1, 0, 0, 0),
        site_group: tuple[int, ...] = (1, 1, 1, 0, 0, 0),
    ) -> None:
        """Send the geoms of `mj_model` to the page for `num_envs` environments.

        Args:
            server: The page's server.
            mj_model: Compiled scene. mjviser writes colors and sizes into its visual settings.
            num_envs: Number of environments to draw.
            sim_model: Batched model, to draw the randomized fields of each environment. The scene
                then copies `mj_model`.
            expanded_fields: Names of the per-environment fields of `sim_model`.
            view: Camera. None: the whole model until `create_scene_gui` sets the camera.
            geom_group: Initially visible geom groups.
            site_group: Initially visible site groups.
        """
        if sim_model is not None:
            mj_model = host_model(mj_model)
        ViserMujocoScene.__init__(self, server, mj_model, num_envs)
        ViserDebugVisualizer.__init__(self, server, mj_model)
        set_look(server, mj_model)
        # mjviser's default contact points are hidden inside a robot's feet.
        mj_model.vis.scale.contactwidth *= _CONTACT_WIDENING
        self._has_own_view = view is not None
        self.view = view if view is not None else whole_model_view(mj_model)
        self.geom_groups_visible = [bool(shown) for shown in geom_group]
        self.site_groups_visible = [bool(shown) for shown in site_group]
        self._sync_visibilities()
        self._fov = float(np.clip(self.view.fovy or _DEFAULT_FOV, *_FOV_RANGE))
        self._tracked_body_id = first_moving_body(mj_model)
        if view is not None:
            self.camera_tracking_enabled = view.body_id is not None
            self._tracked_body_id = view.body_id or self._tracked_body_id
        self.debug_visualization_enabled = True
        self.show_all_envs = False
        self._env_slider: viser.GuiSliderHandle[int] | None = None
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        self._sim_model = sim_model
        self._expanded_fields = (expanded_fields or set()) if sim_model is not None else set()
        self._variants = GeomVariants(self, sim_model, self._expanded_fields)
        self._aim_initial_camera()

    @classmethod
    def create(cls, *args: Any, **kwargs: Any) -> MjlabViserScene:
        """Construct the scene: the spelling of releases 1.1 and 1.2."""
        return cls(*args, **kwargs)

    @property
    def offset(self) -> np.ndarray:
        """Translation of the scene at the last update, (3,)."""
        return self._scene_offset

    @property
    def meansize(self) -> float:
        """Typical size of a body (m), or `meansize_override`."""
        override = self.meansize_override
        return float(self.mj_model.stat.meansize) if override is None else override

    def set_plain_look(self) -> None:
        """Draw without reflections and shadows, which are slow in browsers without a GPU."""
        groups = (self._fixed_geom_handles, self._fixed_site_handles, self.site_handles_by_group)
        handles = [handle for group in groups for handle in group.values()]
        set_plain_look(self.server, [*handles, *(group.handle for group in self._mesh_groups)])
        self._variants.is_plain = True

    def get_env_indices(self, num_envs: int) -> Iterable[int]:
        """Return the environments to draw debug items for, among the visible ones."""
        if self.show_only_selected:
            return (self.env_idx,) if self.env_idx < num_envs else ()
        return super().get_env_indices(num_envs)

    def update(self, wp_data: Any, env_idx: int | None = None) -> None:
        """Show the current state of all environments; call between steps.

        Args:
            wp_data: A `Simulation` or its data. All values are copied before sending.
            env_idx: Environment of the overlays and the followed body. None: the selected one.
        """
        if env_idx is None:
            env_idx = self.env_idx
        data = wp_data.data if hasattr(wp_data, "copy_to_host") else wp_data
        body_xpos = to_numpy(data.xpos).copy()
        body_xmat = to_numpy(data.xmat).reshape(*body_xpos.shape[:2], 3, 3).copy()
        mocap_pos, mocap_quat = np.zeros((self.num_envs, 0, 3)), np.zeros((self.num_envs, 0, 4))
        if self.mj_model.nmocap > 0:
            mocap_pos = to_numpy(data.mocap_pos).copy()
            mocap_quat = to_numpy(data.mocap_quat).copy()
        mj_data = None
        if self._any_decor_visible():
            sync_model_fields(self.mj_model, self._sim_model, self._expanded_fields, env_idx)
            copy_state(wp_data, env_idx, self.mj_data)
            mujoco.mj_forward(self.mj_model, self.mj_data)
            mj_data = self.mj_data
        offset = np.zeros(3)
        if self.camera_tracking_enabled and self._tracked_body_id is not None:
            offset = -np.asarray(body_xpos[env_idx, self._tracked_body_id], dtype=float)
        self._update_visualization(
            body_xpos, body_xmat, mocap_pos, mocap_quat, env_idx, offset, mj_data
        )

    def update_from_arrays(
        self,
        body_xpos: np.ndarray,
        body_xmat: np.ndarray,
        mocap_pos: np.ndarray | None = None,
        mocap_quat: np.ndarray | None = None,
        env_idx: int | None = None,
        qpos: np.ndarray | None = None,
        qvel: np.ndarray | None = None,
        ctrl: np.ndarray | None = None,
    ) -> None:
        """Show body poses, (num_envs, nbody, 3) and (num_envs, nbody, 3, 3).

        `qpos` and `qvel` are for contacts and other overlays computed by MuJoCo.
        """
        shown = self.env_idx if env_idx is None else env_idx
        sync_model_fields(self.mj_model, self._sim_model, self._expanded_fields, shown)
        super().update_from_arrays(
            body_xpos, body_xmat, mocap_pos, mocap_quat, env_idx, qpos, qvel, ctrl
        )

    def select_env(self, env_idx: int) -> None:
        """Show environment `env_idx` modulo `num_envs`, as the slider of the page does."""
        if self._env_slider is not None:
            self._env_slider.value = env_idx % self.num_envs

    def toggle(self, attribute: str) -> None:
        """Toggle the checkbox of an attribute of the scene, if the page has it."""
        switch = self._switches.get(attribute)
        if switch is not None:
            switch.value = not switch.value

    def aim(self) -> None:
        """Move the camera of every connected client to the configured view."""
        for client in self.server.get_clients().values():
            client.camera.position = self._look_at() + self.view.offset()
            client.camera.look_at = self._look_at()

    def create_scene_gui(
        self,
        camera_distance: float = 3.0,
        camera_azimuth: float = 45.0,
        camera_elevation: float = 30.0,
        show_debug_viz_control: bool = True,
        debug_viz_extra_gui: Callable[[], None] | None = None,
    ) -> None:
        """Add environment, camera and debug controls to the current GUI container.

        Args:
            camera_distance: Distance of the camera (m), for scenes without `view`. <= 0: show the
                whole model.
            camera_azimuth: Azimuth of the camera (degrees), for scenes without `view`.
            camera_elevation: Elevation of the camera (degrees), for scenes without `view`.
                Positive: above the scene.
            show_debug_viz_control: Add controls of debug drawings.
            debug_viz_extra_gui: Called to add further controls of debug drawings.
        """
        if not self._has_own_view:
            self.view = dataclasses.replace(
                self.view,
                distance=camera_distance if camera_distance > 0 else self.view.distance,
                azimuth=camera_azimuth,
                elevation=-camera_elevation,
            )
            self._aim_initial_camera()
        gui = self.server.gui
        if self.num_envs > 1:
            with gui.add_folder("Environment"):
                select = self._env_slider = gui.add_slider(
                    "Select", 0, self.num_envs - 1, 1, self.env_idx,
                    hint=f"Environment in view, 0 to {self.num_envs - 1}.",
                )  # fmt: skip
                hint = "Show only the selected environment."
                self._add_switch("Hide others", "show_only_selected", hint=hint)

            @select.on_update
            def _(_: Any) -> None:
                self.env_idx = int(select.value)
                if self._last_body_xpos is not None and self.env_idx < len(self._last_body_xpos):
                    self._last_env_idx = self.env_idx
                self.request_update()

        with gui.add_folder("Camera"):
            self._create_camera_gui()
        if show_debug_viz_control:
            with gui.add_folder("Debug Viz"):
                self._add_switch("Enabled", "debug_visualization_enabled")
                self._add_switch("All envs", "show_all_envs", visible=self.num_envs > 1)
                if debug_viz_extra_gui is not None:
                    debug_viz_extra_gui()

    def create_visualization_gui(
        self,
        camera_distance: float = 3.0,
        camera_azimuth: float = 45.0,
        camera_elevation: float = 30.0,
        show_debug_viz_control: bool = True,
        debug_viz_extra_gui: Callable[[], None] | None = None,
    ) -> viser.GuiTabGroupHandle:
        """Add tabs of scene, overlay and group controls; arguments as in `create_scene_gui`."""
        tabs = self.server.gui.add_tab_group()
        with tabs.add_tab("Scene", icon=viser.Icon.VIDEO):
            self.create_scene_gui(
                camera_distance,
                camera_azimuth,
                camera_elevation,
                show_debug_viz_control,
                debug_viz_extra_gui,
            )
        with tabs.add_tab("Visualization", icon=viser.Icon.EYE):
            self.create_overlay_gui()
        self.create_groups_gui(tabs)
        return tabs

    def create_groups_gui(self, tabs: viser.GuiTabGroupHandle | None = None) -> None:
        """Add geom and site group checkboxes to the current container, or to a tab of `tabs`."""
        place = contextlib.nullcontext()
        if tabs is not None:
            place = tabs.add_tab("Groups", icon=viser.Icon.LAYERS_INTERSECT)
        model, option = self.mj_model, self._mjv_option
        others = (
            ("Sites", model.site_group, self.site_groups_visible),
            ("Joints", model.jnt_group, option.jointgroup),
            ("Tendons", model.tendon_group, option.tendongroup),
            ("Actuators", model.actuator_group, option.actuatorgroup),
        )
        with place:
            with self.server.gui.add_folder("Geoms"):
                for group, meaning in geom_group_meanings(model).items():
                    label = f"{meaning} (group {group})"
                    self._add_group_switch(label, self.geom_groups_visible, group)
            for title, groups, visible in others:
                used = _groups_in_use(groups)
                # Sites are drawn by default, so that even a single group needs a switch.
                if used and (used != [0] or title == "Sites"):
                    with self.server.gui.add_folder(title):
                        for group in used:
                            self._add_group_switch(f"Group {group}", visible, group)

    def _update_visualization_locked(
        self,
        body_xpos: np.ndarray,
        body_xmat: np.ndarray,
        mocap_pos: np.ndarray,
        mocap_quat: np.ndarray,
        env_idx: int,
        scene_offset: np.ndarray,
        mj_data: mujoco.MjData | None = None,
    ) -> None:
        if not self.debug_visualization_enabled:
            self.clear()
        with self.server.atomic():
            self._variants.update(body_xpos, body_xmat, env_idx, scene_offset)
            super()._update_visualization_locked(
                body_xpos, body_xmat, mocap_pos, mocap_quat, env_idx, scene_offset, mj_data
            )
            self.send(scene_offset)

    def _look_at(self) -> np.ndarray:
        return np.zeros(3) if self.camera_tracking_enabled else np.asarray(self.view.lookat)

    def _aim_initial_camera(self) -> None:
        camera = self.server.initial_camera
        camera.position = self._look_at() + self.view.offset()
        camera.look_at = self._look_at()
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = np.deg2rad(self._fov)

    def _add_switch(self, label: str, attribute: str, **options: Any) -> None:
        """Add a checkbox that sets an attribute of the scene and redraws."""
        switch = self.server.gui.add_checkbox(label, getattr(self, attribute), **options)
        self._switches[attribute] = switch

        @switch.on_update
        def _(_: Any) -> None:
            setattr(self, attribute, switch.value)
            self.request_update()

    def _add_group_switch(self, label: str, visible: Any, group: int) -> None:
        """Add a checkbox that shows or hides a group of elements."""
        switch = self.server.gui.add_checkbox(label, bool(visible[group]))

        @switch.on_update
        def _(_: Any) -> None:
            visible[group] = switch.value
            self._sync_visibilities()
            self.request_update()

    def _create_camera_gui(self) -> None:
        gui = self.server.gui
        track = gui.add_checkbox(
            "Track camera",
            self.camera_tracking_enabled,
            disabled=self._tracked_body_id is None,
            hint="Keep the followed body centered.",
        )
        fov = gui.add_slider(
            "FOV (°)",
            min=_FOV_RANGE[0],
            max=_FOV_RANGE[1],
            step=1,
            initial_value=round(self._fov),
            hint="Vertical field of view.",
        )
        reset = gui.add_button("Reset camera", icon=viser.Icon.VIDEO)

        @track.on_update
        def _(_: Any) -> None:
            self.camera_tracking_enabled = track.value
            self._aim_initial_camera()
            self.aim()
            self.request_update()

        @fov.on_update
        def _(_: Any) -> None:
            for client in self.server.get_clients().values():
                client.camera.fov = float(np.deg2rad(fov.value))

        @reset.on_click
        def _(_: Any) -> None:
            self.aim()


def scene_of(env: Any, server: viser.ViserServer) -> MjlabViserScene:
    """Return the scene of an unwrapped environment, with the drawings of its commands.

    Other drawings are switched off: too many arrows say nothing.
    """
    model, cfg = env.sim.mj_model, env.cfg.viewer
    scene = MjlabViserScene(
        server,
        model,
        env.num_envs,
        env.sim.model,
        env.sim.expanded_fields,
        view=resolve_camera(cfg, model, env.scene.entities),
        geom_group=cfg.geom_group,
        site_group=cfg.site_group,
    )
    # Reading a field makes the engine provide it.
    for name in ("xpos", "xmat", *(("mocap_pos", "mocap_quat") if model.nmocap > 0 else ())):
        getattr(env.sim.data, name)
    managers = env.manager_visualizers.items()
    hidden = [part for manager, part in managers if manager != "command_manager"]
    for part in (*hidden, env.sensor_visualizers):
        for name, _ in part.get_visualizable_terms():
            part.set_debug_vis(name, False)
    return scene


def geom_group_meanings(model: mujoco.MjModel) -> dict[int, str]:
    """Return the meaning of each geom group in use: terrain, collision, visual, or both."""
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    bodies = [model.body(int(body)).name for body in model.geom_bodyid]
    is_ground = np.array([name in ("world", "terrain") for name in bodies], dtype=bool)
    meanings: dict[int, str] = {}
    for group in _groups_in_use(model.geom_group):
        geoms = model.geom_group == group
        parts = {
            "Terrain": (geoms & is_ground).any(),
            "Collision": (geoms & ~is_ground & collides).any(),
            "Visual": (geoms & ~is_ground & ~collides).any(),
        }
        meanings[group] = " and ".join(name for name, found in parts.items() if found).capitalize()
    return meanings


def _groups_in_use(groups: np.ndarray) -> list[int]:
    """Return the groups in use that MuJoCo can hide; models may use others."""
    return sorted({int(group) for group in groups} & set(range(mujoco.mjNGROUP)))


class GeomVariants:
    """Per-environment shapes of randomized geoms, in place of mjviser's shared shape.

    Environments and bodies with equal appearance share a batch. Changed fields resend the shapes,
    at most once per second: randomization at resets changes them often.
    """

    def __init__(self, scene: ViserMujocoScene, sim_model: Any, expanded_fields: set[str]):
        """Prepare to draw the per-environment `expanded_fields` of `sim_model`."""
        self._scene = scene
        self._sim_model = sim_model
        self._fields = _SHAPE_FIELDS & expanded_fields
        # Model that mjviser drew. The scene's model is overwritten for the selected environment.
        self._base = copy.copy(scene.mj_model)
        self._shapes: dict[Any, _Shape] = {}
        self._taken_over: set[tuple[int, int]] = set()
        self._seen: dict[str, np.ndarray] = {}
        self._next_check = 0.0
        self.is_plain = False

    def update(
        self, body_xpos: np.ndarray, body_xmat: np.ndarray, env_idx: int, offset: np.ndarray
    ) -> None:
        """Move the shapes to poses (num_envs, nbody, ...); rebuild them if the fields changed."""
        now = time.perf_counter()
        if now >= self._next_check:
            self._next_check = now + _CHECK_PERIOD_S
            self._rebuild_if_changed()
        if not self._shapes:
            return
        quats = vtf.SO3.from_matrix(body_xmat).wxyz
        for shape in self._shapes.values():
            envs, bodies = np.array(shape.envs), np.array(shape.bodies)
            only_selected = self._scene.show_only_selected
            chosen = envs == env_idx if only_selected else envs < len(body_xpos)
            envs, bodies = envs[chosen], bodies[chosen]
            shape.handle.visible = self._scene.geom_groups_visible[shape.group] and len(envs) > 0
            if shape.handle.visible:
                shape.handle.batched_positions = body_xpos[envs, bodies] + offset
                shape.handle.batched_wxyzs = quats[envs, bodies]

    def _rebuild_if_changed(self) -> None:
        values = {name: to_numpy(getattr(self._sim_model, name)) for name in sorted(self._fields)}
        if all(np.array_equal(values[name], self._seen.get(name, ())) for name in values):
            return
        self._seen = {name: value.copy() for name, value in values.items()}
        for shape in self._shapes.values():
            shape.handle.remove()
        self._shapes = {}
        # Remove mjviser's batches with a varying geom: their bodies are drawn here instead.
        model, varying = self._base, _varying_geoms(self._base, values)
        for batch in list(self._scene._mesh_groups):
            geoms = np.isin(model.geom_bodyid, batch.body_ids)
            if (varying & geoms & (model.geom_group == batch.group_id)).any():
                batch.handle.remove()
                # `list.remove` fails: batches hold arrays, and == on arrays is elementwise.
                groups = self._scene._mesh_groups
                groups[:] = [other for other in groups if other is not batch]
                self._taken_over |= {(int(body), batch.group_id) for body in batch.body_ids}
        if self._taken_over:
            self._build()

    def _build(self) -> None:
        model = copy.copy(self._base)
        exceeded = False
        for env_idx in range(self._scene.num_envs):
            sync_model_fields(model, self._sim_model, self._fields, env_idx)
            for body, group in sorted(self._taken_over):
                drawn = (model.geom_bodyid == body) & (model.geom_group == group)
                drawn &= model.geom_rgba[:, 3] > 0
                # Textures prevent merging of some geoms.
                parts = group_geoms_by_visual_compat(model, np.flatnonzero(drawn).tolist())
                for part, geom_ids in enumerate(parts):
                    appearance = self._scene._geom_subgroup_fingerprint(model, geom_ids, False)
                    key: Any = (appearance, group)
                    source = model
                    if key not in self._shapes and len(self._shapes) >= _MAX_SHAPES:
                        # Beyond the limit, bodies keep the appearance of the model file.
                        exceeded, key, source = True, (body, group, part), self._base
                    if key not in self._shapes:
                        handle = self._scene.server.scene.add_batched_meshes_trimesh(
                            f"/variants/{len(self._shapes)}",
                            merge_geoms(source, geom_ids),
                            batched_wxyzs=np.array([[1.0, 0.0, 0.0, 0.0]]),
                            batched_positions=np.zeros((1, 3)),
                            lod="off",
                            visible=False,
                        )
                        if self.is_plain:
                            handle.glb_data = without_metal(handle.glb_data)
                        self._shapes[key] = _Shape(handle, group)
                    self._shapes[key].envs.append(env_idx)
                    self._shapes[key].bodies.append(body)
        if exceeded:
            log.warning("More than %d distinct shapes; others use the model's shape.", _MAX_SHAPES)


@dataclass
class _Shape:
    """Batched mesh, and the environments and bodies that use it."""

    handle: viser.BatchedGlbHandle
    group: int
    envs: list[int] = field(default_factory=list)
    bodies: list[int] = field(default_factory=list)


def _varying_geoms(model: mujoco.MjModel, values: dict[str, np.ndarray]) -> np.ndarray:
    """Return the mask of geoms that differ from `model` in some environment, (ngeom,)."""
    varying = np.zeros(model.ngeom, dtype=bool)
    for name, value in values.items():
        base = np.asarray(getattr(model, name)).reshape(value.shape[1:])
        close = np.isclose(value, base[None]).reshape(*value.shape[:2], -1)
        equal = np.asarray(close.all(axis=(0, 2)))
        if name == "mat_rgba":
            has_material = model.geom_matid >= 0
            varying |= has_material & ~equal[np.maximum(model.geom_matid, 0)]
        else:
            varying |= ~equal
    return varying
