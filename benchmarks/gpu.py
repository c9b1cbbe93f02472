"""Measurements on an NVIDIA GPU: `make gpu`, or `python benchmarks/gpu.py --part parity speed`.

Runs on any Python with the dependencies, without a network and without an installed mjlab. Each part is
a process with a time limit; its rows are written one by one, so that failures and time limits do not
lose earlier ones. `--device cpu --tiny` runs the same parts, at sizes of a few seconds, on Warp's CPU
device. The tests marked `cuda` are run by pytest.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, TypeVar

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "benchmarks")]

import mujoco  # noqa: E402 - found by the line above.
import mujoco_warp  # noqa: E402
import torch  # noqa: E402
import warp  # noqa: E402
from measure import Row, alternate, show  # noqa: E402

from mjlab.cli.policy_flags import parse_policy_flags  # noqa: E402
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg  # noqa: E402
from mjlab.rl.evaluation import EvaluationResult  # noqa: E402
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate  # noqa: E402
from mjlab.sim.engine import CameraView, RayQuery  # noqa: E402
from mjlab.sim.randomization import expand_model_fields  # noqa: E402
from mjlab.sim.sim_data import TorchArray  # noqa: E402
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg  # noqa: E402
from mjlab.utils.processes import available_cores  # noqa: E402

mjw: Any = mujoco_warp
wp: Any = warp
T = TypeVar("T")

CARTPOLE = "Mjlab-Cartpole-Swingup"
GO1_FLAT = "Mjlab-Velocity-Flat-Unitree-Go1"
GO1_ROUGH = "Mjlab-Velocity-Rough-Unitree-Go1"
G1_FLAT = "Mjlab-Velocity-Flat-Unitree-G1"
G1_ROUGH = "Mjlab-Velocity-Rough-Unitree-G1"
LIFT_CUBE = "Mjlab-Lift-Cube-Yam"
LIFT_CUBE_RGB = "Mjlab-Lift-Cube-Yam-Rgb"
TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"


@dataclass(frozen=True)
class Options:
    """Device, size and time limit of a part."""

    device: str
    """Torch device of the Warp engine."""
    tiny: bool
    """Use sizes of a few seconds on a CPU."""
    seconds: float
    """Time limit."""

    def sized(self, full: T, tiny: T) -> T:
        """Return the size to use."""
        return tiny if self.tiny else full


# Environments.


def make_env(
    task: str, num_envs: int, device: str, engine: Literal["native", "warp"] = "warp"
) -> ManagerBasedRlEnv:
    """Return the task's environments, just reset, of seed 1."""
    return _reset(load_env_cfg(task), num_envs, device, engine)


def _reset(cfg: ManagerBasedRlEnvCfg, num_envs: int, device: str, engine: Any) -> ManagerBasedRlEnv:
    cfg.scene.num_envs, cfg.sim.engine, cfg.seed = num_envs, engine, 1
    env = ManagerBasedRlEnv(cfg, device=device)
    env.reset()
    return env


def random_actions(env: ManagerBasedRlEnv, generator: torch.Generator) -> torch.Tensor:
    """Return actions (N, A) on the host."""
    return 0.3 * torch.randn(
        (env.num_envs, env.action_manager.total_action_dim), generator=generator
    )


def stepped_env(
    task: str, num_envs: int, device: str, steps: int
) -> tuple[ManagerBasedRlEnv, torch.Tensor]:
    """Return environments on Warp after `steps` steps, and the actions (N, A) of each."""
    env = make_env(task, num_envs, device)
    actions = random_actions(env, torch.Generator().manual_seed(0)).to(env.device)
    for _ in range(steps):
        env.step(actions)
    return env, actions


def close(env: ManagerBasedRlEnv) -> None:
    """Close environments and collect reference cycles."""
    env.close()
    gc.collect()


