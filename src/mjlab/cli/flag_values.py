"""Values of flags: tyro's parsing rules, extended by lists for tuples, and by tensors."""

from __future__ import annotations

import ast
import dataclasses
import sys
from types import UnionType
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin

from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

if TYPE_CHECKING:
    import torch

_Spec = PrimitiveConstructorSpec | UnsupportedTypeAnnotationError | None
_SEQUENCES = (tuple, list)


def flag_rules() -> ConstructorRegistry:
    """Return the parsing rules, for `tyro.cli(registry=...)`."""
    registry = ConstructorRegistry()
    registry.primitive_rule(_tensor_rule)
    registry.primitive_rule(_SequenceRule())
    return registry


def _tensor_rule(info: PrimitiveTypeInfo) -> _Spec:
    # Commands without tensor flags must not import torch for `--help`.
    torch = sys.modules.get("torch")
    if torch is None or info.type is not torch.Tensor:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="[FLOAT,...]",
        instance_from_str=lambda args: _tensor(args[0]),
        is_instance=lambda value: isinstance(value, info.type),
        str_from_instance=lambda value: [repr(value.tolist())],
    )


def _tensor(text: str) -> torch.Tensor:
    import torch

    try:
        return torch.tensor(ast.literal_eval(text), dtype=torch.float32)
    except (ValueError, SyntaxError, TypeError) as error:
        raise ValueError(f"expected numbers in brackets, got {text!r}: {error}") from error


class _SequenceRule:
    """tyro's rule for tuples and lists, with brackets converted to the declared type."""

    def __init__(self) -> None:
        self._in_tyro_rule = False

    def __call__(self, info: PrimitiveTypeInfo) -> _Spec:
        members = get_args(info.type) if info.type_origin in (Union, UnionType) else ()
        # The string would take brackets too.
        sequence = next(
            (m for m in members if str in members and get_origin(m) in _SEQUENCES), None
        )
        if self._in_tyro_rule or not (sequence or info.type_origin in _SEQUENCES):
            return None
        self._in_tyro_rule = True
        try:
            spec = ConstructorRegistry.get_primitive_spec(info)
        finally:
            self._in_tyro_rule = False
        if not isinstance(spec, PrimitiveConstructorSpec):
            return spec
        read = spec.instance_from_str
        if sequence is not None:
            return dataclasses.replace(
                spec,
                instance_from_str=lambda args: (
                    read(args) if (value := _sequence(sequence, args)) is None else value
                ),
            )
        return dataclasses.replace(
            spec, instance_from_str=lambda args: read([_bracketed(info.type, a) for a in args])
        )


def _bracketed(declared: Any, text: str) -> str:
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    return repr(_converted(declared, value)) if isinstance(value, _SEQUENCES) else text


def _sequence(declared: Any, args: list[str]) -> Any:
    """Return a value in brackets as the sequence type `declared`, or None for other values."""
    try:
        value = ast.literal_eval(args[0]) if len(args) == 1 else None
    except (ValueError, SyntaxError):
        return None
    return _converted(declared, value) if isinstance(value, _SEQUENCES) else None


def _converted(declared: Any, value: Any) -> Any:
    """Return `value` with its sequences converted to the tuples and lists of the type `declared`."""
    kind, elements = get_origin(declared), get_args(declared)
    if kind not in _SEQUENCES or not isinstance(value, _SEQUENCES):
        return value
    if kind is list or elements[1:] == (...,):
        elements = elements[:1] * len(value)
    if len(elements) != len(value):
        return kind(value)
    return kind(_converted(*pair) for pair in zip(elements, value, strict=True))
