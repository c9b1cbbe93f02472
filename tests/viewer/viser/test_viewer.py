"""Browser viewer, without a browser."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import torch
from viewer_fakes import FakeEnv, push

from mjlab.viewer import ViewerConfig, ViserPlayViewer
from mjlab.viewer.base import ViewerStatus
from mjlab.viewer.viewer_config import OriginType
from mjlab.viewer.viser.scene import MjlabViserScene
from mjlab.viewer.viser.viewer import (
    CheckpointManager,
    UpdateReason,
    local_checkpoints,
    status_html,
)

FOLLOW = {"origin_type": OriginType.ASSET_ROOT, "entity_name": "cartpole"}


def make(server, num_envs: int = 2, manager=None, **fields) -> ViserPlayViewer:
    env = FakeEnv(num_envs, ViewerConfig(**{**FOLLOW, **fields}))
    viewer = ViserPlayViewer(env, push(), viser_server=server, checkpoint_manager=manager)
    viewer.setup()
    return viewer


def rewards_of(viewer: ViserPlayViewer) -> np.ndarray:
    return viewer._term_overlays.reward_plotter.history.values("upright")


def show(viewer: ViserPlayViewer) -> None:
    viewer._next_scene = viewer._next_panels = viewer._term_overlays._next_refresh = 0.0
    viewer.sync_env_to_viewer()


def test_the_page_is_served_to_this_machine_only_and_run_ends_by_itself() -> None:
    viewer = ViserPlayViewer(FakeEnv(1), push(), port=18099)
    assert viewer.server.get_host() == "127.0.0.1"
    assert viewer.url.startswith("http://localhost:18")
    viewer.run(num_steps=3)
    assert viewer.env.num_steps == 3
    assert not viewer.is_running()


def test_serving_the_network_is_possible_and_warned_about(caplog, capsys) -> None:
    with caplog.at_level(logging.WARNING):
        viewer = ViserPlayViewer(FakeEnv(1), push(), host="0.0.0.0", port=18099)
    assert viewer.server.get_host() == "0.0.0.0"
    assert "can control it" in caplog.text
    # Commands print the address.
    assert capsys.readouterr().out == ""
    viewer.close()


def test_a_camera_that_looks_down_starts_above_what_it_follows(viser_server) -> None:
    make(viser_server, elevation=-45.0, azimuth=90.0, distance=2.0, fovy=33.0)
    camera = viser_server.initial_camera
    # The scene moves so that the followed body is at the origin.
    np.testing.assert_allclose(camera.look_at, 0.0)
    np.testing.assert_allclose(camera.position, [0, -np.sqrt(2), np.sqrt(2)], atol=1e-9)
    assert camera.fov == pytest.approx(np.deg2rad(33.0))


def test_a_fixed_camera_looks_at_its_point_and_does_not_move_the_scene(viser_server) -> None:
    viewer = make(viser_server, origin_type=OriginType.WORLD, lookat=(1.0, 2.0, 0.5))
    np.testing.assert_allclose(viser_server.initial_camera.look_at, [1, 2, 0.5])
    show(viewer)
    np.testing.assert_allclose(viewer.scene.fixed_bodies_frame.position, 0.0)


def test_following_moves_the_scene_so_that_the_body_is_in_the_middle(viser_server) -> None:
    viewer = make(viser_server)
    viewer.env.sim.datas[1].qpos[0] = 1.25
    viewer.env.sim.forward()
    viewer.scene.env_idx = 1
    show(viewer)
    np.testing.assert_allclose(viewer.scene.fixed_bodies_frame.position, [-1.25, 0, -1])


def test_environment_number_and_groups_come_from_the_config(viser_server) -> None:
    viewer = make(viser_server, env_idx=7, geom_group=(1, 0, 0, 1, 0, 0))
    assert viewer.scene.env_idx == 1
    assert viewer.scene.geom_groups_visible == [True, False, False, True, False, False]


def commands(server) -> dict:
    """Return the commands of a page by hotkey."""
    handles = server.gui._command_handle_from_uuid.values()
    return {handle.hotkey: handle for handle in handles}


def press(server, *hotkeys: str) -> None:
    for hotkey in hotkeys:
        for callback in commands(server)[hotkey]._impl.trigger_cb:
            callback(None)


def test_keys_steer_the_environment_in_view(viser_server) -> None:
    viewer = make(viser_server)
    press(viser_server, "7", "arrowup", "pagedown", "6", "end")
    viewer._process_actions()
    steered = viewer.env.command_manager.steered
    assert steered == [(1, (0.1, 0.0, 0.0)), (1, (0.0, -0.1, 0.0)), (0, None)]


def test_keys_control_the_simulation(viser_server) -> None:
    viewer = make(viser_server)
    press(viser_server, "space", "home", "arrowright", "9")
    viewer._process_actions()
    status = viewer.get_status()
    assert (status.paused, status.speed_multiplier, status.step_count) == (True, 2.0, 1)
    assert not viewer.scene.debug_visualization_enabled
    press(viser_server, "insert", "enter", "9", "backspace")
    viewer._process_actions()
    status = viewer.get_status()
    assert (status.speed_multiplier, status.step_count) == (1.0, 0)
    assert viewer.scene.debug_visualization_enabled
    assert viewer.scene.show_all_envs


def test_a_gamepad_steers_through_the_proxy() -> None:
    viewer = ViserPlayViewer(FakeEnv(2), push(), port=18099)
    try:
        assert viewer.server.on_gamepad is None
        viewer.setup()
        url = f"http://127.0.0.1:{viewer.server.get_port()}/gamepad"
        with urlopen(f"{url}?forward=0.5&left=0&turn=-1") as answer:
            assert answer.status == 200
        viewer._process_actions()
        assert viewer.env.command_manager.steered == [("sticks", 0, (0.5, 0.0, -1.0))]
    finally:
        viewer.close()


def test_a_task_without_steering_has_no_keys_for_it(viser_server, monkeypatch) -> None:
    monkeypatch.setattr("viewer_fakes.FakeTerms.steerable", False)
    make(viser_server)
    assert "space" in commands(viser_server)
    assert "arrowup" not in commands(viser_server)


def test_hotkeys_are_those_of_viser() -> None:
    from typing import get_args

    from viser._messages import HotkeyKey

    from mjlab.viewer.native.keys import BINDINGS

    used = [binding.hotkey for binding in BINDINGS if binding.hotkey is not None]
    assert set(used) <= set(get_args(HotkeyKey))
    assert len(used) == len(set(used))


def test_plots_get_one_point_a_step(
    viser_server,
) -> None:
    viewer = make(viser_server)
    for _ in range(3):
        viewer.step_simulation()
        show(viewer)
        show(viewer)
    assert rewards_of(viewer).tolist() == [0.5, 0.5, 0.5]
    assert viewer._term_overlays.metrics_plotter.history.values("height").tolist() == [
        1.0,
        1.0,
        1.0,
    ]


def test_histories_start_anew_at_a_reset_and_for_another_environment(viser_server) -> None:
    viewer = make(viser_server)
    viewer.step_simulation()
    viewer.scene.env_idx = 1
    viewer.step_simulation()
    assert rewards_of(viewer).tolist() == [1.0]
    viewer.reset_environment()
    assert rewards_of(viewer).tolist() == []


def test_what_is_drawn_is_a_copy_taken_between_steps(viser_server) -> None:
    viewer = make(viser_server)
    rows = viewer.env.sim.data

    class Live:
        """Fields that the simulation keeps writing."""

        data = rows
        copy_to_host = None

    viewer.scene.update(Live)
    before = viewer.scene._last_body_xpos.copy()
    rows.xpos += 100.0
    np.testing.assert_array_equal(viewer.scene._last_body_xpos, before)


def test_each_sensor_that_draws_has_a_switch(viser_server) -> None:
    viewer = make(viser_server)
    show(viewer)
    hits = next(box for box in checkboxes(viser_server) if box.label == "hits")
    assert not hits.value
    assert not any(box.label == "silent" for box in checkboxes(viser_server))
    spheres = viewer.scene._debug_handles["sphere"]
    assert len(spheres.batched_positions) == 1
    hits.value = True
    assert viewer._update_reasons == {UpdateReason.SCENE_REQUEST}
    show(viewer)
    assert len(spheres.batched_positions) == 2


def checkboxes(server) -> list:
    handles = server.gui._gui_input_handle_from_uuid.values()
    return [handle for handle in handles if type(handle).__name__ == "GuiCheckboxHandle"]


def test_commands_hear_of_pauses_and_gui_resets(viser_server) -> None:
    viewer = make(viser_server)
    viewer.scene.env_idx = 1
    viewer.toggle_pause()
    viewer.toggle_pause()
    viewer.request_action("custom", {"type": "gui_reset", "all_envs": False})
    viewer.request_action("start_here", {"type": "gui_reset"})
    viewer._process_actions()
    commands = viewer.env.command_manager
    assert commands.paused == [True, False]
    assert commands.gui_resets == [[1], [0, 1]]
    assert viewer.env.num_resets == 2


def test_an_error_is_shown_on_the_page_without_markup_from_it(viser_server) -> None:
    viewer = make(viser_server)
    viewer.env.step = lambda actions: (_ for _ in ()).throw(ValueError("<b>bad</b>"))
    viewer.step_simulation()
    show(viewer)
    content = viewer._controls._status.content
    assert "&lt;b&gt;bad" in content
    assert "Paused" in content
    assert viewer._controls._pause.label == "Play"


def test_the_status_says_when_the_machine_is_too_slow() -> None:
    status = ViewerStatus(False, 1234, 2.0, "2x", 2.0, 0.7, 59.6, True, None)
    content = status_html(status)
    for text in ("CAPPED", "1,234", "0.70x of 2x (60 FPS)"):
        assert text in content


class TestCheckpoints:
    """Selection of another policy while the viewer runs."""

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        for number in (0, 1000, 50):
            (tmp_path / f"model_{number}.pt").touch()
        (tmp_path / "notes.txt").touch()
        return tmp_path

    def test_files_are_sorted_by_number_and_labelled_with_their_age(self, folder) -> None:
        os.utime(folder / "model_50.pt", (time.time() - 300, time.time() - 300))
        # Replay buffer of an off-policy run.
        (folder / "replay_model_1000.pt").touch()
        source = local_checkpoints(folder, lambda path: push())
        listed = source.fetch_available()
        assert [name for name, _ in listed] == ["model_0.pt", "model_50.pt", "model_1000.pt"]
        assert listed[1][1] == "5m ago"

    def test_choosing_loads_the_policy_resets_and_clears_the_plots(
        self, viser_server, folder
    ) -> None:
        loaded = []
        other = push(-1.0)

        def load(path: Path):
            loaded.append(path.name)
            return other

        viewer = make(viser_server, manager=local_checkpoints(folder, load, "model_1000.pt"))
        viewer.step_simulation()
        panel = viewer._checkpoint_panel
        panel._choice.value = next(x for x in panel._choice.options if "model_50" in x)
        viewer._process_actions()
        assert loaded == ["model_50.pt"]
        assert viewer.policy is other
        assert viewer.env.num_resets == 1
        assert len(rewards_of(viewer)) == 0
        assert "Loaded model_50.pt" in panel._message.content

    def test_a_custom_manager_names_run_and_latest(self, viser_server) -> None:
        loaded = []
        manager = CheckpointManager(
            current_name="model_50.pt",
            fetch_available=lambda: [("model_50.pt", "2h ago"), ("model_100.pt", "5m ago")],
            load_checkpoint=lambda name: loaded.append(name) or push(),
            run_name="a run",
            run_url="https://example.com/run",
            run_status="finished",
        )
        viewer = make(viser_server, manager=manager)
        panel = viewer._checkpoint_panel
        assert panel._choice.value == "model_50.pt (2h ago)"
        assert "[a run](https://example.com/run) (finished)" in panel._about.content
        panel.load_latest()
        viewer._process_actions()
        assert loaded == ["model_100.pt"]
        assert manager.current_name == "model_100.pt"

    def test_names_of_a_tracker_are_text(self, viser_server) -> None:
        tag = "<img src=x onerror=y>`]()\udcff"
        manager = CheckpointManager(
            current_name=tag, fetch_available=lambda: [(tag, tag)],
            load_checkpoint=lambda name: (_ for _ in ()).throw(ValueError(name)),
            run_name=tag, run_status=tag,
        )  # fmt: skip
        for manager.run_url in (None, f"https://example.com/{tag}"):
            panel = make(viser_server, manager=manager)._checkpoint_panel
            panel.load(tag)
            assert not set(panel._about.content) & set("<>`")
            assert panel._about.content.count("]") == (manager.run_url is not None)
            assert "<img" not in panel._message.content
            # Sent as UTF-8.
            assert panel._choice.value.encode()

    @pytest.mark.parametrize(
        "url", ["javascript:alert(1)", "data:text/html,x", "//example.com", ""]
    )
    def test_only_web_addresses_become_links(self, viser_server, url) -> None:
        manager = CheckpointManager("a", lambda: [("a", "")], lambda name: push(), "run", url)
        content = make(viser_server, manager=manager)._checkpoint_panel._about.content
        assert content == "**Run:** run"

    def test_use_latest_looks_for_new_files(self, viser_server, folder) -> None:
        loaded = []
        source = local_checkpoints(folder, lambda path: loaded.append(path.name) or push())
        viewer = make(viser_server, manager=source)
        (folder / "model_2000.pt").touch()
        viewer._checkpoint_panel.load_latest()
        viewer._process_actions()
        assert loaded == ["model_2000.pt"]

    def test_errors_of_checkpoints_keep_the_policy(self, viser_server, folder) -> None:
        source = local_checkpoints(folder, lambda path: (_ for _ in ()).throw(OSError("truncated")))
        viewer = make(viser_server, manager=source)
        before = viewer.policy
        viewer.request_action("fetch_checkpoint", "model_50.pt")
        viewer._process_actions()
        panel = viewer._checkpoint_panel
        assert viewer.policy is before
        assert not viewer.get_status().paused
        assert "Cannot load model_50.pt: truncated" in panel._message.content
        source.fetch_available = lambda: 1 / 0
        panel.refresh()
        assert "Cannot list checkpoints" in panel._message.content


def test_shapes_differ_between_environments(
    viser_server,
) -> None:
    env = FakeEnv(3)
    model = env.sim.mj_model
    cart = model.geom("cartpole/cart").id
    size = torch.as_tensor(model.geom_size).float().expand(3, -1, -1).clone()
    size[2, cart] = torch.tensor([0.4, 0.3, 0.2])
    env.sim.expand("geom_size", size)
    scene = MjlabViserScene(viser_server, model, 3, env.sim.model, env.sim.expanded_fields)
    scene.camera_tracking_enabled = False
    batches = len(scene._mesh_groups)
    scene.update(env.sim)
    shapes = list(scene._variants._shapes.values())
    assert [(shape.envs, len(shape.bodies)) for shape in shapes] == [([0, 1], 2), ([2], 1)]
    assert len(scene._mesh_groups) == batches - 1  # mjviser still draws the pole.
    np.testing.assert_allclose(shapes[1].handle.batched_positions, [[0, 0, 1]])
    # Equal again: one shape for all.
    size[2, cart] = size[0, cart]
    scene._variants._next_check = 0.0
    scene.update(env.sim)
    assert [shape.envs for shape in scene._variants._shapes.values()] == [[0, 1, 2]]


def test_switching_the_environment_removes_the_drawings_of_the_old_one(viser_server) -> None:
    viewer = make(viser_server)
    show(viewer)
    viewer.env.update_visualizers = lambda visualizer: None
    select = next(
        handle
        for handle in viser_server.gui._gui_input_handle_from_uuid.values()
        if handle.label == "Select" and type(handle).__name__ == "GuiSliderHandle"
    )
    assert viewer.scene._debug_handles
    select.value = 1
    assert viewer._update_reasons == {UpdateReason.SCENE_REQUEST}
    show(viewer)
    assert viewer.scene.env_idx == 1
    assert not viewer.scene._debug_handles
    assert "environment 1" in viewer._term_overlays.reward_plotter._label.content