def wait(device: str) -> None:
    """Synchronize the device. No-op on the CPU."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


# Kernels: seconds to compile those of each task, so that later parts do not wait.


def kernels(options: Options) -> Iterator[Row]:
    """Compile the kernels of all tasks in parallel processes; Warp keeps them in a folder of the user."""
    # The first has contacts, joint limits and sensors: most modules of `mujoco_warp`, compiled once
    # for the others.
    tasks = (GO1_FLAT, G1_ROUGH, LIFT_CUBE_RGB, TRACKING, G1_FLAT, GO1_ROUGH, LIFT_CUBE, CARTPOLE)
    first, *others = options.sized(tasks, (CARTPOLE,))
    size = options.sized(64, 2)
    begin = time.monotonic()
    with ProcessPoolExecutor(
        max(1, available_cores() // 2), mp_context=get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        for group in ([first], others):
            running = {pool.submit(_compile, task, options.device, size): task for task in group}
            for done in as_completed(running):
                yield Row(
                    f"{running[done]}: kernels compiled and loaded",
                    f"after {time.monotonic() - begin:.0f} s",
                    done.result(),
                    "",
                    None,
                )


def _compile(task: str, device: str, num_envs: int) -> str:
    begin = time.perf_counter()
    env, actions = stepped_env(task, num_envs, device, 1)
    wait(device)
    first = time.perf_counter()
    for _ in range(5):
        env.step(actions)
    # Resets of some environments and their randomization.
    env.reset(env_ids=torch.tensor([0], device=device))
    wait(device)
    after = time.perf_counter() - first
    env.close()
    return f"built, reset and stepped once in {first - begin:.1f} s; five more steps {after:.1f} s"


# Parity: observations and rewards of both engines from the same states.

STATE_TOLERANCE = 5e-3
"""Error of observations of the same state. Contact forces (critic) are the least exact."""
STEP_TOLERANCE = 2e-2
"""Error of observations and rewards after one step, in double and in single precision."""
WITHIN = 0.99
"""Share of the environments' steps within these tolerances: a contact that begins in this substep on
one engine and in the next on the other exceeds them."""

_STATE = (
    *("time", "qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied"),
    *("eq_active", "mocap_pos", "mocap_quat", "qacc_warmstart"),
)


def parity(options: Options) -> Iterator[Row]:
    """Compare one task of each family; yield two rows per task.

    Native MuJoCo on the CPU is the reference: before every step Warp takes over its state, and both step
    with the same actions. So chaotic motions with contacts do not diverge, and every step is a
    separate comparison. An error is relative to the largest value of its quantity.
    """
    num_envs, steps = options.sized((128, 40), (4, 2))
    for task in options.sized((CARTPOLE, GO1_FLAT, LIFT_CUBE, TRACKING), (CARTPOLE, GO1_FLAT)):
        native = _reset(_without_chance(task), num_envs, "cpu", "native")
        on_warp = _reset(_without_chance(task), num_envs, options.device, "warp")
        yield from compare(task, native, on_warp, steps)
        for env in (native, on_warp):
            close(env)


def _without_chance(task: str) -> ManagerBasedRlEnvCfg:
    """Return the task without terms that draw random numbers within a step: the devices' differ."""
    cfg = load_env_cfg(task)
    for group in cfg.observations.values():
        group.enable_corruption = False
    kept = {n: event for n, event in cfg.events.items() if event.mode not in ("interval", "step")}
    cfg.events = kept
    return cfg


@dataclass
class Errors:
    """Relative errors of all environments in all steps, and the quantity with the largest."""

    values: list[torch.Tensor] = field(default_factory=list)
    largest: float = 0.0
    place: str = "nowhere"

    def of(self, name: str, native: torch.Tensor, on_warp: torch.Tensor) -> torch.Tensor:
        """Return the error of each environment (N,) in `name`, whose values are (N, ...)."""
        native, on_warp = (values.cpu().float().flatten(1) for values in (native, on_warp))
        scale = 1.0 + native.abs().amax(dim=0)
        # NaN on one engine alone is an infinite error.
        errors = ((native - on_warp).abs() / scale).nan_to_num(nan=torch.inf).amax(dim=1)
        if errors.max() > self.largest:
            self.largest, self.place = float(errors.max()), name
        return errors

    def row(self, what: str, compared_with: str, tolerance: float, also: bool = True) -> Row:
        """Return the line of the table; `also` is a further condition."""
        values = torch.cat(self.values)
        share = (values <= tolerance).float().mean().item()
        middle, high = values.quantile(torch.tensor([0.5, 0.99])).tolist()
        measured = f"{share:.2%} within {tolerance:g}; median {middle:.1e}, 99 % {high:.1e}, "
        measured += f"largest {self.largest:.1e} ({self.place})"
        target = f"{WITHIN:.0%} within {tolerance:g}"
        return Row(what, measured, compared_with, target, share >= WITHIN and also)


