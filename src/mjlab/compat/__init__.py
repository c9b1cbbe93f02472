"""Backward compatibility with releases 1.1 to 1.6, as tables.

Task packages written against these releases use names, fields and signatures that later releases
renamed or removed. A module or class where they arrive says so in one line:

- `__getattr__ = older_names(__name__)` at the end of a module: names;
- `@offers_older_attributes` on a class: attributes of its instances;
- `@accepts_older_fields` on a config class: keyword arguments of its constructor;
- `accept_older_methods(term)` in the command manager: signatures of a term's methods;
- `@suggests_attributes` and `@suggests_fields` on a class: names of Isaac Lab, in error messages only;
- `translate_older(cfg)` in the environment: terms of a config, `@accepts_older_params` on a term: calls.

Each use warns once and names the replacement. Legacy names stay through 1.x and are removed in 2.0.
Those without a replacement are in `mjlab.compat.older`, `older_terms` and `older_scripts`, which are
imported on first use.
"""

from __future__ import annotations

import functools
import inspect
import pkgutil
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

C = TypeVar("C", bound=type)
T = TypeVar("T")
_COMPAT = "mjlab.compat."

# Names.


def _at(module: str, names: str) -> dict[str, str]:
    """Return the paths of `names` in a module, by name."""
    return {name: f"{module}:{name}" for name in names.split()}


_OLDER, _SCRIPTS = f"{_COMPAT}older", f"{_COMPAT}older_scripts"
_CUBES = "mjlab.tasks.manipulation.mdp.commands"
_MATH = _at(
    "mjlab.utils.lab_api.math",
    "apply_delta_pose matrix_from_quat quat_apply quat_apply_inverse quat_error_magnitude "
    "quat_from_euler_xyz quat_from_matrix quat_inv quat_mul sample_gaussian sample_log_uniform "
    "sample_uniform subtract_frame_transforms wrap_to_pi yaw_quat",
)
_REQUIRES = _at("mjlab.managers.event_manager", "requires_model_fields")
_SENSORS = "BuiltinSensor CameraSensor ContactSensor RayCastSensor TerrainHeightSensor"
_LOADERS = "list_tasks load_env_cfg load_rl_cfg load_runner_cls"
# Names that modules of these releases import for internal use, and packages import from there. Found
# in every module with `older_names`, even if no release had them there (`mjlab.utils.os.quat_mul`),
# without a warning.
_PASSED_ON = {
    **_MATH,
    **_REQUIRES,
    **_at("mjlab", "MJLAB_SRC_PATH"),
    **_at("mjlab.entity", "Entity EntityIndexing"),
    **_at("mjlab.envs", "ManagerBasedRlEnv"),
    **_at("mjlab.managers", "CommandTerm CommandTermCfg RewardTermCfg"),
    **_at("mjlab.rl", "MjlabOnPolicyRunner RslRlVecEnvWrapper"),
    **_at("mjlab.sensor", _SENSORS),
    **_at(_CUBES, "LiftingCommand MultiCubeLiftingCommand"),
    **_at("mjlab.tasks.registry", _LOADERS),
    **_at("mjlab.tasks.tracking.mdp.commands", "MotionCommand MotionCommandCfg"),
    **_at("mjlab.tasks.velocity.mdp", "UniformVelocityCommandCfg"),
    **_at("mjlab.utils.os", "get_checkpoint_path get_wandb_checkpoint_path"),
    **_at("mjlab.utils.wrappers", "VideoRecorder"),
    **_at("mjlab.viewer.debug_visualizer", "DebugVisualizer"),
}
_RANDOMIZE = (
    "randomize_effort_limits randomize_encoder_bias randomize_field randomize_pd_gains "
    "sync_actuator_delays"
)
_EVENTS = _at(_OLDER, f"FieldSpec {_RANDOMIZE}")
_XML_ACTUATORS = {
    f"Xml{kind}Actuator{suffix}": f"mjlab.actuator.xml_actuator:XmlActuator{suffix}"
    for kind in ("Motor", "Position", "Velocity", "Muscle")
    for suffix in ("", "Cfg")
}
_DELAYED_ACTUATORS = {
    "DelayedActuator": "mjlab.actuator.actuator:Actuator",
    **_at(_OLDER, "DelayedActuatorCfg"),
}
_REWARD_WEIGHT = _at(_OLDER, "RewardWeightStage reward_weight")
_TERRAIN_IMPORTER = {
    "TerrainImporter": "mjlab.terrains.terrain_entity:TerrainEntity",
    "TerrainImporterCfg": "mjlab.terrains.terrain_entity:TerrainEntityCfg",
}
_MESHES = (
    "create_primitive_mesh create_site_mesh get_body_name get_geom_texture_id get_site_name "
    "group_geoms_by_visual_compat is_fixed_body merge_geoms merge_sites rotation_matrix_from_vectors"
)
_VISER = {
    **_at("mjviser.conversions", _MESHES),
    **_at(_OLDER, "merge_geoms_global mujoco_mesh_to_trimesh rotation_quat_from_vectors"),
}
_DEMO = "ensure_asset_downloaded ensure_default_checkpoint ensure_default_motion"

