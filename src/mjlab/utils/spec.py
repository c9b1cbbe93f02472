"""Functions on MuJoCo specs: joints, options, copies, the mocap wrap, export, new actuators."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Callable, Collection
from typing import Any

import mujoco
import numpy as np

from mjlab.compat import older_names
from mjlab.utils.spec_actuators import (  # noqa: F401
    apply_target_overrides,
    create_motor_actuator,
    create_muscle_actuator,
    create_position_actuator,
    create_velocity_actuator,
)
from mjlab.utils.spec_export import (  # noqa: F401
    export_spec,
    make_asset_paths_absolute,
    put_files_in_memory,
)

logger = logging.getLogger(__name__)

MOCAP_BASE_NAME = "mocap_base"
_EMPTY_PREFIX = "Attaching a spec with an empty prefix"

# What belongs to an element's place in its spec rather than to what it is.
_NOT_DATA = {"name", "id", "signature", "classname", "compiler"}


def attach(
    parent: mujoco.MjSpec, child: mujoco.MjSpec, prefix: str, frame: mujoco.MjsFrame
) -> None:
    """Attach `child` to a frame of `parent`; its elements move there.

    Without a prefix MuJoCo prints, and logs to a file, that such a spec may not be saved correctly:
    default classes lose their names. What this package saves, it repairs (`fix_spec_xml`).
    """
    handler = mujoco.get_mju_user_warning()
    messages: list[str] = []
    mujoco.set_mju_user_warning(messages.append)
    try:
        parent.attach(child, prefix=prefix, frame=frame)
    finally:
        mujoco.set_mju_user_warning(handler)
    for message in messages:
        if not message.startswith(_EMPTY_PREFIX):
            logger.warning(message)


def compile_composed(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec without MuJoCo's warning about empty prefixes; see `attach`."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=_EMPTY_PREFIX)
        return spec.compile()


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile `spec` so that inertial frames may differ between environments afterwards.

    Raises:
        ValueError: the spec does not compile, with MuJoCo's message.
    """
    for body in spec.bodies:
        # The compiler's shortcut for free bodies fixes the sparsity of the mass matrix, which a
        # randomized centre of mass would need in full.
        body.simple = 0
    try:
        return compile_composed(spec)
    except ValueError as error:
        raise ValueError(f"The scene does not compile: {error}") from error


def get_free_joint(spec: mujoco.MjSpec) -> mujoco.MjsJoint | None:
    """Return the first free joint of the spec, or None."""
    return next((joint for joint in spec.joints if _is_free(joint)), None)


def get_non_free_joints(spec: mujoco.MjSpec) -> tuple[mujoco.MjsJoint, ...]:
    """Return the joints that are not free, in spec order."""
    return tuple(joint for joint in spec.joints if not _is_free(joint))


def _is_free(joint: mujoco.MjsJoint) -> bool:
    return joint.type == mujoco.mjtJoint.mjJNT_FREE


def is_joint_limited(jnt: mujoco.MjsJoint) -> bool:
    """Return whether the joint has limits: it says so, or leaves it open and has a range."""
    if jnt.limited == mujoco.mjtLimited.mjLIMITED_AUTO:
        return bool(jnt.range[0] < jnt.range[1])
    return jnt.limited == mujoco.mjtLimited.mjLIMITED_TRUE


def option_field_names() -> tuple[str, ...]:
    """Return the names of all fields of a spec's `<option>`."""
    return tuple(name for name in dir(mujoco.MjSpec().option) if not name.startswith("_"))


def non_default_option_fields(opt: Any) -> list[str]:
    """Return the names of the fields of `spec.option` that differ from MuJoCo's defaults."""
    default = mujoco.MjSpec().option
    return [
        name
        for name in option_field_names()
        if not np.array_equal(getattr(opt, name), getattr(default, name))
    ]


def copy_mesh_data(src: mujoco.MjsMesh, dst: mujoco.MjsMesh) -> None:
    """Copy everything but the name. `ValueError` if `dst` has no name yet."""
    _copy_data(src, dst)


def copy_texture_data(src: mujoco.MjsTexture, dst: mujoco.MjsTexture) -> None:
    """Copy everything but the name. `ValueError` if `dst` has no name yet."""
    # Compiling keeps the pixels of a file in `data`, but not their number.
    is_read = src.file or any(src.cubefiles)
    _copy_data(src, dst, leave_out=("data",) if is_read else ())


def copy_material_data(src: mujoco.MjsMaterial, dst: mujoco.MjsMaterial) -> None:
    """Copy everything but the name, textures by name. `ValueError` if `dst` has no name yet."""
    _copy_data(src, dst)


def _copy_data(src: Any, dst: Any, leave_out: Collection[str] = ()) -> None:
    if not dst.name:
        raise ValueError(
            f"The {type(dst).__name__} to copy {src.name!r} into has no name. "
            "Name it first: names must be unique in a spec, so they are not copied."
        )
    for field in dir(src):
        if field.startswith("_") or field in _NOT_DATA or field in leave_out:
            continue
        value = getattr(src, field)
        if callable(value) or (field == "plugin" and not value.active):
            continue
        setattr(dst, field, value)


def auto_wrap_fixed_base_mocap(
    spec_fn: Callable[[], mujoco.MjSpec],
) -> Callable[[], mujoco.MjSpec]:
    """Return a function like `spec_fn` whose specs have a base that can be placed freely.

    A spec without a free joint, whose first body is no mocap body, is put under a new mocap body
    `mocap_base`: each environment can then place it by writing the mocap pose. Options, model
    name and keyframes of the spec are kept. Other specs are returned as they are.

    The new function raises `ValueError` for a spec to be wrapped that has a mocap body further
    down, since mocap bodies must be children of the world.
    """

    @functools.wraps(spec_fn)
    def wrapped() -> mujoco.MjSpec:
        spec = spec_fn()
        bodies = spec.bodies[1:]
        if get_free_joint(spec) is not None or (bodies and bodies[0].mocap):
            return spec
        nested = [body.name for body in bodies if body.mocap]
        if nested:
            raise ValueError(
                f"The spec {spec.modelname!r} has a fixed base, which is put under a mocap body, "
                f"but has mocap bodies itself: {nested}. Mocap bodies must be children of the "
                "world: make it the first body, or an entity of its own."
            )
        return _under_mocap_base(spec)

    return wrapped


def _under_mocap_base(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    # Attaching moves the elements away, so a function that returns one spec twice needs a copy.
    child = spec.copy()
    make_asset_paths_absolute(child, spec.modelfiledir)
    parent = mujoco.MjSpec()
    parent.modelname = spec.modelname
    # Attaching drops the options; kept here, the scene still sees what the entity asked for.
    for name in option_field_names():
        setattr(parent.option, name, getattr(spec.option, name))
    base = parent.worldbody.add_body(name=MOCAP_BASE_NAME, mocap=True)
    for key in list(child.keys):
        child.delete(key)
    attach(parent, child, "", base.add_frame())
    for key in spec.keys:
        fields = ("name", "time", "qpos", "qvel", "act", "ctrl")
        parent.add_key(**{field: getattr(key, field) for field in fields})
    return parent


__getattr__ = older_names(__name__)
