"""Legacy terms of 1.x releases; resolved through the tables of `mjlab.compat`.

Commands of releases 1.1 to 1.5 update all environments in every call, with `_update_command(self)`
and `compute(self, dt)`. After a partial reset, only some environments may advance, so the state of
the other environments is restored.

Foot terms of releases 1.1 and 1.2 read site heights above z = 0 instead of a height sensor.
"""

from __future__ import annotations

import copy
import inspect
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.managers.term_checks import checked_when_built, require_command
from mjlab.tasks.velocity.mdp import rewards as feet_rewards
from mjlab.tasks.velocity.mdp.observations import Source, check_same_feet, site_columns
from mjlab.tasks.velocity.mdp.rewards import if_commanded
from mjlab.utils.indexing import as_ids
from mjlab.utils.state import changes_undone

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg


_ROBOT = SceneEntityCfg("robot")
_PHYSICS = ("qpos", "qvel", "mocap_pos", "mocap_quat")
_HEIGHT_SENSOR = "foot_height_scan"


def update_command(method: Callable[..., Any], term: Any, *args: Any, **kwargs: Any) -> Any:
    """Call `_update_command(self)`. With `env_ids`, only the state of `env_ids` changes."""
    env_ids, args, kwargs = _split_env_ids(args, kwargs)
    with _other_envs_kept(term, env_ids):
        return method(term, *args, **kwargs)


def compute(method: Callable[..., Any], term: Any, dt: Any, *args: Any, **kwargs: Any) -> Any:
    """Call `compute(self, dt)` with scalar `dt`. With `env_ids`, only the state of `env_ids` changes.

    A per-environment `dt` is zero for environments at the start of an episode. The call's decrement
    of their `time_left` is undone.
    """
    env_ids, args, kwargs = _split_env_ids(args, kwargs)
    if isinstance(dt, torch.Tensor):
        if dt.ndim > 0 and env_ids is None:
            step_dt = term._env.step_dt
            term.time_left += step_dt - dt
            dt = step_dt
        else:
            dt = dt.item()
    with _other_envs_kept(term, env_ids):
        return method(term, dt, *args, **kwargs)


