"""Scene of the browser viewer, without the viewer."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
import viser
from viewer_fakes import FakeEnv

from mjlab import compat
from mjlab.viewer.debug_visualizer import DebugVisualizer
from mjlab.viewer.viser import MjlabViserScene, ViserMujocoScene
from mjlab.viewer.viser.scene import geom_group_meanings

RED = (1.0, 0.0, 0.0, 0.5)


@pytest.fixture
def env() -> FakeEnv:
    env = FakeEnv(2)
    env.sim.datas[1].qpos[0] = 0.5
    env.sim.forward()
    return env


def make(server: viser.ViserServer, env: FakeEnv) -> MjlabViserScene:
    return MjlabViserScene(server, env.sim.mj_model, 2, env.sim.model, env.sim.expanded_fields)


def control(server: viser.ViserServer, label: str):
    handles = server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if handle.label == label)


def test_drawings_stay_until_they_are_cleared(viser_server, env) -> None:
    scene = make(viser_server, env)
    assert isinstance(scene, DebugVisualizer)
    assert scene.meansize == env.sim.mj_model.stat.meansize
    scene.add_arrow(np.zeros(3), np.ones(3), RED)
    scene.add_sphere(np.zeros(3), 0.1, RED)
    assert not scene._debug_handles
    for _ in range(2):
        scene.update(env.sim.data)
        scene.add_arrow(np.zeros(3), -np.ones(3), RED)
    scene.refresh_visualization()
    shown = scene._debug_handles
    assert [len(shown[key].batched_positions) for key in ("shaft", "head", "sphere")] == [3, 3, 1]
    scene.clear()
    scene.refresh_visualization()
    assert not any(handle.visible for handle in shown.values())


def test_all_drawings_can_be_removed_at_once_or_switched_off(viser_server, env) -> None:
    scene = make(viser_server, env)
    scene.add_box(np.zeros(3), np.ones(3), np.eye(3), RED)
    scene.update(env.sim.data)
    handle = scene._debug_handles["box"]
    scene.clear_debug_all()
    with pytest.raises(RuntimeError, match="removed"):
        handle.visible = True
    scene.add_box(np.zeros(3), np.ones(3), np.eye(3), RED)
    scene.debug_visualization_enabled = False
    scene.update(env.sim.data)
    assert not scene._debug_handles


def test_tensors_are_drawn_like_arrays(viser_server, env) -> None:
    scene = make(viser_server, env)
    arguments = {
        "add_arrow": (np.zeros(3), np.ones(3), RED),
        "add_sphere": (np.ones(3), 0.1, RED),
        "add_cylinder": (np.zeros(3), np.ones(3), 0.1, RED),
        "add_ellipsoid": (np.ones(3), np.ones(3), np.eye(3), RED),
        "add_box": (np.ones(3), np.ones(3), np.eye(3), RED),
        "add_frame": (np.ones(3), np.eye(3)),
        "add_ghost_mesh": (np.array([0.5, 0.1]), env.sim.mj_model),
    }
    seen = []
    for convert in (lambda x: x, lambda x: torch.tensor(x, requires_grad=True)):
        scene.clear()
        for method, values in arguments.items():
            arrays = (convert(x) if isinstance(x, np.ndarray) else x for x in values)
            getattr(scene, method)(*arrays)
        scene.update(env.sim.data)
        handles = scene._debug_handles.items()
        seen.append({key: np.array(handle.batched_positions) for key, handle in handles})
    assert seen[0].keys() == seen[1].keys()
    for key, positions in seen[0].items():
        np.testing.assert_allclose(seen[1][key], positions, atol=1e-6)


def test_it_follows_the_first_moving_body_of_the_environment_in_view(viser_server, env) -> None:
    scene = make(viser_server, env)
    scene.update(env.sim.data, env_idx=1)
    np.testing.assert_allclose(scene.offset, [-0.5, 0.0, -1.0])
    scene.env_idx = 0
    scene.update(env.sim.data)
    np.testing.assert_allclose(scene.offset, [0.0, 0.0, -1.0])


def test_state_comes_alike_from_a_simulation_arrays_and_a_plain_mjdata(viser_server, env) -> None:
    data = env.sim.data
    scene = make(viser_server, env)
    scene.show_contact_points = True
    xmat = data.xmat.numpy().reshape(2, -1, 3, 3)
    arrays = {name: getattr(data, name).numpy() for name in ("qpos", "qvel", "ctrl")}
    updates = (
        lambda: scene.update(env.sim),
        lambda: scene.update(data),
        lambda: scene.update_from_arrays(data.xpos.numpy(), xmat, **arrays),
        lambda: scene.update_from_mjdata(env.sim.datas[0]),
    )
    for update in updates:
        update()
        np.testing.assert_allclose(scene.offset, [0.0, 0.0, -1.0])
        np.testing.assert_allclose(scene._last_mj_data.xpos, env.sim.datas[0].xpos, atol=1e-6)


def test_overlays_use_the_values_of_the_environment_in_view(viser_server, env) -> None:
    mass = torch.ones(2, env.sim.mj_model.nbody)
    mass[1] = 7.0
    env.sim.expand("body_mass", mass)
    scene = make(viser_server, env)
    scene.show_inertia = True
    scene.update(env.sim, env_idx=1)
    np.testing.assert_allclose(scene.mj_model.body_mass, 7.0)
    assert not (env.sim.mj_model.body_mass == 7.0).any(), "the scene has a model to itself"


def test_controls_show_another_environment_at_once(viser_server, env) -> None:
    scene = make(viser_server, env)
    more = []
    scene.create_scene_gui(debug_viz_extra_gui=lambda: more.append(1))
    assert more
    scene.update(env.sim.data)
    control(viser_server, "Select").value = 1
    np.testing.assert_allclose(scene.offset, [-0.5, 0.0, -1.0])
    scene.add_sphere(np.zeros(3), 0.1, RED)
    scene.refresh_visualization()
    control(viser_server, "Enabled").value = False
    assert not scene._debug_handles["sphere"].visible
    control(viser_server, "All envs").value = True
    assert list(scene.get_env_indices(2)) == [0, 1]
    control(viser_server, "Hide others").value = True
    assert list(scene.get_env_indices(2)) == [1]


def test_the_camera_is_placed_by_the_scenes_controls(viser_server, env) -> None:
    scene = make(viser_server, env)
    scene.create_scene_gui(camera_distance=2.0, camera_azimuth=0.0, camera_elevation=30.0)
    camera = viser_server.initial_camera
    np.testing.assert_allclose(camera.position, [-np.sqrt(3.0), 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(camera.look_at, 0.0)


class TestReleases11And12:
    """Former interface: `ViserMujocoScene` with a factory, and module `conversions`."""

    @pytest.fixture(autouse=True)
    def _forget_warnings(self) -> None:
        compat._warn_once.cache_clear()

    def test_a_scene_is_created_and_given_its_controls(self, viser_server, env) -> None:
        scene = ViserMujocoScene.create(viser_server, env.sim.mj_model, num_envs=2)
        assert isinstance(scene, ViserMujocoScene)
        scene.create_visualization_gui(camera_distance=1.5, show_debug_viz_control=False)
        tabs = viser_server.gui.add_tab_group()
        scene.create_groups_gui(tabs)
        assert tabs._tab_labels == ("Groups",)
        scene.update_from_mjdata(env.sim.datas[0])
        np.testing.assert_allclose(scene.fixed_bodies_frame.position, [0.0, 0.0, -1.0])

    def test_geoms_are_merged_in_the_world_frame(self, env) -> None:
        from mjlab.viewer.viser.conversions import merge_geoms_global

        model, data = env.sim.mj_model, env.sim.datas[1]
        cart, pole = (model.geom(f"cartpole/{name}").id for name in ("cart", "pole"))
        mesh = merge_geoms_global(model, data, [cart, pole])
        np.testing.assert_allclose(mesh.bounds, [[0.3, -0.15, 0.9], [0.7, 0.15, 2.045]], atol=1e-3)

    def test_meshes_are_converted_with_the_arguments_of_then(self) -> None:
        from mjlab.viewer.viser.conversions import (
            is_fixed_body,
            mujoco_mesh_to_trimesh,
            rotation_quat_from_vectors,
        )

        spec = mujoco.MjSpec()
        spec.add_mesh(name="tetrahedron", uservert=[0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1])
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="tetrahedron")
        geom.name = "it"
        model = spec.compile()
        mesh = mujoco_mesh_to_trimesh(model, 0, verbose=True)
        assert mesh.volume == pytest.approx(1.0 / 6.0, rel=1e-4)
        with pytest.warns(FutureWarning, match="deprecated"):
            assert is_fixed_body(model, 0)
            assert rotation_quat_from_vectors((0, 0, 1), (0, 0, 1)).tolist() == [1, 0, 0, 0]


def test_groups_are_named_by_their_geoms(viser_server) -> None:
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <geom type="plane" size="1 1 .1"/>
      <body><freejoint/>
        <geom size=".1" group="1"/>
        <geom size=".1" group="2" contype="0" conaffinity="0"/>
        <geom size=".1" group="3"/>
        <geom size=".1" group="3" contype="0" conaffinity="0"/>
        <geom size=".1" group="7"/>
        <site group="2"/>
        <site group="6"/>
        <site group="-1"/>
      </body>
    </worldbody></mujoco>""")
    assert geom_group_meanings(model) == {
        0: "Terrain", 1: "Collision", 2: "Visual", 3: "Collision and visual",
    }  # fmt: skip
    scene = MjlabViserScene(viser_server, model, 1)
    scene.create_groups_gui()
    boxes = {
        handle.label: handle
        for handle in viser_server.gui._gui_input_handle_from_uuid.values()
        if hasattr(handle, "label")
    }
    assert "Visual (group 2)" in boxes
    assert {label for label in boxes if label.startswith("Group ")} == {"Group 2"}
