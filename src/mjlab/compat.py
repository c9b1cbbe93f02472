"""Names and defaults of earlier 1.x releases, accepted here and nowhere else.

Task packages in the field were written against any release from 1.1 to 1.6. What a later release
renamed, dropped or made stricter still works: a module that once offered more names ends with
`__getattr__ = older_names(__name__)`, and a config class that once took more fields, or demanded
fewer, carries `@accepts_older_fields`. Each use warns once, naming today's spelling.

Nothing is imported before an older name is asked for.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

C = TypeVar("C", bound=type)

# Where an older name lives today, as "module:name"; "this module" is the key's own module.
_EVENTS = {
    "EntityIndexing": "mjlab.entity:EntityIndexing",
    "FieldSpec": "mjlab.envs.mdp.dr.older:FieldSpec",
    "randomize_effort_limits": "mjlab.envs.mdp.dr:effort_limits",
    "randomize_encoder_bias": "mjlab.envs.mdp.dr:encoder_bias",
    "randomize_field": "mjlab.envs.mdp.dr.older:randomize_field",
    "randomize_pd_gains": "mjlab.envs.mdp.dr:pd_gains",
    "requires_model_fields": "mjlab.managers.event_manager:requires_model_fields",
    "sample_gaussian": "mjlab.utils.lab_api.math:sample_gaussian",
    "sample_log_uniform": "mjlab.utils.lab_api.math:sample_log_uniform",
    "sync_actuator_delays": "mjlab.envs.mdp.dr.older:sync_actuator_delays",
}
_REWARD_WEIGHT = {
    "RewardWeightStage": "mjlab.envs.mdp.older_curriculums:RewardWeightStage",
    "reward_weight": "mjlab.envs.mdp.older_curriculums:reward_weight",
}
_XML_ACTUATORS = {
    f"Xml{kind}Actuator{suffix}": f"mjlab.actuator.xml_actuator:XmlActuator{suffix}"
    for kind in ("Motor", "Position", "Velocity", "Muscle")
    for suffix in ("", "Cfg")
}
_DELAYED_ACTUATORS = {
    name: f"mjlab.actuator.older:{name}" for name in ("DelayedActuator", "DelayedActuatorCfg")
}
_TERRAIN_IMPORTER = {
    "TerrainImporter": "mjlab.terrains.terrain_entity:TerrainEntity",
    "TerrainImporterCfg": "mjlab.terrains.terrain_entity:TerrainEntityCfg",
}
_GET_ASSETS = {"get_assets": "mjlab.asset_zoo.older:get_assets"}

_NAMES: dict[str, dict[str, str]] = {
    "mjlab.actuator": {**_XML_ACTUATORS, **_DELAYED_ACTUATORS},
    "mjlab.actuator.xml_actuator": _XML_ACTUATORS,
    "mjlab.asset_zoo.robots.i2rt_yam.yam_constants": _GET_ASSETS,
    "mjlab.asset_zoo.robots.unitree_g1.g1_constants": _GET_ASSETS,
    "mjlab.asset_zoo.robots.unitree_go1.go1_constants": _GET_ASSETS,
    "mjlab.envs.mdp": _EVENTS,
    "mjlab.envs.mdp.events": _EVENTS,
    "mjlab.envs.mdp.dr": {"sync_actuator_delays": _EVENTS["sync_actuator_delays"]},
    "mjlab.envs.mdp.dr.actuator": {"sync_actuator_delays": _EVENTS["sync_actuator_delays"]},
    "mjlab.tasks.manipulation.mdp": {**_EVENTS, **_REWARD_WEIGHT},
    "mjlab.tasks.manipulation.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.tracking.mdp": _EVENTS,
    "mjlab.tasks.velocity.mdp": {
        **_EVENTS,
        **_REWARD_WEIGHT,
        "flat_orientation": "mjlab.tasks.velocity.mdp.older:flat_orientation",
    },
    "mjlab.tasks.velocity.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.velocity.mdp.rewards": {
        "flat_orientation": "mjlab.tasks.velocity.mdp.older:flat_orientation"
    },
    "mjlab.terrains": _TERRAIN_IMPORTER,
    "mjlab.utils.os": {"update_assets": "mjlab.asset_zoo.older:update_assets"},
    "mjlab.utils.spec": {"disable_collision": "mjlab.utils.older_spec:disable_collision"},
}

# Fields that a class once had, with what becomes of a value given for them. A translation gets
# the value and the keyword arguments, which it may change; None means the value has no effect.
_Translation = Callable[[Any, dict[str, Any]], None]
_REQUIRED_BEFORE_1_6 = {"contype": 1, "conaffinity": 1, "condim": 3, "priority": 0}


def _set_std(value: Any, fields: dict[str, Any], key: str) -> None:
    distribution = dict(fields.get("distribution_cfg") or {"class_name": "GaussianDistribution"})
    distribution[key] = value
    fields["distribution_cfg"] = distribution


_DROPPED_FIELDS: dict[str, dict[str, tuple[str, _Translation | None]]] = {
    "EventTermCfg": {
        "domain_randomization": ("nothing: fields are expanded as the function declares", None)
    },
    "RslRlModelCfg": {
        "init_noise_std": (
            "distribution_cfg={'init_std': ...}",
            functools.partial(_set_std, key="init_std"),
        ),
        "noise_std_type": (
            "distribution_cfg={'std_type': ...}",
            functools.partial(_set_std, key="std_type"),
        ),
        "stochastic": ("distribution_cfg (None for a deterministic model)", None),
    },
    "DifferentialIKActionCfg": {"scale": ("delta_pos_scale and delta_ori_scale", None)},
    "MujocoCfg": {
        "multiccd": (
            "enableflags=('multiccd',)",
            lambda value, fields: fields.update(
                enableflags=(*fields.get("enableflags", ()), *(("multiccd",) if value else ()))
            ),
        )
    },
}
_LOOSE_DEFAULTS: dict[str, dict[str, Any]] = {"CollisionCfg": _REQUIRED_BEFORE_1_6}


@functools.cache
def _warn_once(message: str) -> None:
    warnings.warn(message, DeprecationWarning, stacklevel=4)


def older_names(module_name: str) -> Callable[[str], Any]:
    """Return a module `__getattr__` that resolves names which earlier releases offered there."""
    table = _NAMES.get(module_name, {})

    def __getattr__(name: str) -> Any:
        if name not in table:
            raise AttributeError(f"module {module_name!r} has no attribute {name!r}")
        home, _, today = table[name].partition(":")
        value = getattr(importlib.import_module(home), today)
        _warn_once(f"{module_name}.{name} is an older name; today it is {home}.{today}.")
        return value

    return __getattr__


def accepts_older_fields(cls: C) -> C:
    """Class decorator for configs: take fields that were dropped, and defaults that were lost."""
    dropped = _DROPPED_FIELDS.get(cls.__name__, {})
    defaults = _LOOSE_DEFAULTS.get(cls.__name__, {})
    plain_init: Any = cls.__init__
    positions = [field.name for field in dataclasses.fields(cls) if field.init]

    @functools.wraps(plain_init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        for name in dropped.keys() & kwargs.keys():
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
    return cls
