"""Export of a network to ONNX."""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path
from typing import Any

import torch

from mjlab.rl.exporter_utils import write_atomically

OPSET = 18


def export_to_onnx(model: Any, path: Path, verbose: bool = False) -> None:
    """Write `model`, what rsl_rl's `as_onnx` returns, to `path` with a batch size of 1.

    The exporter is the one that traces (`dynamo=False`): it needs neither the compiler nor
    onnxscript, whose imports alone take longer than the whole export, and it makes one file.
    """
    if getattr(model, "obs_dim_1d", None) == 0:
        model = _ImagesOnly(model)
    model.to("cpu")
    model.eval()
    buffer: Any = io.BytesIO()
    exporter_log = logging.getLogger("torch.onnx")
    level = exporter_log.level
    with warnings.catch_warnings():
        if not verbose:
            warnings.simplefilter("ignore")
            exporter_log.setLevel(logging.ERROR)
        try:
            torch.onnx.export(
                model,
                model.get_dummy_inputs(),
                buffer,
                export_params=True,
                opset_version=OPSET,
                verbose=verbose,
                input_names=model.input_names,
                output_names=model.output_names,
                dynamic_axes={},
                dynamo=False,
            )
        finally:
            exporter_log.setLevel(level)
    write_atomically(path, buffer.getvalue())


class _ImagesOnly(torch.nn.Module):
    """An image model without flat observations, and without the empty input for them."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model
        self.input_names = model.input_names[1:]
        self.output_names = model.output_names

    def get_dummy_inputs(self) -> tuple[torch.Tensor, ...]:
        """Return images of zeros."""
        return self.model.get_dummy_inputs()[1:]

    def forward(self, *images: torch.Tensor) -> torch.Tensor:
        """Return the action for one image of each group."""
        return self.model(images[0].new_zeros(1, 0), *images)
