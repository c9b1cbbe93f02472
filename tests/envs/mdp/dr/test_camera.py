"""Randomization of cameras."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

CAMERAS_XML = """
<mujoco><worldbody><body name="head"><joint name="neck"/><geom size=".1"/>
  <camera name="plain" fovy="60"/>
  <camera name="map" fovy="2" projection="orthographic"/>
  <camera name="lens" focal=".01 .01" sensorsize=".02 .02" resolution="8 8"/>
</body></worldbody></mujoco>
"""


@pytest.mark.parametrize(
    "params",
    [
        {"ranges": (40.0, 50.0)},
        {"ranges": (40.0, 50.0), "asset_cfg": SceneEntityCfg("robot", camera_names=("lens",))},
        {"ranges": {"plain": (40.0, 50.0), "le.*": (50.0, 60.0)}},
    ],
    ids=["all", "selected", "by pattern"],
)
def test_cam_fovy_warns_of_cameras_without_it(make_world: Any, params: dict[str, Any]) -> None:
    world = make_world(CAMERAS_XML)
    term = EventTermCfg(func=dr.cam_fovy, mode="startup", params=params)
    manager = world.events(zoom=term)
    with pytest.warns(UserWarning, match=r"\['lens'\].*dr\.cam_intrinsic"):
        manager.apply("startup")
    assert bool((world.sim.model.cam_fovy >= 40.0).any())


def test_cam_fovy_is_for_cameras_that_read_it(make_world: Any) -> None:
    world = make_world(CAMERAS_XML)
    chosen = SceneEntityCfg("robot", camera_names=("plain", "map"))
    params = {"ranges": (40.0, 50.0), "asset_cfg": chosen}
    manager = world.events(zoom=EventTermCfg(func=dr.cam_fovy, mode="startup", params=params))
    manager.apply("startup")
    fovy = world.sim.model.cam_fovy
    assert bool(((fovy[:, :2] >= 40.0) & (fovy[:, :2] <= 50.0)).all())
    assert torch.equal(fovy[:, 2], world.sim.get_default_field("cam_fovy")[2].expand(4))
