"""Field namespaces: `sim.data`, `sim.model` and wrapped MuJoCo Warp structs.

The fields of `sim.data` and `sim.model` are plain torch tensors. `TorchArray` and `WarpBridge` are
for code that holds a Warp array or struct, such as `sim.wp_data`. Importing this module does not
load Warp.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Generic, TypeVar

import torch

from mjlab.utils.errors import UnknownAttributeError

T = TypeVar("T")


class TorchArray(torch.Tensor):
    """Torch tensor that shares the memory of a Warp array. Operations return plain tensors.

    An array with a single row shared by `nworld` worlds reads as `nworld` equal rows. Writing one by
    `[...] = ...` changes all, with a warning.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # ty: ignore[incompatible-method-override]
    _wp_array: Any
    _is_shared: bool  # Until the first write, which warns.

    def __new__(cls, wp_array: Any, nworld: int | None = None) -> TorchArray:
        """View `wp_array` of one or `nworld` rows."""
        from mjlab.sim.warp.engine import as_torch

        tensor = as_torch(wp_array)
        is_shared = nworld is not None and nworld > 1 and tensor.shape[0] == 1
        if is_shared:
            tensor = tensor.expand(nworld, *tensor.shape[1:])
        array = torch.Tensor._make_subclass(cls, tensor)
        array._wp_array, array._is_shared = wp_array, is_shared
        return array

    @property
    def wp_array(self) -> Any:
        """Wrapped Warp array."""
        return self._wp_array

    @property
    def tensor(self) -> torch.Tensor:
        """View as a plain tensor."""
        return self.as_subclass(torch.Tensor)

    def __getitem__(self, idx: Any) -> Any:
        return super().__getitem__(idx)

    def __setitem__(self, idx: Any, value: Any) -> None:
        if self._is_shared:
            self._is_shared = False
            warnings.warn(
                "Model field: expected one row per world for writing, got one shared row, so the "
                "write changes all worlds; use sim.expand_model_fields((name,)) before.",
                UserWarning,
                stacklevel=2,
            )
        super().__setitem__(idx, value)


class FieldView:
    """Read-only namespace over the fields of `data`, `model` or `model.opt`.

    A field is looked up once and then stored as a plain attribute, so repeated reads are free.
    Write to the tensors in place (`data.qpos[ids] = ...`).
    """

    def __init__(self, lookup: Callable[[str], Any], nworld: int | None, owner: str) -> None:
        self.__dict__.update(_lookup=lookup, nworld=nworld, _owner=owner)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = self.__dict__["_lookup"](name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # `data.qpos += 1` writes in place and then assigns the same tensor.
        if isinstance(value, torch.Tensor) and value is getattr(self, name, None):
            return
        raise UnknownAttributeError(
            f"{self._owner}.{name} cannot be replaced; write into it in place: "
            f"{self._owner}.{name}[:] = ..."
        )

    def forget(self, names: Iterable[str]) -> None:
        """Drop stored fields; the next access looks them up again."""
        for name in names:
            self.__dict__.pop(name, None)


class WarpBridge(FieldView, Generic[T]):
    """Warp struct with arrays wrapped as `TorchArray`, and structs in it as `WarpBridge`.

    Attributes cannot be replaced; write to them in place.
    """

    def __init__(self, struct: T, nworld: int | None = None) -> None:
        nworld = getattr(struct, "nworld", None) if nworld is None else nworld
        super().__init__(partial(getattr, struct), nworld, type(struct).__name__)
        self.__dict__["_struct"] = struct

    @property
    def struct(self) -> T:
        """Wrapped struct."""
        return self.__dict__["_struct"]

    def clear_cache(self) -> None:
        """Drop wrapped arrays. Required after an array of the struct was replaced."""
        kinds = (TorchArray, WarpBridge)
        self.forget([name for name, value in self.__dict__.items() if isinstance(value, kinds)])

    def __getattr__(self, name: str) -> Any:
        value = super().__getattr__(name)
        if dataclasses.is_dataclass(value):
            self.__dict__[name] = WarpBridge(value, self.nworld)
            return self.__dict__[name]
        if not (hasattr(value, "ptr") and hasattr(value, "dtype")):
            # Not stored: the struct's value may change.
            self.forget([name])
            return value
        # MuJoCo Warp marks arrays with a leading world dimension.
        is_batched = getattr(value, "_is_batched", False)
        self.__dict__[name] = TorchArray(value, self.nworld if is_batched else None)
        return self.__dict__[name]
