"""Exported policy: same actions as the torch policy, deployment metadata."""

from __future__ import annotations

import copy
import math
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from mjlab.rl.exporter_utils import (
    OnnxPolicyError,
    action_limit,
    attach_metadata_to_onnx,
    get_base_metadata,
    list_to_csv_str,
    load_onnx_policy,
)

_LEG = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1"/>
      <body name="thigh">
        <joint name="hip" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -.3"/>
        <body name="shank" pos="0 0 -0.3">
          <joint name="knee" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -.3"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def cartpole_env():
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_swingup_env_cfg

    cfg = cartpole_swingup_env_cfg()
    cfg.scene.num_envs, cfg.seed = 2, 0
    return ManagerBasedRlEnv(cfg, device="cpu")


def leg_env():
    """A leg whose hip MuJoCo servos and whose knee torch servos, with histories and scales."""
    from mjlab.actuator import BuiltinPositionActuatorCfg, IdealPdActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnvCfg
    from mjlab.envs.mdp import JointPositionActionCfg, joint_pos_rel, joint_vel_rel
    from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
    from mjlab.managers.scene_entity_config import SceneEntityCfg
    from mjlab.scene import SceneCfg

    leg = SceneEntityCfg("leg")
    terms = {
        "pos": ObservationTermCfg(
            func=joint_pos_rel, params={"asset_cfg": leg}, scale=0.1, history_length=3
        ),
        "vel": ObservationTermCfg(
            func=joint_vel_rel,
            params={"asset_cfg": leg},
            scale=(0.05, 0.1, 0.2),
            clip=(-2.5, 2.5),
            delay_max_lag=2,
        ),
    }
    entity = EntityCfg(
        init_state=EntityCfg.InitialStateCfg(joint_pos={"hip": 0.1, "knee": -0.3}),
        spec_fn=lambda: mujoco.MjSpec.from_string(_LEG),
        articulation=EntityArticulationInfoCfg(
            actuators=(
                IdealPdActuatorCfg(
                    target_names_expr=("knee",), stiffness=30.37, damping=1.13, delay_max_lag=3
                ),
                BuiltinPositionActuatorCfg(
                    target_names_expr=("hip",), stiffness=20.12345, damping=0.7
                ),
            )
        ),
    )
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(num_envs=2, entities={"leg": entity}),
        observations={"actor": ObservationGroupCfg(terms)},
        actions={
            "legs": JointPositionActionCfg(
                entity_name="leg",
                actuator_names=(".*",),
                scale={"hip": 0.37275312, "knee": 0.25},
                clip={"knee": (-1.5, 1.5)},
            )
        },
        episode_length_s=1.0,
        seed=0,
    )
    return ManagerBasedRlEnv(cfg, device="cpu")


def properties(path: Path) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load(str(path)).metadata_props}


def test_the_onnx_policy_computes_what_the_torch_policy_does(make_runner, tmp_path: Path):
    runner = make_runner(tmp_path / "run")
    # Some learning moves the normalizer away from the identity.
    runner.learn(3)
    path = tmp_path / "run" / "run.onnx"
    session = onnxruntime.InferenceSession(str(path))
    assert [(x.name, x.shape) for x in session.get_inputs()] == [("obs", [1, 2])]
    assert [(x.name, x.shape) for x in session.get_outputs()] == [("actions", [1, 2])]
    assert {o.version for o in onnx.load(str(path)).opset_import if o.domain == ""} == {18}
    policy = runner.get_inference_policy()
    for rows in torch.randn(20, 1, 2, generator=torch.Generator().manual_seed(0)):
        with torch.no_grad():
            expected = policy({"actor": 3 * rows}).numpy()
        (actual,) = session.run(["actions"], {"obs": (3 * rows).numpy()})
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5)


def test_the_onnx_policy_clips_actions_as_training_does(make_runner, tmp_path: Path):
    runner, path = make_runner(), tmp_path / "policy.onnx"
    rows = torch.randn(1, 2, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        free = runner.get_inference_policy()({"actor": rows}).numpy()
    limit = 0.5 * float(np.abs(free).max())
    for clip in (None, limit):
        runner.env.clip_actions = clip
        runner.export_policy_to_onnx(str(tmp_path), path.name)
        assert action_limit(path) == pytest.approx(math.inf if clip is None else clip)
        (actions,) = onnxruntime.InferenceSession(str(path)).run(None, {"obs": rows.numpy()})
        expected = free if clip is None else free.clip(-clip, clip)
        np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-6)