def compare(
    task: str, native: ManagerBasedRlEnv, on_warp: ManagerBasedRlEnv, steps: int
) -> Iterator[Row]:
    """Run `steps` steps, each from the same states; yield two rows."""
    generator = torch.Generator().manual_seed(0)
    envs = (native, on_warp)
    seen, stepped = Errors(), Errors()
    ended_differently, count = 0, steps * native.num_envs
    for _ in range(steps):
        follow(native, on_warp)
        everywhere = torch.ones(native.num_envs, dtype=torch.bool)
        seen.values.append(_observed(seen, native, on_warp, everywhere))
        actions = random_actions(native, generator)
        ended = [env.step(actions.to(env.device))[2:4] for env in envs]
        done = [(terminated | truncated).cpu() for terminated, truncated in ended]
        # Finished episodes restart at random states.
        going = ~(done[0] | done[1])
        errors = _observed(stepped, native, on_warp, going)
        rewards = [env.reward_manager._step_reward[going.to(env.device)] for env in envs]
        for index, name in enumerate(native.reward_manager.active_terms):
            both = (values[:, index : index + 1] for values in rewards)
            errors = torch.maximum(errors, stepped.of(f"reward {name}", *both))
        stepped.values.append(errors)
        ended_differently += int((done[0] != done[1]).sum())
    yield seen.row(
        f"{task}: observations of {count} equal states, error of Warp",
        "native MuJoCo",
        STATE_TOLERANCE,
    )
    yield stepped.row(
        f"{task}: observations and rewards after one step from them, error of Warp",
        f"native MuJoCo; {ended_differently} episodes ended on one engine alone",
        STEP_TOLERANCE,
        also=ended_differently <= (1 - WITHIN) * count,
    )


def _observed(
    errors: Errors, native: ManagerBasedRlEnv, on_warp: ManagerBasedRlEnv, chosen: torch.Tensor
) -> torch.Tensor:
    """Return the largest error over all observation groups of each chosen environment."""
    largest = torch.zeros(int(chosen.sum()))
    for name, values in native.obs_buf.items():
        assert isinstance(values, torch.Tensor), f"{name}: expected one tensor, got several"
        others: Any = on_warp.obs_buf[name]
        both = (v[chosen.to(v.device)] for v in (values, others))
        largest = torch.maximum(largest, errors.of(name, *both))
    return largest


def follow(native: ManagerBasedRlEnv, on_warp: ManagerBasedRlEnv) -> None:
    """Copy the state of the environments on native MuJoCo to those on Warp."""
    state: dict[str, Any] = native.state_dict()
    # Saved physics states do not transfer between engines; copy the fields.
    state["sim"] = on_warp.sim.state_dict()
    on_warp.load_state_dict(state)
    for name in native.sim.expanded_fields & on_warp.sim.expanded_fields:
        getattr(on_warp.sim.model, name).copy_(getattr(native.sim.model, name))
    for name in _STATE:
        getattr(on_warp.sim.data, name).copy_(getattr(native.sim.data, name))
    for env in (native, on_warp):
        env.sim.forward()
        env.sim.sense()
        # Recompute: the copied state includes old observations.
        env.obs_buf = env.observation_manager.compute(update_history=True)


# Speed: `env.step` over a bare `mujoco_warp` loop, waits for the GPU, memory.


def speed(options: Options) -> Iterator[Row]:
    """Measure every task; yield three rows each."""
    # Exclude the GPU contexts of libraries.
    close(stepped_env(options.sized(GO1_FLAT, CARTPOLE), 2, options.device, 1)[0])
    tasks = (CARTPOLE, GO1_FLAT, G1_FLAT, GO1_ROUGH, G1_ROUGH)
    for task in options.sized(tasks, (CARTPOLE, GO1_ROUGH)):
        yield from _speed_of(task, options)


