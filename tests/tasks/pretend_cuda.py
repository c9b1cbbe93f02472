"""CUDA's rules about devices, without a GPU.

`PretendCuda` is a torch function mode: tensors created on `cuda:0` live on the CPU and are marked. The mode
enforces torch's rules for GPUs: operations with operands on two devices raise, NumPy does not read
marked tensors, and host synchronizations are counted by the line that causes them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode

import mjlab
from mjlab.sim import simulation
from mjlab.sim.engine import Engine
from mjlab.sim.simulation import SharedField

DEVICE = "cuda:0"
_SOURCES = str(Path(mjlab.__file__).parent)
_MARK = "_is_on_pretended_cuda"

# Functions that synchronize: their result, or its shape, must be known on the host.
_WAITING = frozenset(
    {"item", "tolist", "nonzero", "masked_select", "unique", "unique_consecutive", "equal"}
    | {"allclose", "is_nonzero", "__bool__", "__float__", "__int__", "__index__", "__contains__"}
    | {"argwhere", "bincount", "new_tensor", "__format__", "__repr__"}
)
# Functions that create tensors from host data: with a device, they copy and synchronize.
_FROM_HOST = frozenset({"tensor", "as_tensor", "asarray"})
_FACTORIES = (
    frozenset(
        {"zeros", "ones", "full", "empty", "arange", "linspace", "logspace", "eye", "rand", "randn"}
        | {
            "randint",
            "randperm",
            "normal",
            "tril_indices",
            "triu_indices",
            "from_numpy",
            "empty_strided",
        }
    )
    | _FROM_HOST
)
# Functions whose inputs TF32 may round to ten bits on a GPU: 8 mm at 10 m from the origin.
_ROUNDED = frozenset(
    {"matmul", "__matmul__", "__rmatmul__", "mm", "bmm", "mv", "einsum", "addmm", "baddbmm"}
    | {"addmv", "addbmm", "tensordot", "inner", "cdist"}
)
# Functions that accept tensors of both devices.
_CROSSING = frozenset(
    {"copy_", "tensor", "as_tensor", "asarray", "_has_compatible_shallow_copy_type"}
)
# Functions that, unlike arithmetic, reject 0-dim CPU tensors too.
_STRICT = frozenset({"cat", "stack", "concat", "concatenate", "hstack", "vstack", "column_stack"})


def is_marked(value: Any) -> bool:
    """Return True for tensors on the simulated device."""
    return getattr(value, _MARK, False) is True


def mark(value: Any) -> Any:
    """Move all tensors in `value` to the simulated device."""
    for tensor in _tensors(value):
        setattr(tensor, _MARK, True)
    return value


def _unmark(tensor: torch.Tensor) -> torch.Tensor:
    setattr(tensor, _MARK, False)
    return tensor


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _tensors(item)
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))


def _is_cuda(device: Any) -> bool:
    if isinstance(device, str):
        return device.startswith("cuda")
    return isinstance(device, torch.device) and device.type == "cuda"


def _is_device(value: Any) -> bool:
    return isinstance(value, torch.device) or (
        isinstance(value, str) and value.split(":")[0] in ("cpu", "cuda")
    )


class PretendCuda(TorchFunctionMode):
    """Torch function mode that simulates the CUDA device `cuda:0`."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        """Number of host synchronizations by `file:line function` of the innermost line of mjlab."""
        self.rounded: Counter[str] = Counter()
        """Number of float32 matrix products, subject to TF32 rounding, by `file:line function`."""
        self._is_paused = False

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Allow marked tensors to be used as CPU tensors."""
        before, self._is_paused = self._is_paused, True
        yield
        self._is_paused = before

    def __torch_function__(
        self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if self._is_paused:
            return func(*args, **kwargs)
        name = func.__name__
        if name == "__get__":
            return self._attribute(func, args)
        if name == "__deepcopy__":
            result = func(*args, **kwargs)
            return mark(result) if is_marked(args[0]) else result
        if name == "__set__":
            func(*args, **kwargs)
            if func.__self__.__name__ == "data":
                setattr(args[0], _MARK, is_marked(args[1]))
            return None
        if name in ("to", "cpu", "cuda"):
            return self._move(name, func, args, kwargs)
        if name in ("numpy", "__array__") and is_marked(args[0]):
            raise TypeError(f"can't convert {DEVICE} device type tensor to numpy; use .cpu() first")
        kwargs.pop("pin_memory", None)
        if name == "pin_memory":
            return args[0]
        if "device" in kwargs:
            return self._make(name, func, args, kwargs)
        marked, others = self._check(name, func, args, kwargs)
        if marked and name in _ROUNDED and next(_tensors([args])).dtype == torch.float32:
            self.rounded[f"{self._place()}: {name}"] += 1
        self._count_waits(name, args, marked, bool(kwargs.get("non_blocking")))
        result = func(*args, **kwargs)
        if name in ("tensor", "copy_") or (name in _FACTORIES and not is_marked(args and args[0])):
            # A list of numbers on the device becomes a tensor on the host.
            return result if not (name == "tensor" and is_marked(args[0])) else mark(result)
        return mark(result) if marked else result

    def _attribute(self, func: Any, args: tuple) -> Any:
        name, owner = func.__self__.__name__, args[0]
        if name == "device" and is_marked(owner):
            return torch.device(DEVICE)
        if name in ("is_cuda", "is_cpu"):
            return is_marked(owner) is (name == "is_cuda")
        value = func(*args)
        return mark(value) if is_marked(owner) else value

    def _move(self, name: str, func: Any, args: tuple, kwargs: dict) -> Any:
        source, *rest = args
        target: Any = {"cpu": "cpu", "cuda": DEVICE}.get(name)
        like = [value for value in rest if isinstance(value, torch.Tensor)]
        if like:
            target = DEVICE if is_marked(like[0]) else "cpu"
        for value in (*rest, kwargs.get("device")):
            if _is_device(value):
                target = value
        goes = is_marked(source) if target is None else _is_cuda(target)
        rest = [value if not _is_device(value) else "cpu" for value in rest]
        if "device" in kwargs and kwargs["device"] is not None:
            kwargs["device"] = "cpu"
        result = source if name in ("cpu", "cuda") else func(source, *rest, **kwargs)
        if goes == is_marked(source):
            return mark(result) if goes else result
        if not (goes and kwargs.get("non_blocking")):
            self._wait(name)
        # A copy to another device does not share memory.
        copy = result.clone() if result is source else result
        return mark(copy) if goes else _unmark(copy)

    def _make(self, name: str, func: Any, args: tuple, kwargs: dict) -> Any:
        device = kwargs["device"]
        if device is None:
            inherited = any(is_marked(tensor) for tensor in _tensors([args, kwargs]))
            result = func(*args, **kwargs)
            return mark(result) if inherited else result
        kwargs["device"] = "cpu"
        source = args[0] if args else None
        result = func(*args, **kwargs)
        if not _is_cuda(device):
            return result
        if name in _FROM_HOST and not is_marked(source):
            self._wait(name)
        if result is source and not is_marked(source):
            result = result.clone()
        return mark(result)

    def _check(self, name: str, func: Any, args: tuple, kwargs: dict) -> tuple[bool, bool]:
        """Return whether operands are on the device, and on the host. Raises for a mixture."""
        operands = list(_tensors([args, kwargs]))
        marked = [tensor for tensor in operands if is_marked(tensor)]
        others = [tensor for tensor in operands if not is_marked(tensor)]
        if not (marked and others) or name in _CROSSING:
            return bool(marked), bool(others)
        if name in ("__getitem__", "__setitem__") and is_marked(args[0]):
            index = list(_tensors([args[1]]))
            # Torch copies indices from the host, and the value too if no index is a tensor.
            if any(not is_marked(tensor) and tensor.dim() for tensor in index):
                self._wait(f"{name} with an index on the host")
            value = [tensor for tensor in _tensors(list(args[2:])) if not is_marked(tensor)]
            if not any(tensor.dim() for tensor in value) or not index:
                return True, True
        elif name not in _STRICT and all(tensor.dim() == 0 for tensor in others):
            first = args[0] if args else None
            if not (name.endswith("_") and others[0] is first):
                return True, True
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but {name} got some on {DEVICE} "
            f"{[tuple(t.shape) for t in marked]} and some on the cpu {[tuple(t.shape) for t in others]}"
        )

    def _count_waits(self, name: str, args: tuple, marked: bool, quick: bool) -> None:
        if not marked:
            return
        crosses = name == "copy_" and is_marked(args[0]) != is_marked(args[1])
        if name in _WAITING or (name == "where" and len(args) == 1) or (crosses and not quick):
            self._wait(name)
        elif name in ("__getitem__", "__setitem__"):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(part, list) for part in index):
                self._wait(f"{name} with a list")
            masks = [t for t in _tensors([args[1]]) if t.dtype == torch.bool and t.dim()]
            # Writing a scalar through a mask does not synchronize.
            if masks and not (name == "__setitem__" and not isinstance(args[2], torch.Tensor)):
                self._wait(f"{name} with a mask")
        elif name == "repeat_interleave" and len(args) > 1 and is_marked(args[1]):
            self._wait(name)

    def _wait(self, name: str) -> None:
        self.waits[f"{self._place()}: {name}"] += 1

    @staticmethod
    def _place() -> str:
        """Return `file:line function` of the innermost line of mjlab."""
        frame = sys._getframe(1)
        while frame is not None and not frame.f_code.co_filename.startswith(_SOURCES):
            frame = frame.f_back
        if frame is None:
            return "outside"
        path = Path(frame.f_code.co_filename).relative_to(_SOURCES)
        return f"{path}:{frame.f_lineno} {frame.f_code.co_name}"


