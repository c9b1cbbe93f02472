"""The parts of rsl_rl that mjlab uses, imported without what training does not need.

`import rsl_rl.runners` takes longer than importing torch does. Two things are to blame, neither of
which a training run uses: tensordict registers a few functions with `torch.compile`, which imports
all of the compiler (`torch._dynamo`), and rsl_rl imports the clients of logging services wherever
they are installed. Here the registrations are put off until a run asks for `torch.compile`
(`enable_torch_compile`), and the clients until a run logs to them (`enable_wandb`). When something
else has imported tensordict or rsl_rl before, there is nothing to gain and nothing is done.
"""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import sys
import types
from collections.abc import Callable, Generator
from typing import Any

import torch

_LOGGING_CLIENTS = ("wandb", "neptune")
# Registrations with torch.compile that were put off: (the torch function, its argument).
_put_off: list[tuple[Callable[[Any], Any], Any]] = []
# Optimizer methods that were told that there is no compiler to hide from.
_plain_methods: list[Callable[..., Any]] = []
_OPTIMIZER_METHODS = ("add_param_group", "zero_grad", "state_dict", "load_state_dict")


@contextlib.contextmanager
def _registrations_put_off() -> Generator[None]:
    names = ("allow_in_graph", "assume_constant_result")
    originals = {name: getattr(torch.compiler, name) for name in names}

    def put_off(original: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def register(function: Any) -> Any:
            _put_off.append((original, function))
            return function

        return register

    for name, original in originals.items():
        setattr(torch.compiler, name, put_off(original))
    try:
        yield
    finally:
        for name, original in originals.items():
            setattr(torch.compiler, name, original)


@contextlib.contextmanager
def _clients_hidden() -> Generator[None]:
    # An entry of None makes `import` raise ModuleNotFoundError, which rsl_rl expects where a
    # client is not installed.
    hidden = [name for name in _LOGGING_CLIENTS if name not in sys.modules]
    modules: dict[str, Any] = sys.modules
    for name in hidden:
        modules[name] = None
    try:
        yield
    finally:
        for name in hidden:
            sys.modules.pop(name, None)


def _leave_compiler_out_of_optimizers() -> None:
    # These methods import the compiler at their first call, only to hide themselves from it. The
    # attribute is where torch (torch/_compile.py) keeps the version of a method to be called.
    for name in _OPTIMIZER_METHODS:
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method
            _plain_methods.append(method)


def keep_compiler_out_of_step(optimizer: torch.optim.Optimizer) -> None:
    """Make `optimizer.step` do the same without importing the compiler for a graph break."""
    raw_step = inspect.unwrap(type(optimizer).step)

    def step(self: torch.optim.Optimizer, closure: Callable[[], float] | None = None) -> Any:
        with torch.set_grad_enabled(self.defaults.get("differentiable", False)):
            return raw_step(self, closure)

    # `profile_hook_step` is what runs the hooks that others registered on the optimizer.
    hooked = torch.optim.Optimizer.profile_hook_step(step)
    optimizer.step = types.MethodType(hooked, optimizer)  # type: ignore[method-assign]


def enable_torch_compile() -> None:
    """Do what was put off; to be called before anything is compiled."""
    while _plain_methods:
        delattr(_plain_methods.pop(), "__dynamo_disable")
    while _put_off:
        register, function = _put_off.pop(0)
        register(function)


def enable_wandb() -> None:
    """Import Weights & Biases for rsl_rl's writer.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    writer_module: Any = importlib.import_module("rsl_rl.utils.wandb_log_writer")
    writer_module.wandb = importlib.import_module("wandb")


if "torch._dynamo" in sys.modules:
    _import_context: contextlib.AbstractContextManager[None] = _clients_hidden()
else:
    _leave_compiler_out_of_optimizers()
    _import_context = contextlib.ExitStack()
    _import_context.enter_context(_registrations_put_off())
    _import_context.enter_context(_clients_hidden())

# GitPython, which rsl_rl's logger imports, fails at import where there is no `git` to run.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

with _import_context:
    from rsl_rl.algorithms import PPO as PPO
    from rsl_rl.env import VecEnv as VecEnv
    from rsl_rl.models import CNNModel as CNNModel
    from rsl_rl.models import MLPModel as MLPModel
    from rsl_rl.models import RNNModel as RNNModel
    from rsl_rl.modules import CNN as CNN
    from rsl_rl.modules.distribution import Distribution as Distribution
    from rsl_rl.runners import OnPolicyRunner as OnPolicyRunner
    from rsl_rl.utils import check_nan as check_nan
    from rsl_rl.utils import reduce_gradients_in_buckets as reduce_gradients_in_buckets
    from rsl_rl.utils import resolve_callable as resolve_callable
    from rsl_rl.utils import resolve_class as resolve_class
    from rsl_rl.utils import resolve_nn_activation as resolve_nn_activation
    from rsl_rl.utils import resolve_obs_groups as resolve_obs_groups
    from rsl_rl.utils.logger import Logger as Logger
    from tensordict import TensorDict as TensorDict