def create_gui(
    method: Callable[..., Any],
    term: Any,
    name: str,
    server: Any,
    get_env_idx: Any,
    on_change: Any = None,
    request_action: Any = None,
) -> Any:
    """Call `create_gui(self, name, server, get_env_idx)` with the additional arguments it takes."""
    args = (term, name, server, get_env_idx)
    further = {"on_change": on_change, "request_action": request_action}
    parameters = inspect.signature(method).parameters
    kinds = [parameter.kind for parameter in parameters.values()]
    if inspect.Parameter.VAR_KEYWORD in kinds:
        return method(*args, **further)
    named = {key: value for key, value in further.items() if key in parameters}
    if named:
        return method(*args, **named)
    # Arguments with other names.
    positional = kinds.count(inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return method(*(*args, *further.values())[:positional])


def _split_env_ids(
    args: tuple[Any, ...], kwargs: dict[str, Any]
) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """Separate `env_ids` from additional arguments of a legacy method."""
    if "env_ids" in kwargs:
        kwargs = dict(kwargs)
        return kwargs.pop("env_ids"), args, kwargs
    if args and (args[0] is None or isinstance(args[0], (torch.Tensor, slice, list))):
        return args[0], args[1:], kwargs
    return None, args, kwargs


@contextmanager
def _other_envs_kept(term: Any, env_ids: Any) -> Generator[None]:
    """Undo changes of the body to term and physics state outside `env_ids` (None: all).

    Tensors with one row per environment keep their new values in rows `env_ids`. Other state, such as
    step counters and running means, is restored completely, because a reset takes no simulation time.
    Generators are not restored, so that later samples differ.
    """
    env_ids = as_ids(env_ids, term.num_envs, term.device)
    if len(env_ids) == term.num_envs:
        yield
        return
    data = term._env.sim.data
    physics = {name: getattr(data, name).clone() for name in _PHYSICS}
    with changes_undone([term], env_ids, term.num_envs, generators=False):
        yield
    moved = False
    for name, old in physics.items():
        field = getattr(data, name)
        kept = old.index_copy(0, env_ids, field[env_ids])
        moved |= not torch.equal(kept, field)
        field.copy_(kept)
    if moved:
        # The body may have computed derived quantities from the discarded state. Forces of environments
        # outside `env_ids` stay those of the last substep.
        term._env.sim.forward(stage="vel")
        term._env.sim.forward(env_ids)


def _check_sites(
    env: ManagerBasedRlEnv,
    command_name: str | None = None,
    asset_cfg: SceneEntityCfg = _ROBOT,
    **_: Any,
) -> None:
    require_command(env, command_name)
    site_columns(env, asset_cfg)


@checked_when_built(_check_sites)
def foot_height(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of selected sites above z = 0 (m), (N, sites)."""
    sites = columns_of(asset_cfg, "site", env)
    return env.scene[asset_cfg.name].data.site_pos_w[:, sites, 2]


@checked_when_built(_check_sites)
def feet_clearance(
    env: ManagerBasedRlEnv,
    target_height: float,
    command_name: str | None = None,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> torch.Tensor:
    """Distance of moving sites from `target_height` above z = 0 (m^2/s), (N,)."""
    miss = foot_height(env, asset_cfg) - target_height
    return feet_rewards.clearance_cost(env, miss, command_name, command_threshold, asset_cfg)


class feet_swing_height(feet_rewards.feet_swing_height):
    """Penalty at landing for swings with a peak height above z = 0 that is too low or too high."""

    def __call__(  # ty: ignore[incompatible-method-override]
        self,
        env: ManagerBasedRlEnv,
        sensor_name: str,
        target_height: float,
        command_name: str,
        command_threshold: float,
        asset_cfg: SceneEntityCfg,
    ) -> torch.Tensor:
        """Update peak heights, and return the penalty of landings in this step, (N,)."""
        cost = self.landing_cost(env, sensor_name, foot_height(env, asset_cfg), target_height)
        return if_commanded(cost, env, command_name, command_threshold)

    def _check_heights(
        self, env: ManagerBasedRlEnv, params: dict[str, Any], contacts: Source
    ) -> None:
        sites = site_columns(env, params["asset_cfg"])
        try:
            check_same_feet(env, contacts, sites)
        except ValueError as error:
            if len(contacts.columns) != len(sites.columns):
                raise
            # Releases 1.1 and 1.2 accept any order.
            warnings.warn(str(error), UserWarning, stacklevel=2)


def offer_sites(template: ManagerBasedRlEnvCfg) -> None:
    """Let packages set foot sites in the velocity template, as in releases 1.1 and 1.2."""
    for term in _height_terms(template):
        term.params = _FeetParams(term.params)
        term.params.template = template


class _FeetParams(dict[str, Any]):
    """Parameters of a template term that accept `asset_cfg` in place of the height sensor.

    Access of `asset_cfg` converts all terms of the template that read the sensor to legacy terms.
    """

    template: ManagerBasedRlEnvCfg | None = None

    def __missing__(self, key: str) -> Any:
        if key != "asset_cfg" or self.template is None:
            raise KeyError(key)
        for term in _height_terms(self.template):
            for name in [name for name, value in term.params.items() if value == _HEIGHT_SENSOR]:
                del term.params[name]
        scene = self.template.scene
        scene.sensors = tuple(cfg for cfg in scene.sensors if cfg.name != _HEIGHT_SENSOR)
        self[key] = SceneEntityCfg("robot", site_names=())
        return self[key]

    def __deepcopy__(self, memo: dict[int, Any]) -> _FeetParams:
        copied = _FeetParams({key: copy.deepcopy(value, memo) for key, value in self.items()})
        # A copied template refers to itself; a separately copied term refers to no template.
        copied.template = memo.get(id(self.template))
        return copied


def _height_terms(template: ManagerBasedRlEnvCfg) -> list[Any]:
    terms: list[Any] = list(template.rewards.values())
    for group in template.observations.values():
        terms += group.terms.values() if group else ()
    return [term for term in terms if term and _HEIGHT_SENSOR in term.params.values()]
