"""Backward compatibility with releases 1.1 to 1.6: legacy names, fields, defaults and signatures.

Names that later releases renamed, removed or made stricter still work for task packages written
against releases 1.1 to 1.6. Modules with legacy names end with `__getattr__ = older_names(__name__)`;
config classes with legacy fields or defaults have the decorator `@accepts_older_fields`.

Deprecation policy: each use warns once and names the replacement. Legacy names stay through 1.x and
are removed in 2.0.

Implementations are imported on first access. Legacy names without a replacement are in
`mjlab.compat.older` and `mjlab.compat.older_scripts`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import pkgutil
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

C = TypeVar("C", bound=type)
T = TypeVar("T")

# Replacement of each legacy name, as "module:name".
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

# Names that 1.6 modules imported for internal use, and packages import from these modules.
_MATH = "mjlab.utils.lab_api.math"
_HOMES = {
    "BuiltinSensor": "mjlab.sensor",
    "CameraSensor": "mjlab.sensor",
    "CommandTerm": "mjlab.managers",
    "CommandTermCfg": "mjlab.managers",
    "ContactSensor": "mjlab.sensor",
    "DebugVisualizer": "mjlab.viewer.debug_visualizer",
    "Entity": "mjlab.entity",
    "LiftingCommand": "mjlab.tasks.manipulation.mdp.commands",
    "MJLAB_SRC_PATH": "mjlab",
    "ManagerBasedRlEnv": "mjlab.envs",
    "MjlabOnPolicyRunner": "mjlab.rl",
    "MotionCommand": "mjlab.tasks.tracking.mdp.commands",
    "MotionCommandCfg": "mjlab.tasks.tracking.mdp.commands",
    "MultiCubeLiftingCommand": "mjlab.tasks.manipulation.mdp.commands",
    "RayCastSensor": "mjlab.sensor",
    "RewardTermCfg": "mjlab.managers",
    "RslRlVecEnvWrapper": "mjlab.rl",
    "TerrainHeightSensor": "mjlab.sensor",
    "UniformVelocityCommandCfg": "mjlab.tasks.velocity.mdp",
    "VideoRecorder": "mjlab.utils.wrappers",
    "get_checkpoint_path": "mjlab.utils.os",
    "get_wandb_checkpoint_path": "mjlab.utils.os",
    "list_tasks": "mjlab.tasks.registry",
    "load_env_cfg": "mjlab.tasks.registry",
    "load_rl_cfg": "mjlab.tasks.registry",
    "load_runner_cls": "mjlab.tasks.registry",
}
_SCRIPTS = (
    "ManagerBasedRlEnv MjlabOnPolicyRunner MotionCommandCfg RslRlVecEnvWrapper VideoRecorder "
    "get_wandb_checkpoint_path list_tasks load_env_cfg load_rl_cfg load_runner_cls"
)
_TRACKING = (
    "matrix_from_quat quat_apply quat_error_magnitude quat_from_euler_xyz quat_inv quat_mul "
    "sample_uniform yaw_quat"
)
_PASSED_THROUGH = {
    "mjlab.asset_zoo.robots.i2rt_yam.yam_constants": "MJLAB_SRC_PATH",
    "mjlab.asset_zoo.robots.unitree_g1.g1_constants": "MJLAB_SRC_PATH",
    "mjlab.asset_zoo.robots.unitree_go1.go1_constants": "MJLAB_SRC_PATH",
    "mjlab.entity.data": "quat_apply quat_apply_inverse quat_from_matrix quat_mul",
    "mjlab.envs.mdp": "quat_apply quat_from_euler_xyz quat_mul",
    "mjlab.envs.mdp.actions.differential_ik": "apply_delta_pose",
    "mjlab.envs.mdp.dr.body": "matrix_from_quat quat_from_matrix",
    "mjlab.envs.mdp.events": "Entity quat_apply",
    "mjlab.envs.mdp.observations": "Entity RayCastSensor",
    "mjlab.envs.mdp.rewards": "Entity RewardTermCfg",
    "mjlab.scripts.play": _SCRIPTS,
    "mjlab.scripts.train": f"{_SCRIPTS} get_checkpoint_path",
    "mjlab.sensor.raycast_sensor": "quat_from_matrix",
    "mjlab.tasks.manipulation.mdp": "quat_apply quat_from_euler_xyz quat_inv quat_mul",
    "mjlab.tasks.manipulation.mdp.commands": (
        "CommandTerm CommandTermCfg Entity quat_from_euler_xyz sample_uniform"
    ),
    "mjlab.tasks.manipulation.mdp.observations": (
        "CameraSensor Entity LiftingCommand MultiCubeLiftingCommand quat_apply quat_inv"
    ),
    "mjlab.tasks.manipulation.mdp.rewards": "Entity LiftingCommand MultiCubeLiftingCommand",
    "mjlab.tasks.manipulation.mdp.terminations": "ContactSensor",
    "mjlab.tasks.tracking.mdp": f"{_TRACKING} quat_apply_inverse",
    "mjlab.tasks.tracking.mdp.commands": f"{_TRACKING} CommandTerm CommandTermCfg DebugVisualizer",
    "mjlab.tasks.tracking.mdp.observations": (
        "MotionCommand matrix_from_quat subtract_frame_transforms"
    ),
    "mjlab.tasks.tracking.mdp.rewards": "ContactSensor MotionCommand",
    "mjlab.tasks.tracking.mdp.terminations": "MotionCommand",
    "mjlab.tasks.velocity.mdp": (
        "matrix_from_quat quat_apply quat_apply_inverse quat_from_euler_xyz quat_mul wrap_to_pi"
    ),
    "mjlab.tasks.velocity.mdp.curriculums": "Entity UniformVelocityCommandCfg",
    "mjlab.tasks.velocity.mdp.observations": "ContactSensor TerrainHeightSensor",
    "mjlab.tasks.velocity.mdp.rewards": (
        "BuiltinSensor ContactSensor Entity RewardTermCfg TerrainHeightSensor"
    ),
    "mjlab.tasks.velocity.mdp.terminations": "ContactSensor Entity",
    "mjlab.tasks.velocity.mdp.velocity_command": "Entity matrix_from_quat",
}

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
    "mjlab.scripts.csv_to_npz": {"run_sim": "mjlab.compat.older_scripts:run_sim"},
    "mjlab.scripts.gcs": {
        name: f"mjlab.compat.older_scripts:{name}"
        for name in (
            "ensure_asset_downloaded",
            "ensure_default_checkpoint",
            "ensure_default_motion",
        )
    },
    "mjlab.tasks.manipulation.mdp": {**_EVENTS, **_REWARD_WEIGHT},
    "mjlab.tasks.manipulation.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.registry": {"_REGISTRY": "mjlab.compat.older_scripts:REGISTRY"},
    "mjlab.tasks.tracking.mdp": _EVENTS,
    "mjlab.tasks.velocity.mdp": {**_EVENTS, **_REWARD_WEIGHT, **_FLAT_ORIENTATION},
    "mjlab.tasks.velocity.mdp.curriculums": _REWARD_WEIGHT,
    "mjlab.tasks.velocity.mdp.rewards": _FLAT_ORIENTATION,
    "mjlab.terrains": _TERRAIN_IMPORTER,
    "mjlab.terrains.heightfield_terrains": {
        "_compute_flat_patches": "mjlab.compat.older:compute_flat_patches"
    },
    "mjlab.terrains.terrain_importer": _TERRAIN_IMPORTER,
    "mjlab.utils.os": {"update_assets": "mjlab.compat.older:update_assets"},
    "mjlab.utils.spec": {"disable_collision": "mjlab.compat.older:disable_collision"},
    "mjlab.viewer.base": {"Timer": "mjlab.compat.older:Timer"},
    "mjlab.viewer.viser": {
        **_VISER,
        "mujoco_mesh_to_trimesh": "mjlab.viewer.viser.conversions:mujoco_mesh_to_trimesh",
    },
    "mjlab.viewer.viser.conversions": _VISER,
}

# Legacy static methods by class, with their replacement.
_STATIC_METHODS: dict[str, dict[str, str]] = {
    "MjlabViserScene": {"create": "mjlab.viewer.viser.scene:MjlabViserScene"},
}

for _module, _passed in _PASSED_THROUGH.items():
    _NAMES[_module] = {
        **{name: f"{_HOMES.get(name, _MATH)}:{name}" for name in _passed.split()},
        **_NAMES.get(_module, {}),
    }

# Legacy attributes by class, with the function that computes their value.
_ATTRIBUTES: dict[str, dict[str, str]] = {
    "Actuator": {"base_actuator": "base_actuator", "command_field": "command_field"},
    "ContactSensor": {"_slots": "contact_slots"},
    "CurriculumManager": {"_curriculum_state": "curriculum_state"},
    "DifferentialIKAction": {"_joint_ids": "ik_joint_ids"},
    "EntityData": {"generalized_force": "generalized_force"},
    "EventManager": {
        "_mode_term_cfgs": "mode_term_cfgs",
        "_mode_term_names": "mode_term_names",
    },
    "MetricsManager": {"_episode_sums": "episode_sums", "_step_count": "step_count"},
    "ObservationManager": {
        "_group_obs_concatenate": "group_obs_concatenate",
        "_group_obs_dim": "group_obs_dim",
        "_group_obs_term_cfgs": "group_obs_term_cfgs",
        "_group_obs_term_dim": "group_obs_term_dim",
        "_group_obs_term_names": "group_obs_term_names",
    },
    "RewardManager": {"_episode_sums": "reward_sums"},
    "TerminationManager": {
        "_term_dones": "term_dones",
        "_terminated_buf": "terminated_buf",
        "_truncated_buf": "truncated_buf",
    },
}

# Legacy fields by class, with replacement and translation, applied in this order. A translation
# receives the value and the keyword arguments, and may modify these. None: the value has no effect.
_Translation = Callable[[Any, dict[str, Any]], None]
_REQUIRED_BEFORE_1_6 = {"contype": 1, "conaffinity": 1, "condim": 3, "priority": 0}


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


_DROPPED_FIELDS: dict[str, dict[str, tuple[str, _Translation | None]]] = {
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
_LOOSE_DEFAULTS: dict[str, dict[str, Any]] = {"CollisionCfg": _REQUIRED_BEFORE_1_6}
# Overridable methods with an added argument: the argument that legacy overrides lack, and the adapter
# that calls them with current arguments, as "module:function".
_OLDER_METHODS: dict[str, dict[str, tuple[str, str]]] = {
    "CommandTerm": {
        "_update_command": ("env_ids", "mjlab.compat.older_terms:update_command"),
        "compute": ("env_ids", "mjlab.compat.older_terms:compute"),
        "create_gui": ("request_action", "mjlab.compat.older_terms:create_gui"),
    },
}
# Terms that read sites of `asset_cfg` in earlier releases and now read a sensor: the parameter for
# the sensor, and the term for calls without it, as "module:name".
_OLDER_PARAMS: dict[str, tuple[str, str]] = {
    "foot_height": ("sensor_name", "mjlab.compat.older_terms:foot_height"),
    "feet_clearance": ("height_sensor_name", "mjlab.compat.older_terms:feet_clearance"),
    "feet_swing_height": ("height_sensor_name", "mjlab.compat.older_terms:feet_swing_height"),
}


_OLDER = "mjlab.compat.older"


@functools.cache
def _warn_once(message: str) -> None:
    # FutureWarning, because Python hides DeprecationWarning outside `__main__`.
    warnings.warn(message, FutureWarning, stacklevel=3)


def older_names(module_name: str) -> Callable[[str], Any]:
    """Return a module `__getattr__` that resolves the module's legacy names."""
    table = _NAMES.get(module_name, {})

    def __getattr__(name: str) -> Any:
        if name not in table:
            raise AttributeError(f"module {module_name!r} has no attribute {name!r}")
        value = pkgutil.resolve_name(table[name])
        message = f"{module_name}.{name} is deprecated; use {table[name].replace(':', '.')}."
        if table[name].startswith(_OLDER):
            message = f"{module_name}.{name} is deprecated and will be removed in mjlab 2.0."
        if inspect.isfunction(value):
            return _warning_when_called(value, module_name, name, message)
        _warn_once(message)
        return value

    return __getattr__


