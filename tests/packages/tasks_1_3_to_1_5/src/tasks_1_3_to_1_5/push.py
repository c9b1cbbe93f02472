"""A finger that pushes a textured block, or a wedge, to a goal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg, VariantEntityCfg
from mjlab.entity.variants import build_variant_model
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.envs.mdp.events import _sample_se3_range
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

_HERE = Path(__file__).parent


def get_finger_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(_HERE / "finger.xml"))


def get_block_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(_HERE / "block.xml"))


def get_wedge_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(_HERE / "wedge.xml"))


class PlaceCommand(CommandTerm):
    """Place on the ground to push to, (N, 2)."""

    def __init__(self, cfg: PlaceCommandCfg, env):
        super().__init__(cfg, env)
        self.place = torch.zeros(self.num_envs, 2, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return self.place

    def _update_metrics(self) -> None:
        pass

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        drawn = torch.rand(len(env_ids), 2, device=self.device) - 0.5
        self.place[env_ids] = 0.4 * drawn + self._env.scene.env_origins[env_ids, :2]

    def _update_command(self) -> None:
        pass


@dataclass(kw_only=True)
class PlaceCommandCfg(CommandTermCfg):
    def build(self, env) -> PlaceCommand:
        return PlaceCommand(self, env)


def reset_thing(env, env_ids: torch.Tensor | None, pose_range: dict) -> None:
    """Put the thing beside the finger, as the interface's own resets draw poses."""
    if env_ids is None:
        env_ids = torch.arange(env.num_envs, device=env.device)
    thing = env.scene["thing"]
    state = thing.data.default_root_state[env_ids].clone()
    drawn = _sample_se3_range(pose_range, (len(env_ids), 6), env.device)
    state[:, :3] += drawn[:, :3] + env.scene.env_origins[env_ids]
    thing.write_root_state_to_sim(state, env_ids=env_ids)


def check_variants(env, env_ids: torch.Tensor | None) -> None:
    """Build the models of all environments once more, as tools for inspection do."""
    built = build_variant_model(
        env.scene.spec,
        env.num_envs,
        env.scene.collect_variant_info(),
        configure_model=env.cfg.sim.mujoco.apply,
    )
    (variant_of_env,) = built.world_to_variant.values()
    assert set(variant_of_env) == {0, 1}
    assert built.mj_model.opt.timestep == env.cfg.sim.mujoco.timestep


def thing_position(env) -> torch.Tensor:
    return env.scene["thing"].data.root_link_pos_w - env.scene.env_origins


def thing_at_place(env, command_name: str) -> torch.Tensor:
    position = env.scene["thing"].data.root_link_pos_w[:, :2]
    away = torch.norm(position - env.command_manager.get_command(command_name), dim=-1)
    return torch.exp(-5.0 * away)


def touching(env, sensor_name: str) -> torch.Tensor:
    return (env.scene[sensor_name].data.found[:, 0] > 0).float()


def make_push_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return the task without its finger's names, to be filled in."""
    touch = ContactSensorCfg(
        name="touch",
        primary=ContactMatch(mode="geom", pattern=(), entity="robot"),
        secondary=ContactMatch(mode="body", pattern="", entity="thing"),
        fields=("found", "force"),
    )
    terms = {
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        "thing": ObservationTermCfg(func=thing_position),
        "place": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "place"}),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=4.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={
                "robot": EntityCfg(
                    spec_fn=get_finger_spec,
                    articulation=EntityArticulationInfoCfg(
                        actuators=(
                            BuiltinPositionActuatorCfg(
                                target_names_expr=("x", "y"), stiffness=50.0, damping=5.0
                            ),
                        )
                    ),
                ),
                "thing": VariantEntityCfg(
                    variants={"block": get_block_spec, "wedge": get_wedge_spec},
                    assignment={"block": 0.5, "wedge": 0.5},
                    init_state=EntityCfg.InitialStateCfg(pos=(0.15, 0.0, 0.06)),
                ),
            },
            sensors=(touch,),
        ),
        observations={
            "actor": ObservationGroupCfg(terms),
            "critic": ObservationGroupCfg(dict(terms)),
        },
        actions={
            "push": JointPositionActionCfg(
                entity_name="robot", actuator_names=("x", "y"), scale=0.3
            )
        },
        commands={"place": PlaceCommandCfg(resampling_time_range=(4.0, 4.0))},
        events={
            "check_variants": EventTermCfg(func=check_variants, mode="startup"),
            "reset_joints": EventTermCfg(
                func=mdp.reset_joints_by_offset,
                mode="reset",
                params={
                    "position_range": (-0.05, 0.05),
                    "velocity_range": (0.0, 0.0),
                    "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",)),
                },
            ),
            "reset_thing": EventTermCfg(
                func=reset_thing,
                mode="reset",
                params={"pose_range": {"x": (0.0, 0.05), "y": (-0.05, 0.05)}},
            ),
        },
        rewards={
            "place": RewardTermCfg(
                func=thing_at_place, weight=1.0, params={"command_name": "place"}
            ),
            "touch": RewardTermCfg(func=touching, weight=0.1, params={"sensor_name": "touch"}),
        },
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
        sim=SimulationCfg(nconmax=30, njmax=150, mujoco=MujocoCfg(timestep=0.005)),
    )


def push_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    cfg = make_push_env_cfg()
    (touch,) = cfg.scene.sensors
    assert isinstance(touch, ContactSensorCfg)
    touch.primary.pattern = ("fingertip",)
    touch.secondary.pattern = "thing"
    if play:
        cfg.episode_length_s = 1e9
    return cfg


class SearchRunner:
    """Runner that shares nothing with those of rsl_rl: it searches for a constant action."""

    def __init__(self, env, train_cfg: dict, log_dir: str | None = None, device: str = "cpu"):
        self.env, self.log_dir, self.device = env, log_dir, device
        self.steps = train_cfg["num_steps_per_env"]
        self.action = torch.zeros(env.num_actions, device=device)

    def add_git_repo_to_log(self, repo_file_path: str) -> None:
        pass

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        best = -float("inf")
        for _ in range(num_learning_iterations):
            action = torch.rand_like(self.action) - 0.5
            rewards = [
                self.env.step(action.expand(self.env.num_envs, -1))[1].mean()
                for _ in range(self.steps)
            ]
            if sum(rewards) > best:
                best, self.action = sum(rewards), action
        if self.log_dir is not None:
            self.save(str(Path(self.log_dir) / f"model_{num_learning_iterations}.pt"))

    def save(self, path: str, infos: dict | None = None) -> None:
        torch.save({"action": self.action, "infos": infos}, path)

    def load(self, path: str, **kwargs) -> None:
        self.action = torch.load(path, map_location=self.device)["action"]

    def get_inference_policy(self, device: str | None = None):
        return lambda obs: self.action.expand(self.env.num_envs, -1)
