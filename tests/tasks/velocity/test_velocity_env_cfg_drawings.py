"""Debug visualization of the velocity tasks."""

from __future__ import annotations

import pytest

from mjlab.envs import ManagerBasedRlEnv
from mjlab.sensor import ContactSensorCfg, RayCastSensorCfg
from mjlab.tasks.registry import load_env_cfg
from mjlab.viewer.debug_visualizer import NullDebugVisualizer


class Board(NullDebugVisualizer):
    """Visualizer that counts drawn shapes by type and color."""

    def __init__(self) -> None:
        super().__init__()
        self.spheres: list[tuple] = []

    def add_sphere(self, center, radius, color, label=None) -> None:
        self.spheres.append(color)


@pytest.fixture(scope="module")
def env():
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1", play=True)
    for sensor in cfg.scene.sensors:
        if isinstance(sensor, ContactSensorCfg):
            sensor.debug = True
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    yield env
    env.close()


def test_sensors_that_draw_have_a_switch_each_and_all_are_on(env) -> None:
    names = [name for name, _ in env.sensor_visualizers.get_visualizable_terms()]
    assert names == [
        sensor.name
        for sensor in env.cfg.scene.sensors
        if (isinstance(sensor, RayCastSensorCfg) and sensor.debug_vis)
        or isinstance(sensor, ContactSensorCfg)
    ]
    assert {"foot_height_scan", "feet_ground_contact"} <= set(names)


def test_switching_a_sensor_off_hides_what_it_draws_and_nothing_else(env) -> None:
    rays = next(
        s.viz.hit_sphere_color for s in env.cfg.scene.sensors if s.name == "foot_height_scan"
    )
    board, without = Board(), Board()
    env.update_visualizers(board)
    # A ray at the center of each foot, and four around it.
    assert board.spheres.count(rays) == 4 * 5
    env.sensor_visualizers.set_debug_vis("foot_height_scan", False)
    env.update_visualizers(without)
    env.sensor_visualizers.set_debug_vis("foot_height_scan", True)
    assert without.spheres == [color for color in board.spheres if color != rays]


def test_a_sensor_that_does_not_draw_is_named_among_those_that_do(env) -> None:
    with pytest.raises(ValueError, match=r"'imu'.*foot_height_scan"):
        env.sensor_visualizers.set_debug_vis("imu", False)
