"""The page that shows a NaN dump, without a browser."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from mjlab.scripts.viz_nan import VizNanConfig, load_dump, run_viz_nan
from mjlab.utils.errors import UserError
from mjlab.utils.nan_guard import CHECKED_FIELDS, NanDump, NanGuard, NanGuardCfg
from mjlab.viewer.viser.nan_page import NanPage

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/><geom name="arm" size=".1" pos=".5 0 0" mass="1"/>
      <body name="hand" pos="1 0 0"><joint name="wrist" axis="0 1 0"/><geom size=".05" mass=".1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/></actuator>
</mujoco>
"""


@pytest.fixture
def dump_file(tmp_path: Path) -> Path:
    """A dump of three substeps of environments 1 and 3. Environment 3 has a larger arm."""
    model = mujoco.MjModel.from_xml_string(XML)
    sizes = torch.tensor(model.geom_size).float().expand(4, -1, -1).clone()
    sizes[3, 1] = 0.3
    guard = NanGuard(
        NanGuardCfg(enabled=True, output_dir=str(tmp_path), buffer_size=3, max_envs_to_dump=2),
        4, model, model_fields=lambda: {"geom_size": sizes},
    )  # fmt: skip
    names = (*CHECKED_FIELDS, "ctrl", "xfrc_applied", "act", "history")
    widths = {"ctrl": 1, "act": 0, "history": 0, "sensordata": 0}
    data = SimpleNamespace(**{name: torch.zeros(4, widths.get(name, 2)) for name in names})
    data.xfrc_applied = torch.zeros(4, model.nbody, 6)
    for step in range(4):
        with guard.watch(data):
            data.qpos[:, 0] = 0.1 * (step + 1)
            data.qvel[:, 1] = 10.0 * (step + 1)
            if step == 3:
                data.qacc[[1, 3]] = torch.nan
    return tmp_path / "nan_dump_latest.npz"


def page_of(server, path: Path) -> NanPage:
    return NanPage(server, *load_dump(str(path)))


def test_the_page_opens_at_the_state_that_led_to_the_nan(viser_server, dump_file: Path) -> None:
    page = page_of(viser_server, dump_file)
    assert "Substep 3** (3 of 3 recorded; NaN found after substep 3)" in page.status
    assert "Environment 1**: went NaN" in page.status
    assert "Environments with NaN: 1, 3 (2 of 4)" in page.status
    assert "Largest |qvel|: 30 (wrist)" in page.status
    np.testing.assert_allclose(page.data.qpos, [0.3, 0.0], rtol=1e-6)
    # Computed, so that bodies are where the state says.
    assert page.data.body("hand").xpos[2] == pytest.approx(1.0 - np.sin(0.3))


def test_names_in_a_dump_are_text(viser_server, dump_file: Path) -> None:
    tag = "<script>"
    dump, model = load_dump(str(dump_file))
    dump.metadata |= {"nan_env_ids": [tag], "dumped_env_ids": [tag, tag]}
    spec = mujoco.MjSpec.from_string(XML)
    spec.joint("wrist").name = tag
    page = NanPage(viser_server, dump, spec.compile())
    assert "<" not in page.status
    assert page.status.count("&lt;script&gt;") == 3


def test_sliders_choose_substep_and_environment(viser_server, dump_file: Path) -> None:
    page = page_of(viser_server, dump_file)
    assert page.model.geom("arm").size[0] == pytest.approx(0.1)
    page._step.value = 0
    page._env.value = 1
    assert page._changed.is_set()
    page.show()
    assert "Substep 1** (1 of 3" in page.status
    assert "Environment 3**" in page.status
    np.testing.assert_allclose(page.data.qpos, [0.1, 0.0], rtol=1e-6)
    # With the environment's own model.
    assert page.model.geom("arm").size[0] == pytest.approx(0.3)


def test_an_environment_that_did_not_go_nan_is_called_clean(viser_server, dump_file: Path) -> None:
    dump, model = load_dump(str(dump_file))
    dump.metadata["nan_env_ids"] = [3]
    assert "Environment 1**: clean" in NanPage(viser_server, dump, model).status


def test_a_state_that_is_not_finite_is_named_and_not_drawn(viser_server, dump_file: Path) -> None:
    dump, model = load_dump(str(dump_file))
    dump.arrays["states_step_000003"][0, 0] = np.nan
    page = NanPage(viser_server, dump, model)
    assert "Not finite here: qpos" in page.status
    page._step.value = 1
    page.show()
    assert "Largest |qacc|" in page.status


def test_a_single_state_of_a_single_environment_is_shown(viser_server, dump_file: Path) -> None:
    dump, model = load_dump(str(dump_file))
    dump.steps = dump.steps[-1:]
    dump.metadata["dumped_env_ids"] = [1]
    page = NanPage(viser_server, dump, model)
    assert "(1 of 1 recorded" in page.status


def test_what_cannot_be_shown_is_one_message(run, dump_file: Path, tmp_path: Path) -> None:
    missing = run("viz_nan", str(tmp_path / "nothing.npz"))
    assert missing.status == 1
    assert "nothing.npz" in missing.message
    (tmp_path / "text.npz").write_text("no dump")
    assert "is not a NaN dump" in run("viz_nan", str(tmp_path / "text.npz")).message
    with pytest.raises(ValueError, match="port.*0"):
        run_viz_nan(str(dump_file), VizNanConfig(port=0))


