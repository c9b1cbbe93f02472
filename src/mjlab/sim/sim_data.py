"""Warp arrays as torch tensors, for packages that work with MuJoCo Warp's own structs.

`sim.data` and `sim.model` are plain torch tensors and need none of this. These names are for code
that holds a Warp array or struct of its own, such as `sim.wp_data`. Importing this loads no Warp.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")


class TorchArray(torch.Tensor):
    """A torch tensor that shares the memory of a Warp array. Results of operations are plain.

    An array with a single row that stands for `nworld` worlds reads as `nworld` equal rows; it is
    refused when written by `[...] = ...`, because one row cannot hold different values.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # ty: ignore[incompatible-method-override]
    _wp_array: Any
    _is_shared: bool

    def __new__(cls, wp_array: Any, nworld: int | None = None) -> TorchArray:
        """View `wp_array`, of one row or of `nworld` rows."""
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
        """The Warp array itself."""
        return self._wp_array

    @property
    def tensor(self) -> torch.Tensor:
        """The same as a plain tensor."""
        return self.as_subclass(torch.Tensor)

    def __getitem__(self, idx: Any) -> Any:
        return super().__getitem__(idx)

    def __setitem__(self, idx: Any, value: Any) -> None:
        if self._is_shared:
            raise RuntimeError(
                "This model field is one row that all environments share. Give each its own with "
                "sim.expand_model_fields((name,)) before writing it."
            )
        super().__setitem__(idx, value)


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
        if name.startswith("__"):
            raise AttributeError(name)
        cache = self.__dict__["_cache"]
        if name not in cache:
            value = getattr(self.struct, name)
            if not (hasattr(value, "ptr") and hasattr(value, "dtype")):
                return value
            # MuJoCo Warp marks arrays whose first dimension is the worlds.
            is_batched = getattr(value, "_is_batched", False)
            cache[name] = TorchArray(value, self.nworld if is_batched else None)
        return cache[name]

    def __setattr__(self, name: str, value: Any) -> None:
        # `data.qpos += 1` writes in place and then assigns the array to itself.
        if value is not self.__dict__["_cache"].get(name):
            raise AttributeError(
                f"{name} cannot be replaced; write into it in place: {name}[:] = ..."
            )
