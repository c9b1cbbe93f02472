"""Which fields of MuJoCo Warp's structs can cross the seam, found from the structs' own types.

MuJoCo Warp declares each field's shape with its type: a data field is per environment if its first
dimension is "nworld", and a model field can be if its first dimension is "*".
"""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any

import mujoco

# Held in another layout than MuJoCo's, or not per environment.
_UNLIKE_MUJOCO = frozenset({"qLD", "qLDiagInv", "qLU", "solver_niter", "contact", "efc"})


def find_data_field(data: Any, name: str) -> Any:
    """Return the Warp array of an `MjData` field that every environment has.

    Raises:
        AttributeError: there is no such field; the message says what to use, or close names.
    """
    known = {
        field
        for field in _fields_over(type(data), "nworld") - _UNLIKE_MUJOCO
        if hasattr(mujoco.MjData, field)
    }
    if name in known:
        return getattr(data, name)
    if name in ("contact", "ncon") or name.startswith("efc"):
        raise AttributeError(
            f"The warp engine does not offer MjData.{name}; read contacts by a contact sensor."
        )
    raise AttributeError(
        f"The warp engine has no per-environment MjData field {name!r}." + _hint(name, known)
    )


def find_model_field(model: Any, name: str) -> tuple[Any, str]:
    """Return the struct (model or its options) and attribute of a model field.

    Options go by their own name or as `opt.<name>`.

    Raises:
        ValueError: no such field, or one that cannot differ between environments.
    """
    prefix, _, attribute = name.rpartition(".")
    structs = {"": (model, model.opt), "opt": (model.opt,)}
    for struct in structs.get(prefix, ()):
        if attribute in _fields_over(type(struct), "*"):
            return struct, attribute
    if hasattr(mujoco.MjModel, attribute) or hasattr(mujoco.MjOption, attribute):
        raise ValueError(
            f"MuJoCo Warp shares model field {name!r} between all environments; it cannot differ. "
            "Set it in the model instead, or use --engine native."
        )
    raise ValueError(
        f"MjModel has no field {name!r}." + _hint(name, _fields_over(type(model), "*"))
    )


def _fields_over(struct: type[Any], dimension: str) -> set[str]:
    """Return the names of a struct's array fields whose first dimension is `dimension`."""
    return {
        field.name
        for field in dataclasses.fields(struct)
        if (getattr(field.type, "shape", None) or (None,))[0] == dimension
    }


def _hint(name: str, known: set[str]) -> str:
    close = difflib.get_close_matches(name, sorted(known), n=3)
    return f" Close names: {', '.join(close)}." if close else ""