# Replacement of each legacy name, as "module:name", by module.
_NAMES: dict[str, dict[str, str]] = {
    "mjlab.actuator": {**_XML_ACTUATORS, **_DELAYED_ACTUATORS},
    "mjlab.actuator.xml_actuator": _XML_ACTUATORS,
    "mjlab.actuator.delayed_actuator": _DELAYED_ACTUATORS,
    "mjlab.asset_zoo.robots.i2rt_yam.yam_constants": _at(_OLDER, "get_assets"),
    "mjlab.asset_zoo.robots.unitree_g1.g1_constants": _at(_OLDER, "get_assets"),
    "mjlab.asset_zoo.robots.unitree_go1.go1_constants": _at(_OLDER, "get_assets"),
    "mjlab.envs.mdp": {**_EVENTS, **_MATH, **_REQUIRES},
    "mjlab.envs.mdp.events": _EVENTS,
    "mjlab.envs.mdp.dr": _at(_OLDER, "sync_actuator_delays"),
    "mjlab.envs.mdp.dr.actuator": _at(_OLDER, "sync_actuator_delays"),
    "mjlab.scripts.cli": _at("mjlab.cli.main", "main"),
    "mjlab.scripts.csv_to_npz": _at(_SCRIPTS, "run_sim"),
    "mjlab.scripts.gcs": _at(_SCRIPTS, _DEMO),
    "mjlab.scripts.profile_env": _at("mjlab.envs.profiling", "StepProfile profiled_steps"),
    "mjlab.tasks.manipulation.mdp": {**_EVENTS, **_REWARD_WEIGHT},
    "mjlab.tasks.manipulation.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.registry": {"_REGISTRY": "mjlab.compat.older_scripts:REGISTRY"},
    "mjlab.tasks.tracking.mdp": _EVENTS,
    "mjlab.tasks.velocity.mdp": {**_EVENTS, **_REWARD_WEIGHT, **_at(_OLDER, "flat_orientation")},
    "mjlab.tasks.velocity.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.velocity.mdp.rewards": _at(_OLDER, "flat_orientation"),
    "mjlab.terrains": _TERRAIN_IMPORTER,
    "mjlab.terrains.heightfield_terrains": {
        "_compute_flat_patches": "mjlab.compat.older:compute_flat_patches"
    },
    "mjlab.terrains.terrain_importer": _TERRAIN_IMPORTER,
    "mjlab.utils.os": _at(_OLDER, "update_assets"),
    "mjlab.utils.spec": _at(_OLDER, "disable_collision"),
    "mjlab.viewer.base": _at(_OLDER, "Timer"),
    "mjlab.viewer.viser": _VISER,
    "mjlab.viewer.viser.conversions": _VISER,
}


@functools.cache
def _warn_once(message: str) -> None:
    """Warn of a legacy use, once per message."""
    # FutureWarning, because Python hides DeprecationWarning outside `__main__`.
    warnings.warn(message, FutureWarning, stacklevel=3)


def _replaced(name: str, path: str) -> str:
    """Return the message about a legacy name that `path` replaces."""
    if path.startswith(_COMPAT):
        return f"{name} is deprecated and will be removed in mjlab 2.0."
    return f"{name} is deprecated; use {path.replace(':', '.')}."