def _speed_of(task: str, options: Options) -> Iterator[Row]:
    device, num_envs = options.device, options.sized(4096, 2)
    where = f"{task}, {num_envs:,} envs"
    memory_before = _memory_used(device)
    env, actions = stepped_env(task, num_envs, device, options.sized(25, 2))
    memory = _memory_used(device) - memory_before
    steps = options.sized(50, 2)
    waits = _counted_waits(device, lambda: [env.step(actions) for _ in range(steps)])
    bare = BareWarp(env)
    repeats, per_repeat = options.sized((15, 10), (2, 1))
    env_time, bare_time = alternate(
        lambda: env.step(actions),
        bare,
        steps=per_repeat,
        repeats=repeats,
        warm_up=3,
        before=bare.same_states,
        wait=lambda: wait(device),
    )
    rays = f", the same {bare.num_rays} rays" if bare.num_rays else ""
    yield Row(
        f"{where}: `env.step` over bare `mujoco_warp`{rays}",
        f"{bare_time / env_time:.2f} ({num_envs / env_time:,.0f} env-steps/s, "
        f"{1e3 * env_time:.2f} ms a step)",
        f"bare loop: {num_envs / bare_time:,.0f} env-steps/s, {1e3 * bare_time:.2f} ms",
        "",
        None,
    )
    if device.startswith("cuda"):
        most = ", ".join(f"{place} {n / steps:.2g}" for place, n in waits.most_common(6))
        measured = f"{waits.total() / steps:.1f} ({most})"
        yield Row(f"{where}: waits of the host for the GPU in a step", measured, "", "", None)
        yield Row(f"{where}: GPU memory of the environments", f"{memory:,.0f} MiB", "", "", None)
    del bare
    close(env)


def _memory_used(device: str) -> float:
    """Return the used memory of the GPU (MiB), 0 on the CPU."""
    if not device.startswith("cuda"):
        return 0.0
    gc.collect()
    wait(device)
    torch.cuda.empty_cache()
    free, total = torch.cuda.mem_get_info(device)
    return (total - free) / 2**20


def _counted_waits(device: str, work: Callable[[], Any]) -> Counter[str]:
    """Count the torch operations of `work` that synchronize with the GPU, by `file:line`."""
    if not device.startswith("cuda"):
        return Counter()
    wait(device)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        work()
        torch.cuda.set_sync_debug_mode("default")
    return Counter(
        f"{Path(warning.filename).name}:{warning.lineno}"
        for warning in caught
        if "called a synchronizing CUDA operation" in str(warning.message)
    )


class BareWarp:
    """The physics of one environment step on `mujoco_warp`, in one graph.

    It steps the environments' models, including randomized fields, from the environments' states, with the
    same controls, and casts the same rays. The difference to `env.step` is the overhead of managers.
    """

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env, sim = env, env.sim
        engine: Any = sim._engine
        self._device = wp.get_device(env.device)
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(sim.mj_model)
            # Same order as the engine.
            self._model.opt.warn_overflow = 0
            if self._device.is_cuda:
                self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
            sim.cfg.apply_wp_opt(self._model.opt)
            self._data = mjw.put_data(
                sim.mj_model,
                engine._host,
                env.num_envs,
                nconmax=sim.wp_data.naconmax // env.num_envs,
                njmax=sim.wp_data.njmax,
            )
            names = sorted(sim.expanded_fields)
            expand_model_fields(self._model, env.num_envs, names)
            wait(env.device)
            for name in names:
                owner = self._model if hasattr(self._model, name) else self._model.opt
                own = TorchArray(getattr(owner, name)).tensor
                own.copy_(getattr(sim.model, name).view(own.shape))
            if "stat.meaninertia" in engine.model_fields:
                expand_model_fields(self._model, env.num_envs, ["stat.meaninertia"])
                wait(env.device)
                inertia = TorchArray(self._model.stat.meaninertia).tensor
                inertia.copy_(engine.model_fields["stat.meaninertia"])
            self._rays = [_Rays(env, query) for query in _recorded_rays(env)]
            self._replay = _captured(self._device, self._work)

    @property
    def num_rays(self) -> int:
        """Number of rays per environment."""
        return sum(rays.count for rays in self._rays)

    def same_states(self) -> None:
        """Copy states and controls of the environments."""
        for name in ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "mocap_pos", "mocap_quat"):
            own = TorchArray(getattr(self._data, name)).tensor
            own.copy_(getattr(self._env.sim.data, name).view(own.shape))

    def _work(self) -> None:
        for _ in range(self._env.cfg.decimation):
            mjw.step(self._model, self._data)
        mjw.forward(self._model, self._data)
        for rays in self._rays:
            rays.cast(self._model, self._data)

    def __call__(self) -> None:
        with wp.ScopedDevice(self._device):
            self._replay()


def _captured(device: Any, work: Callable[[], None]) -> Callable[[], None]:
    """Call `work` once, which loads its kernels; return it, on a GPU as a captured graph."""
    wait(str(device))
    work()
    if not device.is_cuda:
        return work
    with wp.ScopedCapture(device=device) as capture:
        work()
    return lambda: wp.capture_launch(capture.graph)


