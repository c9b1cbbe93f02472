"""NaN detection: record physics states and dump those before a NaN or infinite value."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import tempfile
import warnings
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.utils.errors import check_count, check_in_range, check_one_of
from mjlab.utils.memory import check_memory
from mjlab.utils.os import check_archive, own_folder, regular_file, replacing, write_atomically

if TYPE_CHECKING:
    import mujoco
    import numpy as np
    import torch

logger = logging.getLogger(__name__)

CHECKED_FIELDS = ("qpos", "qvel", "qacc", "qacc_warmstart", "sensordata")
"""Fields checked for NaN and infinite values."""

_PHYSICS_STATE = ("qpos", "qvel", "act", "history")
_MOCAP_STATE = ("mocap_pos", "mocap_quat")
_INPUTS = ("ctrl", "xfrc_applied")
_FORMAT = 2
_ARCHIVE = b"PK\x03\x04"
_STATES = re.compile(r"states_step_(\d{6}|[1-9]\d{6,})", re.ASCII)
# Metadata entry that explains a dump to readers of the file.
_NOTE = (
    "States are those before each substep; the last state led to the NaN. Arrays model_<field> hold "
    "per-environment values of the dumped environments; the model file holds the compiled values."
)
# Metadata entries required for replay, and their types.
_METADATA = {
    "model_file": str,
    "num_envs_total": int,
    "num_envs_dumped": int,
    "dumped_env_ids": list,
    "nan_env_ids": list,
    "state_spec": int,
    "state_size": int,
    "detection_step": int,
}


@dataclass
class NanGuardCfg:
    """NaN guard configuration."""

    enabled: bool = False
    """Record physics states. Recording copies the state before every substep and synchronizes
    the GPU after it; enable it only for debugging."""
    buffer_size: int = 100
    """Number of substeps to keep."""
    output_dir: str = field(
        default_factory=lambda: str(Path(tempfile.gettempdir()) / "mjlab" / "nan_dumps")
    )
    """Output folder of dumps. If the folder is in a shared folder such as `/tmp` and belongs to
    another user, dumps go to `~/.cache/mjlab/` instead."""
    max_envs_to_dump: int = 5
    """Maximum number of environments in a dump; the first environments with NaN are taken."""


class NanGuard:
    """Keeps the last states of all environments and dumps them on the first NaN.

    Only the first detection is dumped. The guard neither stops nor repairs the simulation;
    environments reset themselves on NaN, see `detect_nans`.
    """

    def __init__(
        self,
        cfg: NanGuardCfg,
        num_envs: int,
        mj_model: mujoco.MjModel,
        *,
        model_fields: Callable[[], Mapping[str, torch.Tensor]] | None = None,
    ) -> None:
        """Allocate buffers for `num_envs` environments of `mj_model`.

        `model_fields` returns the per-environment model fields, each (N, ...), at the time of a
        dump. None: dumps hold only the compiled model.
        """
        if cfg.enabled and (cfg.buffer_size == 0 or cfg.max_envs_to_dump == 0):
            warnings.warn(
                f"NanGuardCfg: expected buffer_size and max_envs_to_dump >= 1, got {cfg.buffer_size} "
                f"and {cfg.max_envs_to_dump}; dumps will hold no states.",
                UserWarning,
                stacklevel=2,
            )
        self.cfg = cfg
        self.enabled = cfg.enabled
        self.num_envs = num_envs
        self.mj_model = mj_model
        self.model_fields = model_fields
        self.buffer: deque[dict[str, torch.Tensor]] = deque(maxlen=cfg.buffer_size)
        self.dump_path: Path | None = None
        self._steps = 0
        self._dumped = False
        mocap = _MOCAP_STATE if mj_model.nmocap else ()
        sizes = {"act": mj_model.na, "history": mj_model.nhistory}
        self._state_fields = [n for n in (*_PHYSICS_STATE, *mocap) if sizes.get(n, 1)]
        self._input_fields = [n for n in _INPUTS if n != "ctrl" or mj_model.nu]
        if cfg.enabled:
            check_count("NanGuardCfg buffer_size", cfg.buffer_size, 0)
            numbers = mj_model.nq + mj_model.nv + mj_model.nu + 6 * mj_model.nbody
            cure = "a smaller buffer_size, or fewer environments"
            check_memory(
                "NanGuardCfg buffer_size", cfg.buffer_size, 4 * numbers * num_envs, "cpu", cure
            )

    def capture(self, wp_data: Any) -> None:
        """Record the current state of all environments. Call before each substep."""
        if self.enabled and not self._dumped:
            names = (*self._state_fields, *self._input_fields)
            self.buffer.append({name: getattr(wp_data, name).clone() for name in names})
            self._steps += 1

    def check_and_dump(self, data: Any) -> bool:
        """Return True if any environment has NaN; write a dump on the first detection."""
        if not self.enabled or self._dumped:
            return False
        ids = self.detect_nans(data).nonzero().flatten().tolist()
        if not ids:
            return False
        self._dumped = True
        try:
            self.dump_path = self._dump(ids)
        except OSError as error:
            # A full disk must not end the run.
            message = f"but the dump could not be written to {self.cfg.output_dir}: {error}"
            logger.error("NaN in environments %s, %s.", ids[:10], message)
        else:
            message = f"previous states are in {self.dump_path} (view with viz-nan)"
            logger.warning(
                "NaN in environments %s at substep %d; %s.", ids[:10], self._steps, message
            )
        self.buffer.clear()
        return True

    @contextmanager
    def watch(self, wp_data: Any) -> Generator[None]:
        """Call `capture` before the enclosed substep and `check_and_dump` after it."""
        self.capture(wp_data)
        yield
        self.check_and_dump(wp_data)

    @staticmethod
    def detect_nans(data: Any, fields: tuple[str, ...] = CHECKED_FIELDS) -> torch.Tensor:
        """Return True for environments with NaN or infinite values, (N,) bool.

        `data` is any object with the checked fields as (N, ...) tensors, such as `sim.data`. Does
        not synchronize the GPU.
        """
        invalid = None
        for name in fields:
            values = getattr(data, name)
            # Multiplication by zero maps NaN and infinite values to NaN, and other values to zero,
            # so the sum over a row cannot overflow.
            bad = (values.flatten(1) * 0).sum(dim=1) != 0
            invalid = bad if invalid is None else invalid | bad
        if invalid is None:
            raise ValueError("detect_nans fields: expected at least one field, got none.")
        return invalid

    def _dump(self, nan_ids: list[int]) -> Path:
        import mujoco
        import numpy as np

        ids = nan_ids[: self.cfg.max_envs_to_dump]
        stamp = datetime.now().strftime("%Y%m%d_%H%M%S")
        folder = own_folder(Path(self.cfg.output_dir))
        path, model_path = folder / f"nan_dump_{stamp}.npz", folder / f"model_{stamp}.mjb"
        arrays = self._recorded(ids)
        model = np.empty(mujoco.mj_sizeModel(self.mj_model), np.uint8)
        mujoco.mj_saveModel(self.mj_model, None, model)
        metadata = self._metadata(nan_ids, ids, stamp, model_path)
        metadata["model_sha256"] = hashlib.sha256(model.tobytes()).hexdigest()
        arrays["_metadata"] = np.array(json.dumps(metadata))
        write_atomically(model_path, model.tobytes())
        with replacing(path) as file:
            np.savez_compressed(file, **arrays)
        _link(folder / "nan_dump_latest.npz", path)
        _link(folder / "model_latest.mjb", model_path)
        return path

    def _recorded(self, ids: list[int]) -> dict[str, Any]:
        """Return the recorded substeps and the model fields; states are in `mj_setState` order."""
        import numpy as np

        arrays: dict[str, Any] = {}
        first = self._steps - len(self.buffer)
        for step, kept in enumerate(self.buffer, start=first):
            rows = [
                kept[name][ids].flatten(1).cpu().numpy().astype(np.float64)
                for name in self._state_fields
            ]
            arrays[f"states_step_{step:06d}"] = np.concatenate(rows, axis=1)
            for name in self._input_fields:
                arrays[f"{name}_step_{step:06d}"] = kept[name][ids].cpu().numpy()
        fields = {} if self.model_fields is None else self.model_fields()
        return arrays | {f"model_{name}": v[ids].cpu().numpy() for name, v in fields.items()}

    def _metadata(
        self, nan_ids: list[int], ids: list[int], stamp: str, model_path: Path
    ) -> dict[str, Any]:
        import mujoco

        return {
            "format": _FORMAT,
            "num_envs_total": self.num_envs,
            "num_envs_dumped": len(ids),
            "nan_env_ids": nan_ids,
            "dumped_env_ids": ids,
            "state_spec": state_spec(self.mj_model),
            "state_size": mujoco.mj_stateSize(self.mj_model, state_spec(self.mj_model)),
            "buffer_size": len(self.buffer),
            "detection_step": self._steps,
            "timestamp": stamp,
            "model_file": model_path.name,
            "note": _NOTE,
        }


def state_spec(mj_model: mujoco.MjModel) -> int:
    """Return the `mjtState` bits in a dump of `mj_model`: physics, and mocap if present."""
    import mujoco

    spec = int(mujoco.mjtState.mjSTATE_PHYSICS)
    if mj_model.nmocap:
        mocap = mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
        spec |= int(mocap)
    return spec


@dataclass
class NanDump:
    """Dump written by `NanGuard`, loaded for replay."""

    metadata: dict[str, Any]
    """See `NanGuard`; `dumped_env_ids` are the environments of the array rows."""
    model_file: Path
    """Compiled model, next to the dump."""
    steps: list[int]
    """Indices of the recorded substeps, ascending."""
    arrays: dict[str, np.ndarray[Any, Any]]
    """`states_step_*`, `ctrl_step_*`, `xfrc_applied_step_*` and `model_*`."""

    @classmethod
    def load(cls, path: str | Path) -> NanDump:
        """Load a dump. No code in the file is executed.

        Raises:
            FileNotFoundError: `path` does not exist.
            OSError: `path` is a folder, or another kind of path without an end.
            ValueError: the file is not a valid dump.
        """
        path = Path(path).resolve()
        with regular_file(path).open("rb") as file:
            is_archive = file.read(len(_ARCHIVE)) == _ARCHIVE
        try:
            if not is_archive:
                raise ValueError("not an .npz file")
            arrays = _read_arrays(path)
            metadata = json.loads(str(arrays.pop("_metadata")))
            if missing := [name for name in _METADATA if name not in metadata]:
                raise ValueError(f"metadata {missing} not found")
            for name, kind in _METADATA.items():
                if not isinstance(metadata[name], kind):
                    raise ValueError(
                        f"metadata {name}: expected {kind.__name__}, got {metadata[name]!r}"
                    )
            rows = metadata["num_envs_dumped"]
            if rows != len(metadata["dumped_env_ids"]) or rows < 1:
                raise ValueError(f"num_envs_dumped={rows} does not match dumped_env_ids")
            number = metadata["num_envs_total"]
            for name in ("nan_env_ids", "dumped_env_ids"):
                if any(type(env) is not int or not 0 <= env < number for env in metadata[name]):
                    raise ValueError(f"{name}: expected 0 to {number - 1}, got {metadata[name]}")
            if odd := [name for name, array in arrays.items() if array.dtype.kind not in "fiub"]:
                raise ValueError(f"{odd}: expected real numbers")
            short = [name for name, array in arrays.items() if array.shape[:1] != (rows,)]
            if short:
                raise ValueError(f"{short}: expected {rows} rows")
            states = [name for name in arrays if name.startswith("states_step_")]
            if odd := [name for name in states if not _STATES.fullmatch(name)]:
                raise ValueError(f"expected arrays states_step_000000, ..., got {odd[:3]}")
            size = metadata["state_size"]
            if odd := [name for name in states if arrays[name].shape != (rows, size)]:
                raise ValueError(f"{odd}: expected shape ({rows}, {size})")
            steps = sorted(int(name.rpartition("_")[2]) for name in states)
            if not steps:
                raise ValueError("expected recorded states, got none")
        except Exception as error:
            # Damaged bytes can make the readers raise any exception.
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ValueError(
                f"{path} is not a NaN dump of this mjlab version, or is damaged: {reason}."
            ) from error
        model_file = path.parent / Path(metadata["model_file"]).name
        return cls(metadata=metadata, model_file=model_file, steps=steps, arrays=arrays)

    def apply(self, step: int, row: int, mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
        """Write the recorded values of one environment to a host model and data, without forward.

        `step` is one of `steps`, `row` an index into `metadata["dumped_env_ids"]`.

        Raises:
            ValueError: the dump does not contain the substep or row.
        """
        import mujoco

        check_one_of("NanDump.apply substep", step, self.steps)
        check_in_range("NanDump.apply row", row, 0, self.metadata["num_envs_dumped"] - 1)
        state = self.arrays[f"states_step_{step:06d}"][row]
        mujoco.mj_setState(mj_model, mj_data, state, self.metadata["state_spec"])
        for name in _INPUTS:
            values = self.arrays.get(f"{name}_step_{step:06d}")
            if values is not None:
                getattr(mj_data, name)[:] = values[row]
        names = [name for name in self.arrays if name.startswith("model_")]
        for name in names:
            field, values = name.removeprefix("model_"), self.arrays[name]
            owner: Any = mj_model if hasattr(mj_model, field) else mj_model.opt
            present = getattr(owner, field)
            if getattr(present, "shape", ()):
                present[:] = values[row].reshape(present.shape)
            else:
                setattr(owner, field, values[row].item())


def _read_arrays(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    import numpy as np

    arrays = {}
    with np.load(path, allow_pickle=False) as file:
        check_archive(path)
        for name in file.files:
            try:
                arrays[name] = file[name]
            except ValueError as error:
                if "allow_pickle" in str(error):
                    raise ValueError(
                        f"{name}: Python objects are not allowed in dumps; nothing was executed"
                    ) from error
                raise
    return arrays


def _link(link: Path, target: Path) -> None:
    """Link `link` to `target`, or copy it on file systems without links."""
    link.unlink(missing_ok=True)
    try:
        os.symlink(target.name, link)
    except OSError:
        write_atomically(link, target.read_bytes())