def older_names(module_name: str, exports: list[str] | None = None) -> Callable[[str], Any]:
    """Return a module `__getattr__` that resolves the module's legacy names.

    Args:
        module_name: Name of the module.
        exports: `__all__` of the module, to which its legacy functions are added, because packages build
            their `mdp` module with `from <module> import *`.
    """
    table = _NAMES.get(module_name, {})
    if exports is not None:
        exports += [name for name in table if name[0].islower() and name not in exports]

    def __getattr__(name: str) -> Any:
        path = table.get(name) or _PASSED_ON.get(name)
        if path is None:
            owner = "mdp" if ".mdp" in module_name else ""
            raise AttributeError(
                f"module {module_name!r} has no attribute {name!r}{_counterpart(owner, name)}"
            )
        value = pkgutil.resolve_name(path)
        # Legacy functions warn when they are called, because `import *` reads them.
        warns_later = path.startswith(_COMPAT) and inspect.isfunction(value)
        if not (warns_later or name in _PASSED_ON):
            _warn_once(_replaced(f"{module_name}.{name}", path))
        return value

    return __getattr__


def older_function(function: Any, name: str | None = None, path: str = _COMPAT) -> Any:
    """Decorator of a legacy function: warn when it is called.

    Args:
        function: Legacy function, or the one that replaces it.
        name: Legacy name, if `function` is not in `mjlab.compat.older`.
        path: Path of `function` to recommend.
    """
    message = _replaced(name or function.__name__, path)

    # `wraps` also copies the function's attributes, such as the model fields it randomizes.
    @functools.wraps(function)
    def older(*args: Any, **kwargs: Any) -> Any:
        _warn_once(message)
        return function(*args, **kwargs)

    if name is not None:
        # Pickled by its path.
        older.__module__, older.__qualname__ = _OLDER, name
    return older


# Attributes of instances.

_ATTRIBUTES: dict[str, dict[str, Callable[[Any], Any] | str]] = {
    "Actuator": {
        # Delays are part of each actuator, not of another around it.
        "base_actuator": lambda actuator: actuator,
        "command_field": lambda actuator: getattr(actuator, "command_fields", ("position",))[0],
    },
    "ContactSensor": {"_slots": "mjlab.compat.older:contact_slots"},
    "CurriculumManager": {"_curriculum_state": lambda manager: manager._state},
    "DifferentialIKAction": {"_joint_ids": "mjlab.compat.older:ik_joint_ids"},
    "EntityData": {
        "generalized_force": lambda data: data._columns("qfrc_applied", data._joint_v),
    },
    "EventManager": {
        "_mode_term_cfgs": lambda manager: {
            mode: [manager.get_term_cfg(name) for name in names]
            for mode, names in manager.active_terms.items()
        },
        "_mode_term_names": lambda manager: manager.active_terms,
    },
    "MetricsManager": {
        "_episode_sums": lambda manager: dict(zip(manager.active_terms, manager._sum, strict=True)),
        "_step_count": lambda manager: manager._steps.long(),
    },
    "ObservationManager": {
        "_group_obs_concatenate": lambda manager: manager.group_obs_concatenate,
        "_group_obs_dim": lambda manager: manager.group_obs_dim,
        "_group_obs_term_cfgs": lambda manager: {
            group: [manager.get_term_cfg(group, term) for term in terms]
            for group, terms in manager.active_terms.items()
        },
        "_group_obs_term_dim": lambda manager: manager.group_obs_term_dim,
        "_group_obs_term_names": lambda manager: manager.active_terms,
    },
    "RewardManager": {
        "_episode_sums": lambda manager: {
            name: manager.episode_sum(name) for name in manager.active_terms
        },
    },
    "TerminationManager": {
        "_term_dones": lambda manager: {
            name: manager.get_term(name) for name in manager.active_terms
        },
        "_terminated_buf": lambda manager: manager.terminated,
        "_truncated_buf": lambda manager: manager.time_outs,
    },
}


class _OlderAttribute:
    """Attribute computed by a function. One that an instance sets hides it, unlike a property."""

    def __init__(self, function: Callable[[Any], Any] | str, message: str) -> None:
        self._function = function
        self._message = message

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            return self
        _warn_once(self._message)
        function: Any = self._function
        return (pkgutil.resolve_name(function) if isinstance(function, str) else function)(instance)


def offers_older_attributes(cls: C) -> C:
    """Class decorator: add legacy attributes."""
    for name, function in _ATTRIBUTES[cls.__name__].items():
        message = f"{cls.__name__}.{name} is deprecated and will be removed in mjlab 2.0."
        setattr(cls, name, _OlderAttribute(function, message))
    return cls