class _Rays:
    """Rays of one query of the environments, as arguments of `mujoco_warp`."""

    def __init__(self, env: ManagerBasedRlEnv, query: RayQuery) -> None:
        origins, groups, excluded = query.origins, query.geom_groups, query.exclude_body_ids
        shape, device = tuple(origins.shape[:2]), origins.device
        self.count = shape[1]
        if excluded is None:
            excluded = torch.full(shape[1:], -1, device=device)
        # Keep references: Warp arrays do not own the memory of their tensors.
        self._tensors = (
            origins.contiguous().clone(),
            query.directions.contiguous().clone(),
            excluded.to(torch.int32).contiguous(),
            torch.empty(shape, device=device),
            torch.empty(shape, dtype=torch.int32, device=device),
            torch.empty((*shape, 3), device=device),
        )
        kinds = (wp.vec3, wp.vec3, None, None, None, wp.vec3)
        wait(env.device)
        self._arrays = [
            wp.from_torch(tensor) if kind is None else wp.from_torch(tensor, dtype=kind)
            for tensor, kind in zip(self._tensors, kinds, strict=True)
        ]
        present = {int(group) for group in env.sim.mj_model.geom_group}
        chosen = sorted(g for g in present if groups is None or min(max(g, 0), 5) in groups)
        self._context = mjw.create_render_context(
            env.sim.mj_model,
            env.num_envs,
            cam_active=[],
            use_textures=False,
            enabled_geom_groups=chosen,
        )
        self._all_groups = wp.types.vector(length=6, dtype=float)(*[-1.0] * 6)

    def cast(self, model: Any, data: Any) -> None:
        """Cast the rays at the current poses."""
        origins, directions, excluded, *hits = self._arrays
        mjw.refit_bvh(model, data, self._context)
        rays = (origins, directions, self._all_groups, True, excluded, *hits)
        mjw.rays(model, data, *rays, self._context)


def _recorded_rays(env: ManagerBasedRlEnv) -> list[RayQuery]:
    """Return all ray queries of one step."""
    queries: list[RayQuery] = []
    engine: Any = env.sim._engine
    original = engine.raycast
    engine.raycast = lambda query: queries.append(query) or original(query)
    try:
        env.sim.sense()
    finally:
        del engine.raycast
    return queries


# Learning: Go1 on flat ground until it is solved, scored on episodes of unused seeds.


def learning(options: Options) -> Iterator[Row]:
    """Train under the `cpu` profile, comparable with training on a few cores; score on both engines."""
    conditions = dict(load_rl_cfg(GO1_FLAT, profile="cpu").evaluation.solved_below)

    def shown(result: EvaluationResult) -> str:
        errors = ", ".join(f"{name} {result.value(name):.3f}" for name in conditions)
        return f"{errors}; return {result.mean_return:.0f}"

    with tempfile.TemporaryDirectory() as folder:
        # A minute is left for scoring.
        seconds, was_cut = _train(
            Path(folder), options, max(options.seconds - 60.0, 0.5 * options.seconds)
        )
        checkpoints = sorted(Path(folder).glob("*/*/model_*.pt"), key=lambda p: p.stat().st_mtime)
        iterations = torch.load(checkpoints[-1], map_location="cpu", weights_only=True)[
            "iterations_finished"
        ]
        on_warp = _score(checkpoints[-1], "warp", options.device, options)
        # Judged as in training. Comparisons with NaN are False.
        solved = all(on_warp.judged(name) <= most for name, most in conditions.items())
        yield Row(
            f"{GO1_FLAT}, `--profile cpu`, Warp: time from `train` until it stops because it is solved",
            f"{'cut off after ' if was_cut else ''}{seconds:.0f} s, {iterations} iterations; "
            f"{shown(on_warp)}",
            f"scored by `evaluate` on {on_warp.num_episodes} episodes of fresh seeds",
            ", ".join(f"{name} below {most:g}" for name, most in conditions.items()),
            None if options.tiny else solved and not was_cut,
        )
        on_native = _score(checkpoints[-1], "native", "cpu", options)
        yield Row(
            "the same policy on native MuJoCo",
            shown(on_native),
            f"on Warp: {shown(on_warp)}",
            "",
            None,
        )


