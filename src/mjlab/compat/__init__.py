"""Names and defaults of earlier 1.x releases, accepted here and nowhere else.

Task packages in the field were written against any release from 1.1 to 1.6. What a later release
renamed, dropped or made stricter still works: a module that once offered more names ends with
`__getattr__ = older_names(__name__)`, and a config class that once took more fields, or demanded
fewer, carries `@accepts_older_fields`.

Deprecation policy: each use warns once, naming today's spelling, and all of it stays through 1.x
and is removed in 2.0.

Nothing is imported before an older name is asked for. Names without a successor are in
`mjlab.compat.older`.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

C = TypeVar("C", bound=type)

# Where an older name lives today, as "module:name".
_EVENTS = {
    "EntityIndexing": "mjlab.entity:EntityIndexing",
    "FieldSpec": "mjlab.compat.older:FieldSpec",
    "randomize_effort_limits": "mjlab.envs.mdp.dr:effort_limits",
    "randomize_encoder_bias": "mjlab.envs.mdp.dr:encoder_bias",
    "randomize_field": "mjlab.compat.older:randomize_field",
    "randomize_pd_gains": "mjlab.envs.mdp.dr:pd_gains",
    "requires_model_fields": "mjlab.managers.event_manager:requires_model_fields",
    "sample_gaussian": "mjlab.utils.lab_api.math:sample_gaussian",
    "sample_log_uniform": "mjlab.utils.lab_api.math:sample_log_uniform",
    "sync_actuator_delays": "mjlab.compat.older:sync_actuator_delays",
}
_XML_ACTUATORS = {
    f"Xml{kind}Actuator{suffix}": f"mjlab.actuator.xml_actuator:XmlActuator{suffix}"
    for kind in ("Motor", "Position", "Velocity", "Muscle")
    for suffix in ("", "Cfg")
}
_DELAYED_ACTUATORS = {
    name: f"mjlab.compat.older:{name}" for name in ("DelayedActuator", "DelayedActuatorCfg")
}
_REWARD_WEIGHT = {
    name: f"mjlab.compat.older:{name}" for name in ("RewardWeightStage", "reward_weight")
}
_FLAT_ORIENTATION = {"flat_orientation": "mjlab.compat.older:flat_orientation"}
_TERRAIN_IMPORTER = {
    "TerrainImporter": "mjlab.terrains.terrain_entity:TerrainEntity",
    "TerrainImporterCfg": "mjlab.terrains.terrain_entity:TerrainEntityCfg",
}
_ROBOT_FILES = {"get_assets": "mjlab.compat.older:get_assets"}
_VISER = {
    name: f"mjviser.conversions:{name}"
    for name in (
        "create_primitive_mesh",
        "create_site_mesh",
        "get_body_name",
        "get_geom_texture_id",
        "get_site_name",
        "group_geoms_by_visual_compat",
        "is_fixed_body",
        "merge_geoms",
        "merge_sites",
        "mujoco_mesh_to_trimesh",
        "rotation_matrix_from_vectors",
    )
}
_VISER["rotation_quat_from_vectors"] = "mjlab.compat.older:rotation_quat_from_vectors"

_NAMES: dict[str, dict[str, str]] = {
    "mjlab.actuator": {**_XML_ACTUATORS, **_DELAYED_ACTUATORS},
    "mjlab.actuator.xml_actuator": _XML_ACTUATORS,
    "mjlab.actuator.delayed_actuator": _DELAYED_ACTUATORS,
    "mjlab.asset_zoo.robots.i2rt_yam.yam_constants": _ROBOT_FILES,
    "mjlab.asset_zoo.robots.unitree_g1.g1_constants": _ROBOT_FILES,
    "mjlab.asset_zoo.robots.unitree_go1.go1_constants": _ROBOT_FILES,
    "mjlab.envs.mdp": _EVENTS,
    "mjlab.envs.mdp.events": _EVENTS,
    "mjlab.envs.mdp.dr": {"sync_actuator_delays": _EVENTS["sync_actuator_delays"]},
    "mjlab.envs.mdp.dr.actuator": {"sync_actuator_delays": _EVENTS["sync_actuator_delays"]},
    "mjlab.tasks.manipulation.mdp": {**_EVENTS, **_REWARD_WEIGHT},
    "mjlab.tasks.manipulation.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.tracking.mdp": _EVENTS,
    "mjlab.tasks.velocity.mdp": {**_EVENTS, **_REWARD_WEIGHT, **_FLAT_ORIENTATION},
    "mjlab.tasks.velocity.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.velocity.mdp.rewards": _FLAT_ORIENTATION,
    "mjlab.terrains": _TERRAIN_IMPORTER,
    "mjlab.terrains.terrain_importer": _TERRAIN_IMPORTER,
    "mjlab.utils.os": {"update_assets": "mjlab.compat.older:update_assets"},
    "mjlab.utils.spec": {"disable_collision": "mjlab.compat.older:disable_collision"},
    "mjlab.viewer.base": {"Timer": "mjlab.compat.older:Timer"},
    "mjlab.viewer.viser": _VISER,
}

# Fields that a class once had, with what becomes of a value given for them, in this order. A
# translation gets the value and the keyword arguments, which it may change; None means that the
# value has no effect.
_Translation = Callable[[Any, dict[str, Any]], None]
_REQUIRED_BEFORE_1_6 = {"contype": 1, "conaffinity": 1, "condim": 3, "priority": 0}


_GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}


def _set_std(value: Any, fields: dict[str, Any], key: str) -> None:
    # Models were deterministic unless they said `stochastic`, and then ignored their noise.
    if fields.get("distribution_cfg"):
        fields["distribution_cfg"] = {**fields["distribution_cfg"], key: value}


def _set_stochastic(value: Any, fields: dict[str, Any]) -> None:
    fields["distribution_cfg"] = (
        dict(fields.get("distribution_cfg") or _GAUSSIAN) if value else None
    )


def _scale_deltas(value: Any, fields: dict[str, Any]) -> None:
    for name in ("delta_pos_scale", "delta_ori_scale"):
        fields[name] = value * fields.get(name, 1.0)


_DROPPED_FIELDS: dict[str, dict[str, tuple[str, _Translation | None]]] = {
    "DifferentialIKActionCfg": {"scale": ("delta_pos_scale and delta_ori_scale", _scale_deltas)},
    "EventTermCfg": {
        "domain_randomization": ("nothing: fields are expanded as the function declares", None)
    },
    "RslRlModelCfg": {
        "stochastic": ("distribution_cfg (None for a deterministic model)", _set_stochastic),
        "init_noise_std": (
            "distribution_cfg={'init_std': ...}",
            functools.partial(_set_std, key="init_std"),
        ),
        "noise_std_type": (
            "distribution_cfg={'std_type': ...}",
            functools.partial(_set_std, key="std_type"),
        ),
    },
    "MujocoCfg": {
        # Today's MuJoCo has it on, and a flag that switches it off.
        "multiccd": (
            "disableflags=('multiccd',) to switch it off",
            lambda value, fields: fields.update(
                disableflags=(*fields.get("disableflags", ()), *(() if value else ("multiccd",)))
            ),
        )
    },
}
# MuJoCo features that earlier releases had to enable and today's has on.
ALWAYS_ENABLED_FLAGS = frozenset({"multiccd"})
_LOOSE_DEFAULTS: dict[str, dict[str, Any]] = {"CollisionCfg": _REQUIRED_BEFORE_1_6}


@functools.cache
def _warn_once(message: str) -> None:
    # A FutureWarning, because Python hides deprecations from those who run a package.
    warnings.warn(message, FutureWarning, stacklevel=3)


def older_names(module_name: str) -> Callable[[str], Any]:
    """Return a module `__getattr__` that resolves names which earlier releases offered there."""
    table = _NAMES.get(module_name, {})

    def __getattr__(name: str) -> Any:
        if name not in table:
            raise AttributeError(f"module {module_name!r} has no attribute {name!r}")
        home, _, today = table[name].partition(":")
        value = getattr(importlib.import_module(home), today)
        message = f"{module_name}.{name} is an older name; today it is {home}.{today}."
        if inspect.isfunction(value):
            return _warning_when_called(value, message)
        _warn_once(message)
        return value

    return __getattr__


def older_exports(module_name: str) -> list[str]:
    """Return the older names of a module that `from <module> import *` has to bring along.

    Task packages build their own `mdp` module that way, so these belong in `__all__`. Only
    functions: they warn when they are called, so that the import itself stays quiet.
    """
    return [name for name in _NAMES[module_name] if name[0].islower()]


def _warning_when_called(function: Callable[..., Any], message: str) -> Callable[..., Any]:
    # `wraps` also carries over what the function declares: the model fields it randomizes.
    @functools.wraps(function)
    def older(*args: Any, **kwargs: Any) -> Any:
        _warn_once(message)
        return function(*args, **kwargs)

    return older


def accepts_older_fields(config_class: C) -> C:
    """Class decorator for configs: take fields that were dropped, and defaults that were lost."""
    cls: Any = config_class
    dropped = _DROPPED_FIELDS.get(cls.__name__, {})
    defaults = _LOOSE_DEFAULTS.get(cls.__name__, {})
    plain_init = cls.__init__
    positions = [field.name for field in dataclasses.fields(cls) if field.init]

    @functools.wraps(plain_init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        for name in [name for name in dropped if name in kwargs]:
            today, translate = dropped[name]
            value = kwargs.pop(name)
            _warn_once(f"{cls.__name__}.{name} is an older field; today use {today}.")
            if translate is not None:
                translate(value, kwargs)
        for name, value in defaults.items():
            if name not in kwargs and name not in positions[: len(args)]:
                kwargs[name] = value
                _warn_once(f"{cls.__name__}.{name} has to be given today; {value!r} is assumed.")
        plain_init(self, *args, **kwargs)

    cls.__init__ = __init__
    return config_class


def set_array_field(field: Any, values: Any) -> None:
    """Write `values` into the first elements of an array field of a spec; None leaves it."""
    for index, value in enumerate(values or ()):
        field[index] = value