# Keyword arguments of configs.

_GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}


def _set_distribution(value: Any, fields: dict[str, Any], key: str) -> None:
    present = fields.get("distribution_cfg")
    if key == "stochastic":
        fields["distribution_cfg"] = dict(present or _GAUSSIAN) if value else None
    # Models without `stochastic` were deterministic and ignored their noise settings.
    elif present:
        fields["distribution_cfg"] = {**present, key: value}


def _scale_deltas(value: Any, fields: dict[str, Any]) -> None:
    for name in ("delta_pos_scale", "delta_ori_scale"):
        fields[name] = value * fields.get(name, 1.0)


# Legacy fields by class, with replacement and translation, applied in this order. A translation
# receives the value and the keyword arguments, and may modify these. None: the value has no effect.
_Translation = Callable[[Any, dict[str, Any]], None]
_FIELDS: dict[str, dict[str, tuple[str, _Translation | None]]] = {
    "DifferentialIKActionCfg": {"scale": ("delta_pos_scale and delta_ori_scale", _scale_deltas)},
    "EventTermCfg": {
        "domain_randomization": ("nothing: fields are expanded as the function declares", None)
    },
    "RslRlModelCfg": {
        "stochastic": (
            "distribution_cfg (None for a deterministic model)",
            functools.partial(_set_distribution, key="stochastic"),
        ),
        "init_noise_std": (
            "distribution_cfg={'init_std': ...}",
            functools.partial(_set_distribution, key="init_std"),
        ),
        "noise_std_type": (
            "distribution_cfg={'std_type': ...}",
            functools.partial(_set_distribution, key="std_type"),
        ),
    },
    "MujocoCfg": {
        # MuJoCo now enables multiccd by default, with a flag to disable it.
        "multiccd": (
            "disableflags=('multiccd',) to disable multiccd",
            lambda value, fields: fields.update(
                disableflags=(*fields.get("disableflags", ()), *(() if value else ("multiccd",)))
            ),
        )
    },
}
# MuJoCo features that are now enabled by default; earlier releases enabled them explicitly.
ALWAYS_ENABLED_FLAGS = frozenset({"multiccd"})