def older_exports(module_name: str) -> list[str]:
    """Return the legacy names of a module for `__all__`.

    Task packages build their `mdp` module with `from <module> import *`, so `__all__` must contain
    legacy names. Only functions, because they warn when called, not when imported.
    """
    return [name for name in _NAMES[module_name] if name[0].islower()]


def offers_older_static_methods(cls: C) -> C:
    """Class decorator: add legacy static methods."""
    for name, path in _STATIC_METHODS[cls.__name__].items():
        message = f"{cls.__name__}.{name} is deprecated; use {path.replace(':', '.')}."
        setattr(cls, name, staticmethod(_forwarding(message, path)))
    return cls


def _forwarding(message: str, path: str, *first: Any) -> Callable[..., Any]:
    """Return a function that warns and calls the one at `path`, with `first` before its arguments."""

    def older(*args: Any, **kwargs: Any) -> Any:
        _warn_once(message)
        return pkgutil.resolve_name(path)(*first, *args, **kwargs)

    return older


@functools.cache
def _warning_when_called(
    function: Callable[..., Any], module_name: str, name: str, message: str
) -> Callable[..., Any]:
    """Wrap a function so that it warns when called. Cached, and pickled by its legacy name."""

    # `wraps` also copies the function's attributes, such as the model fields it randomizes.
    @functools.wraps(function)
    def older(*args: Any, **kwargs: Any) -> Any:
        _warn_once(message)
        return function(*args, **kwargs)

    older.__module__, older.__name__, older.__qualname__ = module_name, name, name
    return older


