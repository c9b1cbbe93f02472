"""Warp arrays as torch tensors, for packages that work with MuJoCo Warp's own structs.

`sim.data` and `sim.model` are plain torch tensors and need none of this. These names are for code
that holds a Warp array or struct of its own, such as `sim.wp_data`. Importing this loads no Warp.
"""

from __future__ import annotations

from functools import partialmethod
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    import torch

T = TypeVar("T")


class TorchArray:
    """A Warp array that is indexed, written and computed with as a torch tensor, without a copy.

    An array with a single row that stands for `nworld` worlds reads as `nworld` equal rows; it is
    refused when written by `[...] = ...`, because one row cannot hold different values.
    """

    def __init__(self, wp_array: Any, nworld: int | None = None) -> None:
        from mjlab.sim.warp.engine import as_torch

        tensor = as_torch(wp_array)
        self._wp_array = wp_array
        worlds = 1 if nworld is None else nworld
        self._shared = worlds > 1 and tensor.shape[0] == 1
        self._tensor = tensor.expand(worlds, *tensor.shape[1:]) if self._shared else tensor

    @property
    def wp_array(self) -> Any:
        """The Warp array itself."""
        return self._wp_array

    @property
    def tensor(self) -> torch.Tensor:
        """The tensor that shares the array's memory."""
        return self._tensor

    def __getitem__(self, idx: Any) -> Any:
        return self._tensor[idx]

    def __setitem__(self, idx: Any, value: Any) -> None:
        if self._shared:
            raise RuntimeError(
                "This model field is one row that all environments share. Give each its own with "
                "sim.expand_model_fields((name,)) before writing it."
            )
        self._tensor[idx] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_tensor" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self._tensor, name)

    def __len__(self) -> int:
        return len(self._tensor)

    def __repr__(self) -> str:
        return f"TorchArray({self._tensor!r})"

    @classmethod
    def __torch_function__(
        cls, func: Any, types: Any, args: Any = (), kwargs: Any | None = None
    ) -> Any:
        plain = [_unwrap(argument) for argument in args]
        named = {name: _unwrap(value) for name, value in (kwargs or {}).items()}
        return func(*plain, **named)

    def _operate(self, operator: str, *others: Any) -> Any:
        return getattr(self._tensor, operator)(*[_unwrap(other) for other in others])


# Python looks operators up on the class and never asks `__getattr__`.
for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul", "and", "or"):
    setattr(TorchArray, f"__{_name}__", partialmethod(TorchArray._operate, f"__{_name}__"))
    setattr(TorchArray, f"__r{_name}__", partialmethod(TorchArray._operate, f"__r{_name}__"))
for _name in ("neg", "abs", "invert", "lt", "le", "gt", "ge", "eq", "ne", "float", "int", "bool"):
    setattr(TorchArray, f"__{_name}__", partialmethod(TorchArray._operate, f"__{_name}__"))
TorchArray.__hash__ = object.__hash__


def _unwrap(value: Any) -> Any:
    if isinstance(value, TorchArray):
        return value.tensor
    if isinstance(value, (list, tuple)):
        return type(value)(_unwrap(item) for item in value)
    return value


class WarpBridge(Generic[T]):
    """A Warp struct whose array attributes read as `TorchArray`s; the rest reads as it is.

    Attributes cannot be replaced; write into them in place.
    """

    def __init__(self, struct: T, nworld: int | None = None) -> None:
        self.__dict__.update(_struct=struct, _nworld=nworld, _cache={})

    @property
    def struct(self) -> T:
        """The wrapped struct."""
        return self.__dict__["_struct"]

    @property
    def nworld(self) -> int | None:
        """Number of worlds, as given or as the struct says."""
        given = self.__dict__["_nworld"]
        return getattr(self.struct, "nworld", None) if given is None else given

    def clear_cache(self) -> None:
        """Forget wrapped arrays; needed after an array of the struct was replaced."""
        self.__dict__["_cache"].clear()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_struct" not in self.__dict__:
            raise AttributeError(name)
        cache = self.__dict__["_cache"]
        if name not in cache:
            value = getattr(self.struct, name)
            if not (hasattr(value, "ptr") and hasattr(value, "dtype")):
                return value
            cache[name] = TorchArray(value, self.nworld if _is_batched(value) else None)
        return cache[name]

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be replaced; write into it in place: {name}[:] = ...")


def _is_batched(array: Any) -> bool:
    """Return whether the array's first dimension is the worlds; MuJoCo Warp marks those."""
    return bool(getattr(array, "_is_batched", False))