def test_a_cartpole_run_leaves_a_policy_with_its_metadata(tmp_path: Path):
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_ppo_runner_cfg

    env = RslRlVecEnvWrapper(cartpole_env())
    runner = MjlabOnPolicyRunner(env, asdict(cartpole_ppo_runner_cfg()), str(tmp_path / "a_run"))
    runner.learn(1)
    found = properties(tmp_path / "a_run" / "a_run.onnx")
    assert found["run_path"] == "a_run"
    assert found["joint_names"] == "slider,hinge_1"
    assert found["default_joint_pos"] == "0.0,3.1415927"
    # A motor has no gains.
    assert found["joint_stiffness"] == "0.0"
    assert found["joint_damping"] == "0.0"
    assert found["observation_names"] == "cart_pos,pole_angle,cart_vel,pole_vel"
    assert found["observation_dims"] == "1,2,1,1"
    assert found["observation_terms_clip"] == ",".join(["-inf;inf"] * 4)
    assert found["command_names"] == ""
    assert found["action_names"] == "effort"
    assert found["action_types"] == "JointEffortAction"
    assert found["action_entities"] == "cartpole"
    assert found["action_dims"] == "1"
    assert found["action_target_names"] == "slider"
    assert found["action_scale"] == "1.0"
    assert found["action_offset"] == "0.0"
    assert (found["step_dt"], found["physics_dt"], found["decimation"]) == ("0.05", "0.01", "5")
    env.close()


def test_metadata_of_position_actions_are_exact():
    env = leg_env()
    metadata = get_base_metadata(env, "some_run")
    assert list(metadata)[:12] == [
        "run_path",
        "joint_names",
        "joint_stiffness",
        "joint_damping",
        "default_joint_pos",
        "command_names",
        "observation_names",
        "observation_terms_scale",
        "observation_terms_flatten_history_dim",
        "observation_terms_history_length",
        "observation_terms_clip",
        "observation_group",
    ]
    assert metadata["joint_names"] == ["slide", "hip", "knee"]
    # Joints without an actuator are left out; the knee's gains are not in the MuJoCo model.
    assert metadata["joint_stiffness"] == [20.12345, 30.37]
    assert metadata["joint_damping"] == [0.7, 1.13]
    assert metadata["default_joint_pos"] == [0.0, 0.1, -0.3]
    assert metadata["action_target_names"] == ["hip", "knee"]
    # As short as float32 needs, and not rounded to three decimals.
    assert metadata["action_scale"] == [0.3727531, 0.25]
    assert np.float32(metadata["action_scale"][0]) == np.float32(0.37275312)
    assert metadata["action_offset"] == [0.1, -0.3]
    assert metadata["action_clip"] == [[-np.inf, np.inf], [-1.5, 1.5]]
    assert metadata["observation_terms_scale"] == [0.1, [0.05, 0.1, 0.2]]
    assert metadata["observation_terms_history_length"] == [3, 0]
    assert metadata["observation_dims"] == [9, 3]
    assert metadata["observation_delay"] == [[0, 0], [0, 2]]
    assert metadata["actuator_delay"] == [[0, 3], [0, 0]]
    env.close()


def test_metadata_follow_the_default_pose():
    env = leg_env()
    entity = next(iter(env.scene.entities.values()))
    entity.data.default_joint_pos[:] = torch.tensor([0.5, 0.25, -0.75])
    metadata = get_base_metadata(env, "some_run")
    assert metadata["default_joint_pos"] == [0.5, 0.25, -0.75]
    assert metadata["action_offset"] == [0.25, -0.75]


def test_attached_metadata_replaces_what_was_there(make_runner, tmp_path: Path):
    make_runner().export_policy_to_onnx(str(tmp_path), "policy.onnx")
    path = tmp_path / "policy.onnx"
    attach_metadata_to_onnx(str(path), {"a": [0.1, True], "b": "text", "c": 0.3728})
    attach_metadata_to_onnx(str(path), {"a": [[1.5, float("inf")], 2], "d": []})
    written = {"a": "1.5;inf,2", "b": "text", "c": "0.3728", "d": ""}
    assert properties(path) == {"graph_batch_size": "any", **written}
    onnxruntime.InferenceSession(str(path))
    assert [entry.name for entry in tmp_path.iterdir()] == ["policy.onnx"]