def _train(log_root: Path, options: Options, limit: float) -> tuple[float, bool]:
    """Train until the task is solved or `limit` seconds; return the seconds, and True if cut off."""
    command = [sys.executable, "-m", "mjlab.scripts.train", GO1_FLAT, "--profile", "cpu"]
    command += ["--device", options.device, "--engine", "warp", "--log-root", str(log_root)]
    command += ["--agent.seed", "1", "--agent.save-interval", "20"]
    if options.tiny:
        command += ["--num-envs", "2", "--agent.max-iterations", "1"]
    begin = time.monotonic()
    process = subprocess.Popen(command)
    try:
        code = process.wait(limit)
    except subprocess.TimeoutExpired:
        # `train` saves on this signal. If that takes too long, the newest checkpoint is scored.
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(20.0)
        process.kill()
        return time.monotonic() - begin, True
    if code != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {code}; see above.")
    return time.monotonic() - begin, False


def _score(checkpoint: Path, engine: str, device: str, options: Options) -> EvaluationResult:
    """Return the result of `evaluate` with a seed that no evaluation of the training used."""
    episodes = options.sized({"warp": 1000, "native": 256}[engine], 2)
    flags = ["--checkpoint-file", str(checkpoint), "--profile", "cpu", "--engine", engine]
    flags += ["--device", device, "--seed", "90210", "--num-episodes", str(episodes)]
    if options.tiny:
        flags += ["--max-steps", "3"]
    cfg = parse_policy_flags(EvaluateConfig, flags, GO1_FLAT, "evaluate", purpose="evaluate")
    return EvaluationResult.from_dict(run_evaluate(GO1_FLAT, cfg))


# Cameras: images per second in the scene of lifting a cube, over bare `mujoco_warp.render`.


def cameras(options: Options) -> Iterator[Row]:
    """Render both kinds of images in two sizes."""
    for num_envs, size in options.sized(((4096, 32), (512, 128)), ((2, 8),)):
        env, _ = stepped_env(LIFT_CUBE_RGB, num_envs, options.device, options.sized(10, 1))
        for types in (("depth", "segmentation"), ("rgb",)):
            yield _images_per_second(env, types, size, options)
        close(env)


def _images_per_second(
    env: ManagerBasedRlEnv, types: tuple[str, ...], size: int, options: Options
) -> Row:
    sim, sensor = env.sim, env.scene["camera_d405"]
    views = (CameraView(sensor.camera_idx, size, size, types, sensor.view.geom_groups),)
    if not float(getattr(sim.render(views)[0], types[0]).float().std()) > 0:
        raise RuntimeError(f"The images {' and '.join(types)} show nothing.")
    device = wp.get_device(env.device)
    context = sim.render_context(views, views[0])

    def work() -> None:
        with wp.ScopedDevice(device):
            mjw.refit_bvh(sim.wp_model, sim.wp_data, context)
            mjw.render(sim.wp_model, sim.wp_data, context)

    steps, repeats = options.sized((5, 9), (1, 2))
    seconds, bare_seconds = alternate(
        lambda: sim.render(views),
        _captured(device, work),
        steps=steps,
        repeats=repeats,
        warm_up=2,
        wait=lambda: wait(options.device),
    )
    return Row(
        f"cameras, {size} x {size}, lift-cube scene, {env.num_envs:,} envs: {' and '.join(types)}",
        f"{env.num_envs / seconds:,.0f} images/s ({1e3 * seconds:.2f} ms for all)",
        f"bare `mujoco_warp.render`: {env.num_envs / bare_seconds:,.0f} images/s",
        "",
        None,
    )


# Parts as processes.


@dataclass(frozen=True)
class Part:
    """One table."""

    measure: Callable[[Options], Iterator[Row]]
    """Yields its rows."""
    seconds: float
    """Time limit."""


PARTS = {
    "kernels": Part(kernels, 200),
    "parity": Part(parity, 80),
    "speed": Part(speed, 150),
    "learning": Part(learning, 180),
    "cameras": Part(cameras, 60),
}


