"""Names of earlier releases."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mjlab import compat
from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.compat import older
from mjlab.envs import mdp
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")


def test_randomize_field_becomes_the_function_of_its_field(make_world: Any) -> None:
    world = make_world()
    event = EventTermCfg(
        func=mdp.randomize_field,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names=("foot",)),
            "field": "body_ipos",
            "ranges": {0: (0.1, 0.1)},
            "operation": "add",
        },
    )
    compat.translate_older(SimpleNamespace(observations={}, rewards={}, events={"com": event}))
    manager = world.events(com=event)
    assert {"body_ipos", "dof_invweight0"} <= set(manager.domain_randomization_fields)
    before = world.sim.model.dof_invweight0.clone()
    manager.apply("startup")
    assert bool((world.sim.model.body_ipos[:, 4, 0] == 0.1).all())
    assert not torch.equal(world.sim.model.dof_invweight0, before)


def test_randomize_field_can_be_called_directly(make_world: Any) -> None:
    world = make_world()
    mdp.randomize_field(world, None, "dof_damping", (0.4, 0.4), asset_cfg=SceneEntityCfg("robot"))
    assert bool((world.sim.model.dof_damping[:, 6:] == 0.4).all())
    with pytest.raises(ValueError, match="unknown field 'nonsense'.*geom_friction"):
        mdp.randomize_field(world, None, "nonsense", (0.0, 1.0))


def test_quaternions_were_randomized_by_component(make_world: Any) -> None:
    world = make_world()
    mdp.randomize_field(world, None, "geom_quat", {1: (0.2, 0.2)}, operation="add")
    default = world.sim.get_default_field("geom_quat")
    change = world.sim.model.geom_quat - default
    torch.testing.assert_close(change[0, :, 1], torch.full((6,), 0.2))
    assert bool((change[..., [0, 2, 3]] == 0.0).all())


@pytest.mark.parametrize("name", ["FieldSpec", "requires_model_fields", "sample_gaussian"])
def test_other_older_names_resolve(name: str) -> None:
    assert callable(getattr(mdp, name))
    assert callable(getattr(mdp.events, name))


def test_one_lag_for_all_delayed_actuators_of_an_environment(make_world: Any) -> None:
    delay: Any = {"stiffness": 10.0, "damping": 1.0, "delay_max_lag": 5, "delay_hold_prob": 1.0}
    world = make_world(
        num_envs=64,
        actuators=(
            BuiltinPositionActuatorCfg(target_names_expr=("hip",), **delay),
            BuiltinPositionActuatorCfg(target_names_expr=("knee",), delay_update_period=3, **delay),
            BuiltinPositionActuatorCfg(target_names_expr=("ankle",), stiffness=1.0, damping=1.0),
        ),
    )
    older.sync_actuator_delays(world, torch.arange(1, 64), (2, 4))
    lags = [a._delay_buffer.current_lags for a in world.robot.actuators[:2]]
    assert torch.equal(lags[0][1:], lags[1][1:])
    assert sorted(lags[0][1:].unique().tolist()) == [2, 3, 4]
    with pytest.raises(ValueError, match="lag_range"):
        older.sync_actuator_delays(world, None, (3, 2))