@pytest.mark.parametrize(
    ("values", "decimals", "expected"),
    [
        ([1, 2.5, "x"], 3, "1.000,2.500,x"),
        ([True, False], 3, "1.000,0.000"),
        ([[1.0, 2.0], 3], 1, "1.0;2.0,3.0"),
        ([float("inf"), -float("inf")], 3, "inf,-inf"),
        ([0.37275312, 1, True, 1e-9], None, "0.37275312,1,1,1e-09"),
        (torch.tensor([0.5, 0.25]), 2, "0.50,0.25"),
        ((), 3, ""),
    ],
)
def test_lists_as_text(values, decimals, expected):
    assert list_to_csv_str(values, decimals=decimals) == expected
    other = list_to_csv_str(values, decimals=decimals, delimiter="|", sub_delimiter=" ")
    assert other == expected.replace(",", "|").replace(";", " ")


def test_a_policy_that_cannot_be_exported_does_not_lose_the_run(make_runner, tmp_path, caplog):
    runner = make_runner(tmp_path / "run")

    def fail(*args, **kwargs):
        raise RuntimeError("no such operator")

    runner.export_policy_to_onnx = fail
    runner.learn(1)
    assert runner.stop_reason == "finished"
    assert "no such operator" in caplog.text


def test_training_and_export_import_no_exporters_plots_and_runtimes(tmp_path: Path):
    # In a separate process, because other tests may have imported them.
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from rl_fake_env import FakeEnv, FakeEnvCfg, runner_cfg
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
runner = MjlabOnPolicyRunner(
    RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg())), runner_cfg(), {str(tmp_path / "run")!r}
)
runner.learn(1)
print(sorted({{"onnxruntime", "onnxscript", "matplotlib"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["[]"], done.stderr
    assert (tmp_path / "run" / "run.onnx").is_file()


def test_configs_are_read_without_torch():
    program = "import mjlab.rl.config, sys; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_an_exported_policy_obeys_the_umask(tmp_path: Path) -> None:
    graph = onnx.helper.make_graph([], "empty", [], [])
    path = tmp_path / "policy.onnx"
    onnx.save(onnx.helper.make_model(graph), path)
    before = os.umask(0o077)
    try:
        attach_metadata_to_onnx(str(path), {"a": 1.0})
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o600


def test_other_physics_and_delays_are_one_warning(tmp_path: Path, caplog):
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.cartpole.cartpole_env_cfg import cartpole_ppo_runner_cfg

    env = RslRlVecEnvWrapper(cartpole_env())
    runner = MjlabOnPolicyRunner(env, asdict(cartpole_ppo_runner_cfg()), str(tmp_path / "run"))
    path = tmp_path / "run.onnx"
    runner.export_policy_to_onnx(str(tmp_path), "run.onnx")
    attach_metadata_to_onnx(str(path), get_base_metadata(env.unwrapped, "run"))
    load_onnx_policy(path, env, "cpu")
    assert not caplog.records
    changes = {
        "decimation": "10", "physics_dt": "0.005", "observation_delay": "0;0,0;2,0;0,0;0",
        "actuator_delay": "0;1", "joint_stiffness": "3.0", "action_clip": "-1;1",
        "observation_terms_clip": "-1;1,-inf;inf,-inf;inf,-inf;inf", "joint_names": "hinge_1,slider",
    }  # fmt: skip
    for number in range(2):
        attach_metadata_to_onnx(str(path), {**changes} if number else {"decimation": "10"})
        caplog.clear()
        load_onnx_policy(path, env, "cpu")
        (warning,) = caplog.records
        for key in changes if number else ("decimation",):
            assert f"{key}: the policy has" in warning.getMessage()
    # Physics that the task trains with is expected.
    trained = copy.deepcopy(env.unwrapped.cfg)
    trained.decimation, trained.sim.mujoco.timestep = 10, 0.005
    load_onnx_policy(path, env, "cpu", trained)
    assert "decimation" not in caplog.records[-1].getMessage()
    assert "joint_stiffness" in caplog.records[-1].getMessage()
    # Control steps and what enters or leaves the network are errors.
    for key, value in {"step_dt": "0.1", "action_scale": "2.0", "action_offset": "1.0"}.items():
        good = properties(path)[key]
        attach_metadata_to_onnx(str(path), {key: value})
        with pytest.raises(OnnxPolicyError, match=f"different environment.*{key}: the policy has"):
            load_onnx_policy(path, env, "cpu")
        attach_metadata_to_onnx(str(path), {key: good})
    env.close()
