"""What a task sees of an engine's fields: `sim.data.<field>` and `sim.model.<field>`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


class FieldView:
    """Read-only namespace over an engine's fields, each a live tensor with leading dimension N.

    A field is looked up once and then held as a plain attribute, so that reading it again costs
    nothing. Write into the tensors in place (`data.qpos[ids] = ...`).
    """

    def __init__(self, lookup: Callable[[str], torch.Tensor], nworld: int, struct: str) -> None:
        self.__dict__.update(_lookup=lookup, nworld=nworld, _struct=struct)

    def __getattr__(self, name: str) -> torch.Tensor:
        if name.startswith("__"):
            raise AttributeError(name)
        tensor = self.__dict__["_lookup"](name)
        self.__dict__[name] = tensor
        return tensor

    def __setattr__(self, name: str, value: Any) -> None:
        # `data.qpos += 1` writes in place and then assigns the tensor to itself.
        if value is self.__dict__.get(name):
            return
        raise AttributeError(
            f"{self._struct}.{name} cannot be replaced; write into it in place: "
            f"{self._struct}.{name}[:] = ..."
        )

    def forget(self, names: tuple[str, ...]) -> None:
        """Drop held fields, so that the next access looks them up again."""
        for name in names:
            self.__dict__.pop(name, None)


class SharedField(torch.Tensor):
    """One model value that all environments share, seen N times; reading is free, writing refused.

    Writing one row would change every environment. Results of operations are plain tensors.
    """

    field_name: str

    @classmethod
    def make(cls, value: torch.Tensor, nworld: int, name: str) -> SharedField:
        """View `value`, without environment dimension, as an (nworld, ...) field."""
        view = value.expand(nworld, *value.shape)
        field = torch.Tensor._make_subclass(cls, view)
        field.field_name = name
        return field

    @classmethod
    def __torch_function__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Any | None = None
    ) -> Any:
        target = args[0] if args else None
        if isinstance(target, SharedField) and _writes(func):
            raise _refusal(target)
        out = (kwargs or {}).get("out")
        for tensor in out if isinstance(out, tuple | list) else (out,):
            if isinstance(tensor, SharedField):
                raise _refusal(tensor)
        with torch._C.DisableTorchFunctionSubclass():
            result = func(*args, **(kwargs or {}))
        # Views still alias the shared row, so they stay protected.
        if (
            isinstance(target, SharedField)
            and isinstance(result, torch.Tensor)
            and result.untyped_storage().data_ptr() == target.untyped_storage().data_ptr()
        ):
            result = result.as_subclass(cls)
            result.field_name = target.field_name
        return result


def _refusal(field: SharedField) -> RuntimeError:
    name = field.field_name
    return RuntimeError(
        f"Model field {name!r} is shared by all environments and cannot be written. Call "
        f"sim.expand_model_fields(({name!r},)) first, or declare it with "
        f"@requires_model_fields({name!r})."
    )


def _writes(func: Any) -> bool:
    name = getattr(func, "__name__", "")
    return name == "__setitem__" or (name.endswith("_") and not name.endswith("__"))
