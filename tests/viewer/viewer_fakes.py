"""Small environment for viewer tests: plain MuJoCo, two carts with poles."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import torch

from mjlab.managers.debug_vis import SensorSwitches
from mjlab.viewer.viewer_config import ViewerConfig

XML = """
<mujoco>
  <option timestep="0.01"/>
  <visual><headlight diffuse=".6 .6 .6" ambient=".3 .3 .3" specular="0 0 0"/></visual>
  <asset>
    <texture name="checker" type="2d" builtin="checker" rgb1=".2 .3 .4" rgb2=".1 .2 .3"
             width="300" height="300"/>
    <material name="floor" texture="checker" texrepeat="5 5" texuniform="true" reflectance=".2"/>
  </asset>
  <worldbody>
    <light pos="0 0 4" dir="0 0 -1"/>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 .01" material="floor"/></body>
    <body name="cartpole/cart" pos="0 0 1">
      <joint name="cartpole/slider" type="slide" axis="1 0 0" range="-1.8 1.8"/>
      <geom name="cartpole/cart" type="box" size="0.2 0.15 0.1" rgba=".8 .3 .2 1" mass="1"/>
      <body name="cartpole/pole">
        <joint name="cartpole/hinge" type="hinge" axis="0 1 0"/>
        <geom name="cartpole/pole" type="capsule" fromto="0 0 0 0 0 1" size="0.045"
              rgba=".2 .5 .9 1" mass="0.1"/>
      </body>
    </body>
    <camera name="side" pos="0 -4 1" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
  <actuator><motor name="cartpole/slide" joint="cartpole/slider" gear="10"/></actuator>
