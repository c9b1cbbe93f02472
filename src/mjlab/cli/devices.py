"""Torch devices of commands: the requested device, else a GPU if available; one GPU per process."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from mjlab.utils.errors import UserError
from mjlab.utils.gpu import egl_device_id, select_gpus
from mjlab.utils.logging import print_notice
from mjlab.utils.processes import ProcessRank, process_rank

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig

NO_GPU = "No GPU is visible; using the CPU."


def resolve_device(device: str | None) -> str:
    """Return the torch device: `device`, or for None a GPU if available, else the CPU.

    Raises:
        UserError: CUDA device without a usable GPU, or unknown device name.
    """
    import torch

    if device is None:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise UserError(
            f"--device: expected cpu, cuda, or cuda:0, cuda:1, ..., got {device!r}."
        ) from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise UserError(
            f"--device {device}: no CUDA GPU found by torch {torch.__version__}; use --device cpu, or "
            "install a driver and a CUDA build of torch."
        )
    return "cuda:0" if device == "cuda" else device


def gpus_to_share(cfg: TrainConfig) -> list[int | str]:
    """Return the entries of `CUDA_VISIBLE_DEVICES` for a multi-GPU run on this machine.

    Empty if at most one GPU is usable, and in processes of a launcher: the launcher has selected the
    GPUs.
    """
    if cfg.device is not None or not process_rank().is_alone:
        return []
    selected, count = select_gpus(cfg.gpu_ids)
    return selected if selected is not None and count > 1 else []


def training_device(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the torch device of this process, and render on the same GPU.

    Raises:
        UserError: fewer GPUs than processes, or one GPU for all processes.
        ValueError: `gpu_ids` contains an unavailable GPU.
    """
    device = _single_process_device(cfg) if rank.is_alone else _device_of(cfg, rank)
    if device == "cpu" and cfg.device is None and cfg.gpu_ids and rank.is_first:
        print_notice(NO_GPU)
    if device.startswith("cuda"):
        # EGL counts all GPUs of the machine, torch only visible GPUs.
        physical = egl_device_id(int(device.partition(":")[2] or 0))
        if physical is not None:
            os.environ.setdefault("MUJOCO_EGL_DEVICE_ID", str(physical))
    return device


def _single_process_device(cfg: TrainConfig) -> str:
    if cfg.device is not None:
        return resolve_device(cfg.device)
    selected, count = select_gpus(cfg.gpu_ids)
    if count > 1:
        raise UserError(
            f"--gpu-ids: expected one GPU, because `launch_training` trains in one process, got {count}; "
            "use the command `train` or torchrun, which start one process per GPU."
        )
    if selected is None:
        return "cpu"
    # Both torch and --gpu-ids count visible GPUs only.
    index = 0 if cfg.gpu_ids in ("all", None) else cfg.gpu_ids[0]
    return resolve_device(f"cuda:{index}")


def _device_of(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the device of a process in a multi-process run."""
    if cfg.device is not None and not cfg.device.startswith("cuda"):
        return resolve_device(cfg.device)
    if cfg.device is not None and ":" in cfg.device and rank.local_world_size > 1:
        raise UserError(
            f"--device {cfg.device}: expected one GPU for each of the {rank.local_world_size} processes "
            "of the run on this machine, got one GPU; use --device cuda or --device cpu."
        )
    # One GPU is the default of single-process runs; ignored in multi-process runs.
    named = cfg.gpu_ids if isinstance(cfg.gpu_ids, list) and len(cfg.gpu_ids) > 1 else "all"
    if cfg.device is None:
        selected, count = select_gpus(None if cfg.gpu_ids is None else named)
        if selected is None:
            return "cpu"
    else:
        resolve_device(cfg.device)
        count = select_gpus(named)[1]
    if rank.local_rank >= count:
        raise UserError(
            f"Expected at most {count} processes of the run on this machine, one per GPU, got "
            f"{rank.local_world_size}; start fewer, or use --device cpu."
        )
    return f"cuda:{rank.local_rank if named == 'all' else named[rank.local_rank]}"