class PretendEngine(Engine):
    """CPU engine whose fields appear to be on the simulated device."""

    def __init__(self, engine: Engine, mode: PretendCuda) -> None:
        self._hosted, self._mode = engine, mode
        self.num_envs, self.capabilities = engine.num_envs, engine.capabilities

    @property
    def model_fields(self) -> dict[str, torch.Tensor]:
        return mark(dict(self._hosted.model_fields))

    def _call(self, name: str, *args: Any) -> Any:
        with self._mode.paused():
            return mark(getattr(self._hosted, name)(*args))

    def close(self) -> None:
        self._call("close")

    def render(self, views: Any) -> Any:
        images = self._call("render", views)
        mark(
            [getattr(image, field.name) for image in images for field in dataclasses.fields(image)]
        )
        return images

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._call("load_state_dict", state)

    def state_dict(self) -> dict[str, Any]:
        with self._mode.paused():
            return self._hosted.state_dict()


def _forwarded(name: str) -> Callable[..., Any]:
    @functools.wraps(getattr(Engine, name))
    def call(self: PretendEngine, *args: Any) -> Any:
        return self._call(name, *args)

    return call


for _name in Engine.__abstractmethods__ - set(vars(PretendEngine)):
    setattr(PretendEngine, _name, _forwarded(_name))
PretendEngine.__abstractmethods__ = frozenset()


class _Event:
    """Device event that is always complete."""

    def record(self, *_: Any) -> None:
        pass

    def query(self) -> bool:
        return True


def install(monkeypatch: pytest.MonkeyPatch, mode: PretendCuda) -> None:
    """Make torch report a GPU, and simulations run on it with native MuJoCo."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "Event", _Event)
    monkeypatch.setattr(simulation, "resolve_engine_name", lambda *_: "native")
    create_engine, make = simulation.create_engine, SharedField.make

    def create(name: str, model: Any, num_envs: int, cfg: Any, device: str) -> Engine:
        with mode.paused():
            engine = create_engine(name, model, num_envs, cfg, "cpu")
        return PretendEngine(engine, mode) if _is_cuda(device) else engine

    def make_marked(value: torch.Tensor, nworld: int | None, live: Any) -> SharedField:
        # Created by a function that torch function modes do not intercept.
        field = make(value, nworld, live)
        return mark(field) if is_marked(value) else field

    monkeypatch.setattr(simulation, "create_engine", create)
    monkeypatch.setattr(SharedField, "make", make_marked)