</mujoco>
"""


class FakeSim:
    """Simulation with one MjData per environment and the interface that viewers use."""

    def __init__(self, num_envs: int, xml: str = XML):
        self.mj_model = mujoco.MjModel.from_xml_string(xml)
        self.datas = [mujoco.MjData(self.mj_model) for _ in range(num_envs)]
        self.expanded_fields: set[str] = set()
        self.model = SimpleNamespace()
        self.forward()

    @property
    def data(self) -> SimpleNamespace:
        def field(name: str) -> torch.Tensor:
            rows = [
                torch.as_tensor(getattr(d, name).copy(), dtype=torch.float32) for d in self.datas
            ]
            return torch.stack(rows)

        names = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "xpos", "xmat")
        fields = {name: field(name) for name in names}
        fields["time"] = torch.tensor([d.time for d in self.datas])
        return SimpleNamespace(**fields)

    def sense(self) -> None:
        pass

    def forward(self, env_ids: torch.Tensor | None = None) -> None:
        for i in range(len(self.datas)) if env_ids is None else env_ids.tolist():
            mujoco.mj_forward(self.mj_model, self.datas[i])

    def copy_to_host(self, env_idx: int, mj_data: mujoco.MjData) -> None:
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        state = torch.zeros(mujoco.mj_stateSize(self.mj_model, spec), dtype=torch.float64).numpy()
        mujoco.mj_getState(self.mj_model, self.datas[env_idx], state, spec)
        mujoco.mj_setState(self.mj_model, mj_data, state, spec)

    def expand(self, field: str, value: torch.Tensor) -> None:
        self.expanded_fields.add(field)
        setattr(self.model, field, value)


class FakeTerms:
    """Reward, metrics or command manager."""

    def __init__(self, values: dict[str, float]):
        self.values = values
        self.active_terms = list(values)
        self.paused: list[bool] = []
        self.gui_resets: list[list[int]] = []
        self.steered: list = []

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        return [(name, [value * (env_idx + 1)]) for name, value in self.values.items()]

    def get_term_cfg(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(weight=1.0 if name in self.values else 0.0)

    steerable = True

    def steer(self, shares, get_env_idx, add=True) -> None:
        self.steered.append((get_env_idx(), shares) if add else ("sticks", get_env_idx(), shares))

    def create_gui(self, server, get_env_idx, on_change=None, request_action=None) -> None:
        server.gui.add_slider("lin_vel_x", -1.0, 1.0, 0.05, 0.0)

    def create_debug_vis_gui(self, server, on_change=None) -> None:
        pass

    def on_viewer_pause(self, paused: bool) -> None:
        self.paused.append(paused)

    def apply_gui_reset(self, env_ids: torch.Tensor) -> bool:
        self.gui_resets.append(env_ids.tolist())
        return True


class FakeSensor:
    """Sensor that draws one sphere, or none."""

    def __init__(self, draws: bool = True):
        self.draws = draws

    def debug_vis(self, visualizer) -> None:
        visualizer.add_sphere([0, 0, 1], 0.05, (1.0, 1.0, 0.0, 1.0))


class FakeEnv:
    """Carts with origins 3 m apart; raises at the steps in `fail_at`."""

    device = "cpu"
    step_dt = 0.02

    def __init__(self, num_envs: int = 2, viewer: ViewerConfig | None = None):
        self.num_envs = num_envs
        self.cfg = SimpleNamespace(viewer=viewer or ViewerConfig())
        self.sim = FakeSim(num_envs)
        origins = torch.zeros(num_envs, 3)
        origins[:, 0] = 3.0 * torch.arange(num_envs)
        cartpole = SimpleNamespace(
            body_names=("cart", "pole"),
            indexing=SimpleNamespace(root_body_id=2, body_ids=torch.tensor([2, 3])),
        )
        self.scene = SimpleNamespace(
            entities={"terrain": SimpleNamespace(body_names=("terrain",)), "cartpole": cartpole},
            env_origins=origins,
            sensors={},
        )
        self.reward_manager = FakeTerms({"upright": 0.5, "effort": -0.25})
        self.metrics_manager = FakeTerms({"height": 1.0})
        self.observation_manager = SimpleNamespace(
            reset=lambda env_ids: None, compute=lambda **kwargs: self.sim.data.qpos
        )
        self.command_manager = FakeTerms({"velocity": 0.0})
        self.manager_visualizers = {"command_manager": self.command_manager}
        self.sensor_visualizers = SensorSwitches(
            {"hits": FakeSensor(), "silent": FakeSensor(False)}
        )
        self.metadata = {"render_fps": 50.0}
        self.num_steps = 0
        self.num_resets = 0
        self.actions: list[torch.Tensor] = []
        self.fail_at: set[int] = set()
        self.closed = False

    @property
    def unwrapped(self) -> FakeEnv:
        return self

    def get_observations(self) -> torch.Tensor:
        return self.sim.data.qpos

    def step(self, actions: torch.Tensor):
        self.num_steps += 1
        if self.num_steps in self.fail_at:
            raise RuntimeError(f"step {self.num_steps} failed")
        self.actions.append(actions)
        for data, action in zip(self.sim.datas, actions, strict=True):
            data.ctrl[:] = action.numpy()
            mujoco.mj_step(self.sim.mj_model, data, 2)
        done = torch.zeros(self.num_envs, dtype=torch.bool)
        return self.get_observations(), torch.ones(self.num_envs), done, done, {}

    def reset(self, env_ids: torch.Tensor | None = None, **_):
        self.num_resets += 1
        ids = range(self.num_envs) if env_ids is None else env_ids.tolist()
        for i in ids:
            mujoco.mj_resetData(self.sim.mj_model, self.sim.datas[i])
        self.sim.forward()
        return self.get_observations(), {}

    def update_visualizers(self, visualizer) -> None:
        self.sensor_visualizers.debug_vis(visualizer)
        for i in visualizer.get_env_indices(self.num_envs):
            cart = self.sim.datas[i].xpos[2]
            visualizer.add_arrow(cart, cart + [0, 0, 0.6], (0.1, 0.7, 0.2, 0.8), width=0.03)
            visualizer.add_sphere(cart + [0, 0, 0.8], 0.08, (0.9, 0.1, 0.8, 0.5))

    def close(self) -> None:
        self.closed = True


def push(amount: float = 0.3):
    """Return a policy with the same action for every cart."""
    return lambda obs: torch.full((len(obs), 1), amount)
