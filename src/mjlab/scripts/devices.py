"""Torch devices of commands: the one named, else a GPU if there is one; one GPU per process."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from mjlab.utils.errors import UserError
from mjlab.utils.gpu import egl_device_id, select_gpus
from mjlab.utils.processes import ProcessRank, process_rank

if TYPE_CHECKING:
    from mjlab.scripts.train_config import TrainConfig

_EGL_VARIABLE = "MUJOCO_EGL_DEVICE_ID"


def resolve_device(device: str | None) -> str:
    """Return the torch device to use: the one asked for, else a GPU where there is one.

    Raises:
        UserError: a CUDA device without a usable GPU, or a name that torch does not know.
    """
    import torch

    if device is None:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise UserError(
            f"{device!r} is not a device. Use cpu, cuda, or cuda:0, cuda:1, ..."
        ) from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise UserError(
            f"--device {device} was asked for, but torch finds no CUDA GPU here "
            f"(torch {torch.__version__}). Use --device cpu, or install a driver and a CUDA build "
            "of torch."
        )
    return "cuda:0" if device == "cuda" else device


def gpus_to_share(cfg: TrainConfig) -> list[int | str]:
    """Return the entries of `CUDA_VISIBLE_DEVICES` for a run on several GPUs of this machine.

    Empty where there is no more than one to use, and in a process that a launcher started: which
    GPUs there are was decided there.
    """
    if cfg.device is not None or not process_rank().is_alone:
        return []
    selected, count = select_gpus(cfg.gpu_ids)
    return selected if selected is not None and count > 1 else []


def training_device(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the torch device of this process; rendering goes to the same GPU.

    Raises:
        UserError: there are fewer GPUs than processes, or all were given the same one.
        ValueError: `gpu_ids` names a GPU that is not there.
    """
    device = _only_device(cfg) if rank.is_alone else _device_of(cfg, rank)
    if device.startswith("cuda"):
        # EGL numbers all GPUs of the machine, and torch those that are visible.
        physical = egl_device_id(int(device.partition(":")[2] or 0))
        if physical is not None:
            os.environ.setdefault(_EGL_VARIABLE, str(physical))
    return device


def _only_device(cfg: TrainConfig) -> str:
    if cfg.device is not None:
        return resolve_device(cfg.device)
    selected, count = select_gpus(cfg.gpu_ids)
    if count > 1:
        raise UserError(
            f"--gpu-ids names {count} GPUs, and this is one process. The command `train` starts one "
            "for each GPU, and so does torchrun; a program that calls `launch_training` trains on "
            "one GPU."
        )
    if selected is None:
        return "cpu"
    # torch numbers the GPUs that are visible, and so does --gpu-ids.
    index = 0 if cfg.gpu_ids in ("all", None) else cfg.gpu_ids[0]
    return resolve_device(f"cuda:{index}")


def _device_of(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the device of one process among several."""
    if cfg.device is not None and not cfg.device.startswith("cuda"):
        return resolve_device(cfg.device)
    if cfg.device is not None and ":" in cfg.device and rank.local_world_size > 1:
        raise UserError(
            f"--device {cfg.device} is one GPU, and this machine has {rank.local_world_size} "
            "processes of the run. Give --device cuda for one GPU each, or --device cpu."
        )
    # One GPU is the default where there is one process, so it says nothing where there are more.
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
            f"This machine has {rank.local_world_size} processes of the run and {count} GPUs to "
            f"use. Start at most {count} here, or give --device cpu."
        )
    return f"cuda:{rank.local_rank if named == 'all' else named[rank.local_rank]}"
