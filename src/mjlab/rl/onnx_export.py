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