def accepts_older_fields(config_class: C) -> C:
    """Class decorator of configs: translate legacy keyword arguments."""
    cls: Any = config_class
    fields = _FIELDS[cls.__name__]
    init = cls.__init__

    @functools.wraps(init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        for name in [name for name in fields if name in kwargs]:
            today, translate = fields[name]
            value = kwargs.pop(name)
            _warn_once(f"{cls.__name__}.{name} is deprecated; use {today}.")
            if translate is not None:
                translate(value, kwargs)
        init(self, *args, **kwargs)

    cls.__init__ = __init__
    return config_class


# Names of Isaac Lab.


def _counterpart(owner: str, name: str) -> str:
    """Return "; use X" if Isaac Lab's `name` is X here, else an empty string."""
    from mjlab.compat.isaac_lab import ATTRIBUTES

    today = ATTRIBUTES.get(owner, {}).get(name)
    return "" if today is None else f"; use {today}."


def suggests_attributes(cls: C) -> C:
    """Class decorator: name the attribute here in the error for one of Isaac Lab."""

    def __getattr__(self: Any, name: str) -> Any:
        try:
            # Raises the error again, which may be of a property's code.
            return object.__getattribute__(self, name)
        except AttributeError as error:
            use = "" if hasattr(type(self), name) else _counterpart(cls.__name__, name)
            if not use:
                raise
            raise AttributeError(f"{error}{use}", name=name, obj=self) from None

    cast("Any", cls).__getattr__ = __getattr__
    return cls


def suggested_field(config_class: type, name: str) -> str | None:
    """Return the field of a config class that Isaac Lab calls `name`, None if there is none."""
    from mjlab.compat.isaac_lab import FIELDS

    today = FIELDS.get(name)
    return today if today in getattr(config_class, "__dataclass_fields__", ()) else None


def suggests_fields(config_class: C) -> C:
    """Class decorator of configs: name the field here in the error for one of Isaac Lab."""
    cls: Any = config_class
    init = cls.__init__

    @functools.wraps(init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        for name in kwargs:
            today = None if name in cls.__dataclass_fields__ else suggested_field(cls, name)
            if today is not None:
                raise TypeError(f"{cls.__name__}: unknown field {name!r}; use {today}.")
        init(self, *args, **kwargs)

    cls.__init__ = __init__
    return config_class


# Signatures of command terms.

# Argument of today's method that older ones lack, its position, and the function that calls these.
_METHODS = {
    "_update_command": ("env_ids", 0, "mjlab.compat.older_commands:update_command"),
    "compute": ("env_ids", 1, "mjlab.compat.older_commands:compute"),
    "create_gui": ("request_action", 4, "mjlab.compat.older_commands:create_gui"),
}


def accept_older_methods(term: Any) -> None:
    """Let a command term with methods of earlier releases be called with today's arguments."""
    for name, (argument, position, caller) in _METHODS.items():
        method = getattr(term, name)
        if not inspect.ismethod(method):
            continue
        parameters = list(inspect.signature(method).parameters.values())
        ordered = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        takes_any = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        by_name = argument in [p.name for p in ordered[position:][:1]]
        if takes_any or by_name or sum(p.default is p.empty for p in ordered) > position:
            continue
        _warn_once(
            f"{method.__qualname__} without argument {argument} is deprecated; add {argument}."
        )
        setattr(term, name, functools.partial(pkgutil.resolve_name(caller), method))


# Foot terms.

# Terms that read sites of `asset_cfg` in earlier releases and now read a sensor: the parameter for
# the sensor, and the term for calls without it, as "module:name".
_OLDER_PARAMS: dict[str, tuple[str, str]] = {
    "foot_height": ("sensor_name", "mjlab.compat.older_terms:foot_height"),
    "feet_clearance": ("height_sensor_name", "mjlab.compat.older_terms:feet_clearance"),
    "feet_swing_height": ("height_sensor_name", "mjlab.compat.older_terms:feet_swing_height"),
}


def accepts_older_params(term: T) -> T:
    """Decorator for foot terms: calls with sites in `asset_cfg` and without a sensor use the older term."""
    today: Any = term
    sensor, path = _OLDER_PARAMS[today.__name__]
    names = list(inspect.signature(today).parameters)

    @functools.wraps(today)
    def either(*args: Any, **kwargs: Any) -> Any:
        params = dict(zip(names, args, strict=False)) | kwargs
        if isinstance(params.get(sensor), str) or not {"asset_cfg", sensor} & params.keys():
            return today(*args, **kwargs)
        warn_of_sites(today.__name__)
        return pkgutil.resolve_name(path)(*args, **kwargs)

    return cast(T, either)


def warn_of_sites(name: str) -> None:
    """Warn once that a foot term reads sites instead of its sensor."""
    sensor = _OLDER_PARAMS[name][0]
    _warn_once(
        f"{name} without {sensor} is deprecated (site heights above z = 0, as in releases 1.1 and "
        f"1.2); set {sensor}."
    )


def translate_older(cfg: Any) -> None:
    """Translate an environment config that a package of an older release filled in, in place."""
    groups = [group.terms for group in cfg.observations.values() if group is not None]
    terms = [term for terms in (cfg.rewards, *groups) for term in terms.values()]
    # The template gives its foot terms sites left empty; packages replace their functions and sensors.
    feet = [
        term
        for term in terms
        if hasattr(getattr(term, "params", {}).get("asset_cfg"), "site_names")
        and (
            term.params["asset_cfg"].site_names in ((), [])
            or reads_foot_scan(term)
            or getattr(term.func, "__name__", "") in _OLDER_PARAMS
        )
    ]
    if feet:
        pkgutil.resolve_name("mjlab.compat.older_terms:use_older_foot_terms")(cfg, feet)
    for event in cfg.events.values():
        func = getattr(event, "func", None)
        path = getattr(func, "__module__", ""), getattr(func, "__name__", "")
        if path == (_OLDER, "randomize_field"):
            _warn_once(
                "randomize_field is deprecated; use the function of the field in mjlab.envs.mdp.dr."
            )
            pkgutil.resolve_name(f"{_OLDER}:use_field_term")(event)


FOOT_SCAN = "foot_height_scan"
"""Height sensor of the velocity template."""


def reads_foot_scan(term: Any) -> bool:
    """Return True if a parameter of a term is the height sensor of the velocity template."""
    return FOOT_SCAN in [value for value in term.params.values() if isinstance(value, str)]