class _OlderAttribute:
    """Legacy instance attribute, computed by a function of `mjlab.compat.older`."""

    def __init__(self, class_name: str, name: str, function: str) -> None:
        self._path = f"{_OLDER}:{function}"
        self._message = f"{class_name}.{name} is deprecated and will be removed in mjlab 2.0."

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is None:
            return self
        _warn_once(self._message)
        return pkgutil.resolve_name(self._path)(instance)


def offers_older_attributes(cls: C) -> C:
    """Class decorator: add legacy attributes."""
    for name, function in _ATTRIBUTES[cls.__name__].items():
        setattr(cls, name, _OlderAttribute(cls.__name__, name, function))
    return cls


def accepts_older_fields(config_class: C) -> C:
    """Class decorator for configs: accept legacy fields and defaults."""
    cls: Any = config_class
    dropped = _DROPPED_FIELDS.get(cls.__name__, {})
    defaults = _LOOSE_DEFAULTS.get(cls.__name__, {})
    plain_init = cls.__init__
    positions = [field.name for field in dataclasses.fields(cls) if field.init]

    def assume(name: str) -> Any:
        value = defaults[name]
        _warn_once(f"{cls.__name__}.{name} is required; using {value!r} as in releases before 1.6.")
        return value

    for field in dataclasses.fields(cls):
        if field.name in defaults:
            # For `__init__` generated by `@dataclass` in subclasses; that of `cls` already exists.
            field.default_factory = functools.partial(assume, field.name)

    @functools.wraps(plain_init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        for name in [name for name in dropped if name in kwargs]:
            today, translate = dropped[name]
            value = kwargs.pop(name)
            _warn_once(f"{cls.__name__}.{name} is deprecated; use {today}.")
            if translate is not None:
                translate(value, kwargs)
        for name in defaults:
            if name not in kwargs and name not in positions[: len(args)]:
                kwargs[name] = assume(name)
        plain_init(self, *args, **kwargs)

    cls.__init__ = __init__
    return config_class


def older_defaults(config_class: type, missing: dict[str, list[str]]) -> dict[str, Any]:
    """Return default values of fields for unmatched elements; warn once if there are unmatched elements.

    Args:
        config_class: Config class.
        missing: Elements without a matching pattern, by field.
    """
    defaults = _LOOSE_DEFAULTS[config_class.__name__]
    gaps = [
        f"{name} of {names[:8]}{' and others' if len(names) > 8 else ''} is {defaults[name]}"
        for name, names in missing.items()
        if names
    ]
    if gaps:
        _warn_once(
            f"{config_class.__name__}: no pattern matches some elements, so {', '.join(gaps)}; "
            "add a last pattern '.*'."
        )
    return defaults


def accept_older_methods(base: type, subclass: type) -> None:
    """Adapt legacy overrides in `subclass` to the current signatures of `base`.

    Called by `base.__init_subclass__`. Overrides with a legacy signature are replaced by methods that
    take the current arguments and call them.
    """
    for name, (argument, caller) in _OLDER_METHODS[base.__name__].items():
        method = getattr(subclass, name)
        if not inspect.isfunction(method):
            continue
        position = list(inspect.signature(getattr(base, name)).parameters).index(argument)
        parameters = inspect.signature(method).parameters.values()
        takes_any = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        ordered = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        by_name = argument in [p.name for p in ordered[position:][:1]]
        if takes_any or by_name or sum(p.default is p.empty for p in ordered) > position:
            continue
        message = (
            f"{method.__qualname__} without argument {argument} is deprecated; add {argument}."
        )
        older = functools.update_wrapper(_forwarding(message, caller, method), method)
        # `inspect.signature` follows `__wrapped__`, but subclasses must see the adapter's signature.
        del older.__wrapped__
        setattr(subclass, name, older)


def accepts_older_params(term: T) -> T:
    """Decorator for terms (functions or classes): accept sites in `asset_cfg` instead of a sensor.

    Calls (for a class: configs) with `asset_cfg` and without the sensor use the legacy term.
    """
    cls: Any = term
    name = cls.__name__
    sensor, path = _OLDER_PARAMS[name]

    def is_older(params: dict[str, Any]) -> bool:
        if isinstance(params.get(sensor), str) or not {"asset_cfg", sensor} & params.keys():
            return False
        _warn_once(
            f"{name} without {sensor} is deprecated (site heights above z = 0, as in releases 1.1 and "
            f"1.2); set {sensor}."
        )
        return True

    if inspect.isclass(term):
        # The legacy term is a subclass, so Python calls its `__init__` after `__new__`. Copies call
        # `__new__` without arguments, on the class of the copied object.
        def __new__(today: type, cfg: Any = None, env: Any = None) -> Any:
            older = today is cls and cfg is not None and is_older(cfg.params)
            return object.__new__(pkgutil.resolve_name(path) if older else today)

        cls.__new__ = __new__
        return term
    either: Any = _either(cls, path, is_older)
    signature = inspect.signature(cls)
    parameters = dict(signature.parameters)
    parameters[sensor] = parameters[sensor].replace(default=None)
    asset_cfg = inspect.Parameter("asset_cfg", inspect.Parameter.KEYWORD_ONLY, default=None)
    parameters.setdefault("asset_cfg", asset_cfg)
    either.__signature__ = signature.replace(parameters=list(parameters.values()))
    return either


def _either(today: Any, path: str, is_older: Callable[[dict[str, Any]], bool]) -> Any:
    """Return a function that calls the current or legacy term, with their `check_when_built`."""
    signature = inspect.signature(today)

    @functools.wraps(today)
    def term(*args: Any, **kwargs: Any) -> Any:
        params = dict(zip(signature.parameters, args, strict=False)) | kwargs
        return (pkgutil.resolve_name(path) if is_older(params) else today)(*args, **kwargs)

    if hasattr(today, "check_when_built"):
        older_check = f"{path}.check_when_built"
        term.check_when_built = _either(today.check_when_built, older_check, is_older)  # ty: ignore
    return term


def offers_older_sites(make_cfg: T) -> T:
    """Decorator for the velocity template: foot terms accept sites, as in releases 1.1 and 1.2."""
    make: Any = make_cfg

    @functools.wraps(make)
    def template() -> Any:
        cfg = make()
        pkgutil.resolve_name("mjlab.compat.older_terms:offer_sites")(cfg)
        return cfg

    return cast(T, template)


def set_array_field(field: Any, values: Any) -> None:
    """Write `values` to the first elements of an array field of a spec. None: unchanged."""
    for index, value in enumerate(values or ()):
        field[index] = value
