"""The guard finds what is not finite, keeps what led to it, and harms nothing."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.nan_guard import CHECKED_FIELDS, NanDump, NanGuard, NanGuardCfg

XML = """
<mujoco>
  <worldbody>
    <body name="target" mocap="true"/>
    <body><joint name="a" damping=".1"/><geom size=".1" mass="1" pos=".2 0 0"/></body>
    <body><freejoint/><geom size=".1" mass="2"/></body>
  </worldbody>
  <actuator><general joint="a" dyntype="integrator"/></actuator>
  <sensor><jointpos joint="a"/></sensor>
</mujoco>
"""
NUM_ENVS = 6


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture
def data(model: mujoco.MjModel) -> SimpleNamespace:
    host = mujoco.MjData(model)
    mujoco.mj_forward(model, host)
    names = (*CHECKED_FIELDS, "act", "ctrl", "xfrc_applied", "mocap_pos", "mocap_quat", "history")
    rows = {name: torch.as_tensor(getattr(host, name)).float() for name in names}
    return SimpleNamespace(
        **{name: row.expand(NUM_ENVS, *row.shape).clone() for name, row in rows.items()}
    )


def make_guard(model: mujoco.MjModel, folder: Path, **cfg: object) -> NanGuard:
    full = NanGuardCfg(enabled=True, output_dir=str(folder), **cfg)  # type: ignore[arg-type]
    return NanGuard(full, NUM_ENVS, model)


def run_until_nan(guard: NanGuard, data: SimpleNamespace, envs: list[int], steps: int = 4) -> None:
    """Count `qpos` of the hinge up by one a substep, and spoil environments at the last."""
    for step in range(steps):
        with guard.watch(data):
            data.ctrl.fill_(step * 0.1)
            data.qpos[:, 0] += 1.0
            if step == steps - 1:
                data.qvel[envs, 0] = torch.nan


@settings(deadline=None, max_examples=40)
@given(
    values=st.lists(
        st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=6, max_size=6
    ),
    field=st.sampled_from(CHECKED_FIELDS),
)
def test_environments_not_finite_are_found(values: list[float], field: str) -> None:
    data = SimpleNamespace(**{name: torch.zeros(6, 3) for name in CHECKED_FIELDS})
    # The largest finite values must not overflow into a false alarm.
    getattr(data, field)[:] = torch.tensor(values)[:, None]
    assert NanGuard.detect_nans(data).tolist() == [not np.isfinite(value) for value in values]


def test_fields_without_elements_are_finite() -> None:
    data = SimpleNamespace(**{name: torch.zeros(2, 0) for name in CHECKED_FIELDS})
    assert NanGuard.detect_nans(data).tolist() == [False, False]


def test_a_disabled_guard_keeps_and_writes_nothing(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = NanGuard(NanGuardCfg(output_dir=str(tmp_path / "dumps")), NUM_ENVS, model)
    run_until_nan(guard, data, [0])
    assert not guard.buffer
    assert not (tmp_path / "dumps").exists()


def test_a_dump_is_read_without_pickle_and_holds_what_led_to_the_nan(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path, buffer_size=3, max_envs_to_dump=2)
    run_until_nan(guard, data, [1, 3, 5])
    with np.load(tmp_path / "nan_dump_latest.npz", allow_pickle=False) as file:
        metadata = json.loads(str(file["_metadata"]))
        names = [name for name in file.files if name.startswith("states_step_")]
        last = file["states_step_000003"]
    assert names == [f"states_step_{step:06d}" for step in (1, 2, 3)]
    assert last.dtype == np.float64
    assert last.shape == (2, metadata["state_size"])
    # The state before the substep that failed, which itself is finite.
    assert np.isfinite(last).all()
    assert last[:, 0].tolist() == [3.0, 3.0]
    assert metadata["nan_env_ids"] == [1, 3, 5]
    assert metadata["dumped_env_ids"] == [1, 3]
    assert metadata["num_envs_total"] == NUM_ENVS
    assert metadata["num_envs_dumped"] == 2
    assert metadata["detection_step"] == 4
    assert metadata["buffer_size"] == 3
    assert (tmp_path / metadata["model_file"]).is_file()
    assert mujoco.MjModel.from_binary_path(str(tmp_path / "model_latest.mjb")).nq == model.nq


def test_a_dump_replays_state_inputs_and_the_environments_own_model(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path)
    masses = torch.arange(NUM_ENVS).view(-1, 1) + torch.as_tensor(model.body_mass).float()
    gravity = torch.tensor([0.0, 0.0, -3.0]).expand(NUM_ENVS, 3)
    guard.model_fields = lambda: {"body_mass": masses, "gravity": gravity}
    data.xfrc_applied[4, 2, 2] = 7.0
    data.mocap_pos[4, 0, 1] = 0.5
    data.act[4] = 0.25
    run_until_nan(guard, data, [4])

    dump = NanDump.load(guard.dump_path or "")
    host_model = mujoco.MjModel.from_binary_path(str(dump.model_file))
    host = mujoco.MjData(host_model)
    dump.apply(dump.steps[-1], 0, host_model, host)
    assert host.qpos[0] == 3.0
    assert host.act[0] == 0.25
    assert host.mocap_pos[0, 1] == 0.5
    # The input of the last state is the one of the substep before: the failing one sets its own.
    assert host.ctrl[0] == pytest.approx(0.2)
    assert host.xfrc_applied[2, 2] == 7.0
    np.testing.assert_allclose(host_model.body_mass, masses[4])
    assert host_model.opt.gravity[2] == -3.0


def test_only_the_first_detection_is_written(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path)
    run_until_nan(guard, data, [0])
    written = sorted(tmp_path.iterdir())
    run_until_nan(guard, data, [2])
    assert sorted(tmp_path.iterdir()) == written
    assert not guard.buffer, "states are not copied for a dump that will not come"


def test_the_guard_repairs_nothing(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    run_until_nan(make_guard(model, tmp_path), data, [2])
    assert data.qvel[2, 0].isnan()
    assert NanGuard.detect_nans(data).nonzero().flatten().tolist() == [2]


def test_a_folder_that_cannot_be_written_does_not_end_the_run(
    model: mujoco.MjModel,
    data: SimpleNamespace,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("not a folder")
    guard = make_guard(model, in_the_way / "dumps")
    with caplog.at_level(logging.ERROR):
        run_until_nan(guard, data, [0])
    assert "could not be written" in caplog.text
    assert guard.dump_path is None


def test_a_dump_replaces_the_links_of_an_earlier_one(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    (tmp_path / "nan_dump_latest.npz").symlink_to("gone.npz")
    guard = make_guard(model, tmp_path)
    run_until_nan(guard, data, [0])
    assert (tmp_path / "nan_dump_latest.npz").resolve() == guard.dump_path


def test_a_dump_goes_elsewhere_if_another_user_planted_its_folder(
    model: mujoco.MjModel,
    data: SimpleNamespace,
    tmp_path: Path,
    plant: Callable[[Path, Path], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    victim, shared = tmp_path / "victim", tmp_path / "shared"
    victim.mkdir()
    shared.mkdir()
    shared.chmod(0o1777)
    plant(shared / "mjlab", victim)
    guard = make_guard(model, shared / "mjlab" / "nan_dumps")
    run_until_nan(guard, data, [0])
    assert not list(victim.iterdir())
    assert guard.dump_path is not None
    assert guard.dump_path.parent == tmp_path / "cache" / "mjlab" / "nan_dumps"
    assert NanDump.load(guard.dump_path).steps == [0, 1, 2, 3]


def test_asking_for_a_substep_that_is_not_in_the_dump_says_what_is(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path)
    run_until_nan(guard, data, [0])
    dump = NanDump.load(guard.dump_path or "")
    with pytest.raises(ValueError, match="substep: expected .*0, 1, 2, 3.*got 9"):
        dump.apply(9, 0, model, mujoco.MjData(model))


def test_a_dump_after_a_million_substeps_is_read_in_order(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path)
    guard._steps = 999_998
    run_until_nan(guard, data, [0])
    dump = NanDump.load(guard.dump_path or "")
    assert dump.steps == [999_998, 999_999, 1_000_000, 1_000_001]
    dump.apply(1_000_001, 0, model, mujoco.MjData(model))


def test_a_file_that_is_no_dump_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.npz"
    np.savez(path, a=np.zeros(3))
    with pytest.raises(ValueError, match="is not a NaN dump"):
        NanDump.load(path)
    # A pickle inside is rejected, not executed.
    np.savez(path, _metadata=np.array({"model_file": "m"}, dtype=object))
    with pytest.raises(ValueError, match="is not a NaN dump"):
        NanDump.load(path)
    with pytest.raises(FileNotFoundError):
        NanDump.load(tmp_path / "missing.npz")


def test_a_dump_without_states_is_refused(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path
) -> None:
    guard = make_guard(model, tmp_path)
    run_until_nan(guard, data, [0])
    with np.load(guard.dump_path or "") as arrays:
        kept = {name: arrays[name] for name in arrays if not name.startswith("states_step_")}
        states = arrays["states_step_000000"]
    path = Path(guard.dump_path or "").with_name("other.npz")
    np.savez(path, **kept)
    with pytest.raises(ValueError, match="recorded states, got none"):
        NanDump.load(path)
    for name in ("states_step_0", "states_step_0000001", "states_step_x", "states_step_00000٣"):
        np.savez(path, **kept, **{name: states})
        with pytest.raises(ValueError, match=f"other.npz is not .*expected arrays .*{name}"):
            NanDump.load(path)


@pytest.mark.parametrize("field", ["buffer_size", "max_envs_to_dump"])
def test_a_size_of_zero_keeps_no_states(
    model: mujoco.MjModel, data: SimpleNamespace, tmp_path: Path, field: str
) -> None:
    with pytest.warns(UserWarning, match="no states"):
        guard = make_guard(model, tmp_path, **{field: 0})
    run_until_nan(guard, data, [2])
    with np.load(guard.dump_path or "", allow_pickle=False) as file:
        metadata = json.loads(str(file["_metadata"]))
        states = [file[name] for name in file.files if name.startswith("states_step_")]
    assert metadata["nan_env_ids"] == [2]
    assert sum(rows.size for rows in states) == 0
    assert metadata["buffer_size"] == len(states)