def machine(device: str) -> dict[str, Any]:
    """Return machine, GPU and library versions."""
    found: dict[str, Any] = {
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "device": device,
        "cores": available_cores(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": warp.__version__,
        "mujoco": mujoco.__version__,
        "mujoco_warp": getattr(mujoco_warp, "__version__", "?"),
    }
    if device.startswith("cuda"):
        properties: Any = torch.cuda.get_device_properties(device)
        found["gpu"] = f"{properties.name} ({properties.total_memory / 2**30:.0f} GiB)"
    return found


def run_part(name: str, options: Options, output: Path) -> None:
    """Run a part in this process, writing its file after every row."""
    content: dict[str, Any] = {"status": "running", "rows": []}
    begin = time.monotonic()
    _write(output, name, content)
    try:
        content["machine"] = machine(options.device)
        for row in PARTS[name].measure(options):
            print(f"  {row.what}: {row.measured}", flush=True)
            content["rows"].append(asdict(row))
            _write(output, name, content)
        content["status"] = "done"
    except Exception:
        content |= {"status": "failed", "error": traceback.format_exc()}
        print(content["error"], file=sys.stderr, flush=True)
    _write(output, name, content | {"seconds": time.monotonic() - begin})


def start_part(name: str, options: Options, output: Path) -> None:
    """Run a part in a process, killed with all that it started after its time."""
    print(f"\n{name} (at most {options.seconds:.0f} s)", flush=True)
    command = [sys.executable, str(Path(__file__)), "--in-process", "--part", name]
    command += ["--device", options.device, "--output", str(output)]
    command += ["--seconds", str(options.seconds), *(["--tiny"] if options.tiny else [])]
    _write(output, name, {"status": "running", "rows": []})
    process = subprocess.Popen(command, start_new_session=True)
    ended = "out of time"
    try:
        ended = f"failed: the process ended with {process.wait(options.seconds)}"
    except subprocess.TimeoutExpired:
        pass
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    content = _read(output, name)
    # A process that was killed, or crashed below Python, could not say how it ended.
    if content["status"] == "running":
        _write(output, name, content | {"status": ended})


def _read(output: Path, name: str) -> dict[str, Any]:
    return json.loads((output / f"{name}.json").read_text(encoding="utf-8"))


def _write(output: Path, name: str, content: dict[str, Any]) -> None:
    """Write the file of a part whole or not at all: the process may end at any moment."""
    output.mkdir(parents=True, exist_ok=True)
    draft = output / f"{name}.json.part"
    draft.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    draft.replace(output / f"{name}.json")


def passed(content: dict[str, Any]) -> bool:
    """Return True if a part ended by itself and reached all targets."""
    reached = all(row["reached"] is not False for row in content["rows"])
    return content["status"] == "done" and reached


def table(output: Path) -> str:
    """Return all parts in the folder as Markdown."""
    lines = []
    for name in PARTS:
        if not (output / f"{name}.json").exists():
            continue
        content = _read(output, name)
        lines += [f"## {name}: {content['status']}", "", show([Row(**r) for r in content["rows"]])]
        if "error" in content:
            lines += ["", "```text", content["error"].rstrip(), "```"]
        about = ", ".join(f"{key} {value}" for key, value in content.get("machine", {}).items())
        lines += ["", f"Measured: {about}, {content.get('seconds', 0):.0f} s.", ""]
    return "\n".join(lines)


def parse() -> argparse.Namespace:
    """Return the flags."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda:0", help="torch device; cpu with --tiny")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--tiny", action="store_true", help="sizes of a few seconds, for testing")
    parser.add_argument("--seconds", type=float, help="time limit of each part")
    output = ROOT / "benchmarks/results/gpu"
    parser.add_argument("--output", type=Path, default=output, help="folder of table and JSON")
    parser.add_argument("--in-process", action="store_true", help="run parts here, without limits")
    return parser.parse_args()


def main() -> int:
    """Run the parts asked for; return 0 if all of them passed, else 1."""
    flags = parse()
    if not re.fullmatch(r"cpu|cuda(:\d+)?", flags.device):
        raise SystemExit(f"--device: expected cpu, cuda or cuda:<index>, got {flags.device!r}")
    output = flags.output.resolve()
    # Processes that parts start find modules as this one does, in any folder.
    paths = [str(ROOT / "src"), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    os.environ["PYTHONPATH"] = os.pathsep.join(os.path.abspath(path) for path in paths if path)
    run = run_part if flags.in_process else start_part
    for name in flags.part:
        seconds = flags.seconds or PARTS[name].seconds
        run(name, Options(flags.device, flags.tiny, seconds), output)
        (output / "table.md").write_text(table(output), encoding="utf-8")
    missed = [name for name in flags.part if not passed(_read(output, name))]
    if not flags.in_process:
        print("\n" + table(output))
        print(f"Written to {output}." + (f" Not passed: {', '.join(missed)}." if missed else ""))
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