def without_digest(dump_file: Path) -> Path:
    """Return a copy of a dump as releases before wrote it."""
    dump = NanDump.load(dump_file)
    metadata = {key: value for key, value in dump.metadata.items() if key != "model_sha256"}
    older = dump_file.with_name("older.npz")
    np.savez(older, _metadata=np.array(json.dumps(metadata)), **dump.arrays)
    return older


def test_a_model_that_is_missing_damaged_or_another_is_told(dump_file: Path) -> None:
    model_file = load_dump(str(dump_file))[0].model_file
    content = model_file.read_bytes()
    other = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    mujoco.mj_saveModel(other, str(model_file))
    with pytest.raises(UserError, match="changed or damaged"):
        load_dump(str(dump_file))
    # Dumps of before do not say which model is theirs.
    dump = without_digest(dump_file)
    with pytest.raises(UserError, match="another simulation"):
        load_dump(str(dump))
    model_file.write_bytes(content[:100])
    with pytest.raises(UserError, match="written by MuJoCo"):
        load_dump(str(dump))
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    model_file.write_bytes(flipped)
    with pytest.raises(UserError, match="changed or damaged"):
        load_dump(str(dump_file))
    model_file.unlink()
    with pytest.raises(FileNotFoundError, match=rf"{dump_file}.*model_.*\.mjb"):
        load_dump(str(dump_file))


def test_a_dump_that_is_damaged_or_says_too_little_is_told(dump_file: Path, tmp_path: Path) -> None:
    content = dump_file.read_bytes()
    dump, model = load_dump(str(dump_file))
    dump_file.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="is damaged"):
        load_dump(str(dump_file))
    metadata = {name: dump.metadata[name] for name in ("model_file", "state_spec")}
    np.savez(dump_file, _metadata=np.array(json.dumps(metadata)), **dump.arrays)
    with pytest.raises(ValueError, match=r"metadata .*'state_size'.* not found"):
        load_dump(str(dump_file))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"ctrl_step_000002": np.array([{}], dtype=object)},
            "ctrl_step_000002: Python objects",
        ),
        ({"states_step_000002": np.zeros((2, 3))}, r"states_step_000002.*shape \(2, 4\)"),
        ({"states_step_000002": np.zeros((2, 2, 2))}, r"states_step_000002.*shape \(2, 4\)"),
        ({"states_step_000002": np.zeros((2, 4), complex)}, "states_step_000002.*real numbers"),
        ({"ctrl_step_000002": np.full((2, 1), "1.0")}, "ctrl_step_000002.*real numbers"),
        ({"states_step_000002": np.zeros((5, 4))}, "states_step_000002.* expected 2 rows"),
        ({"ctrl_step_000002": np.zeros((2, 7))}, "another simulation"),
        ({"model_no_field": np.zeros((2, 7))}, "another simulation"),
        ({"states_step_x": np.zeros((2, 4))}, "'states_step_x'"),
        ({"_metadata": np.array("[1, 2]")}, "not found"),
        ({"_metadata": np.array("[" * 100_000)}, "is not a NaN dump"),
    ],
)
def test_what_is_wrong_in_a_dump_is_named(dump_file: Path, change, words: str) -> None:
    dump, _ = load_dump(str(dump_file))
    metadata = {"_metadata": np.array(json.dumps(dump.metadata))}
    np.savez(dump_file, **{**dump.arrays, **metadata, **change})
    with pytest.raises((UserError, ValueError), match=words) as caught:
        load_dump(str(dump_file))
    assert "allow_pickle" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "ids"),
    [("nan_env_ids", [4]), ("nan_env_ids", ["<b>"]), ("dumped_env_ids", [-1, 3])],
)
def test_environments_that_are_not_simulated_are_named(dump_file: Path, field, ids) -> None:
    dump, _ = load_dump(str(dump_file))
    metadata = {"_metadata": np.array(json.dumps({**dump.metadata, field: ids}))}
    np.savez(dump_file, **dump.arrays, **metadata)
    with pytest.raises(ValueError, match=rf"is not a NaN dump.*{field}: expected 0 to 3"):
        load_dump(str(dump_file))


def test_a_dump_that_is_no_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "dump.npz")
    with pytest.raises(OSError, match="not a file.*dump.npz"):
        load_dump(str(tmp_path / "dump.npz"))


def test_a_dump_with_spoilt_bytes_is_an_error_or_a_dump(dump_file: Path) -> None:
    content = dump_file.read_bytes()
    generator = np.random.default_rng(0)
    for position in generator.integers(len(content), size=60):
        spoilt = bytearray(content)
        spoilt[position] ^= 1 << int(generator.integers(8))
        for data in (bytes(spoilt), content[:position]):
            dump_file.write_bytes(data)
            with contextlib.suppress(UserError, ValueError):
                load_dump(str(dump_file))


def test_help_comes_without_building_anything() -> None:
    code = (
        "import sys; sys.argv = ['viz-nan', '--help']\n"
        "from mjlab.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "assert not {'torch', 'mujoco', 'tyro', 'viser'} & set(sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "nan_dump_latest.npz" in told.stdout
