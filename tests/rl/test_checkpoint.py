"""Checkpoint files: atomic writes, plain data only, errors of unusable files."""

from __future__ import annotations

import errno
import math
import os
import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mjlab.rl.checkpoint import (
    CheckpointError,
    RunFolderError,
    check_terms,
    copied,
    ensure_writable_folder,
    load_checkpoint,
    migrate,
    save_checkpoint,
)
from mjlab.utils.random import preserved_rng, rng_state, set_rng_state


def test_data_comes_back_as_saved(tmp_path: Path):
    data = {"a": torch.arange(3), "b": {"c": [1, 2.5, "x", None, (True,)]}}
    save_checkpoint(data, tmp_path / "new" / "model_0.pt")
    loaded = load_checkpoint(tmp_path / "new" / "model_0.pt")
    assert torch.equal(loaded.pop("a"), data.pop("a"))
    assert loaded == data
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["model_0.pt"]


@pytest.mark.parametrize("failing", ["write", "fsync", "replace"])
def test_a_failing_save_leaves_the_previous_file_and_nothing_else(
    tmp_path: Path, monkeypatch, failing
):
    path = tmp_path / "model_3.pt"
    save_checkpoint({"a": 1}, path)

    def fail(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if failing == "write":
        monkeypatch.setattr(torch, "save", fail)
    else:
        monkeypatch.setattr(os, failing, fail)
    with pytest.raises(CheckpointError, match="disk is full") as caught:
        save_checkpoint({"a": 2}, path)
    assert "model_3.pt', is intact" in str(caught.value)
    assert "--agent.resume True" in str(caught.value)
    monkeypatch.undo()
    assert load_checkpoint(path) == {"a": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["model_3.pt"]


def test_the_file_is_on_the_disk_before_it_takes_its_name(tmp_path: Path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        original = getattr(os, name)

        def record(*args, _name=name, _original=original):
            calls.append(_name)
            return _original(*args)

        monkeypatch.setattr(os, name, record)
    save_checkpoint({"a": 1}, tmp_path / "model_0.pt")
    assert calls == ["fsync", "replace", "fsync"]


def test_a_missing_checkpoint_names_those_there_are(tmp_path: Path):
    save_checkpoint({}, tmp_path / "model_7.pt")
    with pytest.raises(CheckpointError, match=r"model_8.pt': .*\['model_7.pt'\]"):
        load_checkpoint(tmp_path / "model_8.pt")
    with pytest.raises(CheckpointError, match=r"nowhere.*: \[\]"):
        load_checkpoint(tmp_path / "nowhere" / "model_8.pt")
    with pytest.raises(CheckpointError, match=r"found a folder.*\['model_7.pt'\]"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("keep", [0, 1, 10, 200, 700])
def test_a_truncated_checkpoint_is_called_so(tmp_path: Path, keep):
    path = tmp_path / "model_0.pt"
    save_checkpoint({"a": torch.zeros(100)}, path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match="corrupt|not a file of torch"):
        load_checkpoint(path)


def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path: Path):
    path = tmp_path / "model_0.pt"
    generator = torch.Generator().manual_seed(0)
    data = {"weights": torch.randn(300, generator=generator), "iter": 3, "lr": 1e-3}
    save_checkpoint(data, path)
    whole = path.read_bytes()
    draw, rejected = random.Random(0), 0
    for _ in range(300):
        flipped = bytearray(whole)
        flipped[draw.randrange(len(whole))] ^= 1 << draw.randrange(8)
        path.write_bytes(flipped)
        try:
            loaded = load_checkpoint(path)
        except CheckpointError:
            rejected += 1
        else:
            assert torch.equal(loaded["weights"], data["weights"])
            assert (loaded["iter"], loaded["lr"]) == (3, 1e-3)
    # Most of the file is weights; the rest is padding.
    assert rejected > 100


def entry(*way: Any) -> Any:
    """Return a function that edits the entry at `way` of a checkpoint; None: removes it."""

    def edit(content: dict[str, Any], change: Callable[[Any], Any] | None) -> None:
        for key in way[:-1]:
            content = content[key]
        if change is None:
            del content[way[-1]]
        else:
            content[way[-1]] = change(content[way[-1]])

    return edit


WEIGHT = entry("actor_state_dict", "mlp.0.weight")
MOMENT = entry("optimizer_state_dict", "state", 1, "exp_avg")
STEP = entry("optimizer_state_dict", "state", 1, "step")
GROUP = ("optimizer_state_dict", "param_groups", 0)
EDITS: dict[str, tuple[Any, Any]] = {
    "NaN weights": (WEIGHT, lambda x: x * math.nan),
    "quantized weights": (WEIGHT, lambda x: torch.quantize_per_tensor(x, 0.1, 0, torch.qint8)),
    "sparse weights": (WEIGHT, torch.Tensor.to_sparse),
    "a text for weights": (WEIGHT, lambda x: "mlp"),
    "no weights": (entry("actor_state_dict"), None),
    "integer keys": (entry("actor_state_dict"), lambda x: dict(enumerate(x.values()))),
    "other moments": (MOMENT, lambda x: x + 1e-9),
    "a negative rate": (entry(*GROUP, "lr"), lambda x: -x),
    "a group too many": (entry(*GROUP[:2]), lambda x: x * 2),
    "no states": (entry("optimizer_state_dict", "state"), None),
    "a text for iterations": (entry("iterations_finished"), str),
    "a list of infos": (entry("infos"), lambda x: [x]),
    "a tensor for the checksum": (entry("checksum"), lambda x: torch.ones(2, 3)),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> dict[str, Any]:
    from rl_fake_env import FakeEnv, FakeEnvCfg, runner_cfg

    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper

    runner = MjlabOnPolicyRunner(RslRlVecEnvWrapper(FakeEnv(FakeEnvCfg())), runner_cfg())
    runner.learn(2)
    path = tmp_path_factory.mktemp("saved") / "model_1.pt"
    runner.save(str(path))
    return load_checkpoint(path)


@pytest.mark.parametrize("what", EDITS)
def test_an_edited_checkpoint_is_told(make_runner, tmp_path: Path, caplog, saved, what):
    path = tmp_path / "model_1.pt"
    save_checkpoint({}, tmp_path / "model_0.pt")
    save_checkpoint(saved, path)
    content = torch.load(path, weights_only=True)
    edit, change = EDITS[what]
    edit(content, change)
    torch.save(content, path)
    runner = make_runner()
    before, said = copied(runner.alg.save()), ""
    try:
        runner.load(str(path))
    except CheckpointError as error:
        said = str(error)
        after = runner.alg.save()
        for part in ("actor_state_dict", "critic_state_dict"):
            assert all(torch.equal(before[part][key], after[part][key]) for key in before[part])
    said += caplog.text
    assert "model_1.pt" in said
    assert "use an earlier checkpoint" in said
    assert "model_0.pt" in said


@pytest.mark.parametrize("way", [WEIGHT, MOMENT])
def test_nan_without_checksum_is_refused(make_runner, tmp_path: Path, saved, way):
    content = copied(saved)
    way(content, lambda x: x * math.nan)
    torch.save(content, tmp_path / "model_1.pt")
    with pytest.raises(CheckpointError, match=r"model_1.pt.*is NaN or infinite"):
        make_runner().load(str(tmp_path / "model_1.pt"))


def test_contents_without_checksum_are_not_judged(tmp_path: Path, caplog):
    torch.save({"a": torch.zeros(2)}, tmp_path / "model_0.pt")
    assert list(load_checkpoint(tmp_path / "model_0.pt")) == ["a"]
    save_checkpoint({"names": {"a", "b", "c"}, "b": [1, None]}, tmp_path / "model_1.pt")
    load_checkpoint(tmp_path / "model_1.pt")
    assert not caplog.text


def test_too_little_memory_is_no_fault_of_the_file(make_runner, tmp_path, saved, monkeypatch):
    save_checkpoint(saved, tmp_path / "model_1.pt")
    runner = make_runner()
    load = runner.alg.load

    def fail(content, *args):
        # The second call restores the networks.
        monkeypatch.setattr(runner.alg, "load", load)
        raise MemoryError

    monkeypatch.setattr(runner.alg, "load", fail)
    with pytest.raises(MemoryError):
        runner.load(str(tmp_path / "model_1.pt"))


KEPT: dict[str, tuple[Any, Any]] = {
    "doubles": (WEIGHT, torch.Tensor.double),
    "parameters": (WEIGHT, torch.nn.Parameter),
    "steps as numbers": (STEP, float),
    "moments in one memory": (MOMENT, lambda x: x.t().contiguous().t() if x.dim() == 2 else x),
    "settings of an earlier torch": (entry(*GROUP, "decoupled_weight_decay"), None),
    "settings of a later torch": (entry(*GROUP), lambda x: {**x, "later": "text"}),
    "betas in a list": (entry(*GROUP, "betas"), list),
}


@pytest.mark.parametrize("what", KEPT)
def test_the_same_state_in_another_form_resumes(make_runner, tmp_path: Path, saved, what):
    edit, change = KEPT[what]
    content = copied(saved)
    edit(content, change)
    torch.save(content, tmp_path / "model_1.pt")
    save_checkpoint(saved, tmp_path / "model_2.pt")
    results = []
    for name in ("model_1.pt", "model_2.pt"):
        runner = make_runner()
        runner.load(str(tmp_path / name))
        runner.learn(3)
        results.append(runner.alg.save()["actor_state_dict"])
    assert all(torch.equal(results[0][key], results[1][key]) for key in results[0])


def test_moments_that_share_memory_are_separated(make_runner, tmp_path: Path, saved):
    content = copied(saved)
    state = content["optimizer_state_dict"]["state"][1]
    state["exp_avg_sq"] = state["exp_avg"] = torch.ones(1).expand(state["exp_avg"].shape)
    torch.save(content, tmp_path / "model_1.pt")
    runner = make_runner()
    runner.load(str(tmp_path / "model_1.pt"))
    runner.learn(3)
    state = runner.alg.optimizer.state_dict()["state"][1]
    assert not torch.equal(state["exp_avg"], state["exp_avg_sq"])


@pytest.mark.parametrize("garbage", [7, {}, None, {"a": torch.zeros(2)}])
@pytest.mark.parametrize(
    "part", ["version", "num_envs", "rng", "observations", "logger", "hidden_states"]
)
def test_a_malformed_training_state_is_one_clear_error(
    make_runner, tmp_path: Path, caplog, part, garbage
):
    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    checkpoint = load_checkpoint(tmp_path / "run" / "model_0.pt")
    checkpoint["training_state"][part] = garbage
    save_checkpoint(checkpoint, tmp_path / "model_0.pt")
    other = make_runner()
    other.load(str(tmp_path / "model_0.pt"))
    told = ""
    try:
        other.learn(2)
    except CheckpointError as error:
        told = str(error)
    assert "malformed" in told or "does not fit" in caplog.text


@pytest.mark.parametrize("content", [b"hello, world", b"PK\x03\x04 no zip", b"\x80\x04."])
def test_a_file_that_is_no_checkpoint_is_called_so(tmp_path: Path, content):
    path = tmp_path / "model_0.pt"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="model_0.pt"):
        load_checkpoint(path)


class Hostile:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        return (os.system, (f"touch {self.target}",))


@pytest.mark.parametrize("writer", ["torch", "pickle 2", "pickle 4"])
def test_a_pickle_that_runs_code_is_refused_and_not_run(tmp_path: Path, writer):
    path, target = tmp_path / "model_0.pt", tmp_path / "was_here"
    payload = {"actor_state_dict": Hostile(target)}
    if writer == "torch":
        torch.save(payload, path)
    else:
        path.write_bytes(pickle.dumps(payload, protocol=int(writer[-1])))
    # torch does not read the current protocol, so the function called is unknown.
    reason = "not a file of torch" if writer == "pickle 4" else "got a call of '.*system'"
    with pytest.raises(CheckpointError, match=f"model_0.pt.*{reason}"):
        load_checkpoint(path)
    assert not target.exists()


def test_another_object_than_a_dict_is_refused(tmp_path: Path):
    torch.save([1, 2], tmp_path / "model_0.pt")
    with pytest.raises(CheckpointError, match="expected a dict, got a list"):
        load_checkpoint(tmp_path / "model_0.pt")


def test_another_network_is_an_error(make_runner, tmp_path: Path):
    from rl_fake_env import runner_cfg

    make_runner(tmp_path / "run").learn(1)
    actor = runner_cfg()["actor"] | {"hidden_dims": (9,)}
    other = make_runner(actor=actor)
    before = [parameter.clone() for parameter in other.alg.actor.parameters()]
    with pytest.raises(CheckpointError) as caught:
        other.load(str(tmp_path / "run" / "model_0.pt"))
    assert "its actor does not fit" in str(caught.value)
    assert "mlp.0.weight" in str(caught.value)
    assert "mlp.2.weight" in str(caught.value)
    assert "a checkpoint of this task" in str(caught.value)
    for one, kept in zip(other.alg.actor.parameters(), before, strict=True):
        assert torch.equal(one, kept)


def test_a_checkpoint_without_a_critic_or_optimizer_is_refused_by_name(make_runner, tmp_path):
    runner = make_runner()
    runner.save(str(tmp_path / "model_0.pt"))
    whole = load_checkpoint(tmp_path / "model_0.pt")
    for part in ("critic_state_dict", "optimizer_state_dict"):
        partial = {key: value for key, value in whole.items() if key != part}
        save_checkpoint(partial, tmp_path / "partial.pt")
        with pytest.raises(CheckpointError, match=part.split("_")[0]):
            runner.load(str(tmp_path / "partial.pt"))
        runner.load(str(tmp_path / "partial.pt"), load_cfg={"actor": True})


def test_a_checkpoint_of_rsl_rl_continues_at_the_next_iteration(make_runner, tmp_path: Path):
    runner = make_runner()
    infos = {"mine": 3, "env_state": {"common_step_counter": 17}}
    torch.save({**runner.alg.save(), "iter": 4, "infos": infos}, tmp_path / "model_4.pt")
    assert runner.load(str(tmp_path / "model_4.pt"))["mine"] == 3
    assert runner.current_learning_iteration == 5
    assert runner.env.unwrapped.common_step_counter == 17
    torch.save({**runner.alg.save(), "iter": 4, "infos": None}, tmp_path / "model_4.pt")
    assert runner.load(str(tmp_path / "model_4.pt")) == {}


def test_a_checkpoint_is_read_once(make_runner, tmp_path: Path):
    path = str(tmp_path / "model_0.pt")
    trained = make_runner()
    trained.learn(1)
    trained.save(path, infos={"note": "mine"})
    trained.learn(2)
    one, other = make_runner(), make_runner()
    content = load_checkpoint(path)
    os.remove(path)
    assert one.load_content(content, path)["note"] == "mine"
    assert other.load_content(content, path)["note"] == "mine"
    one.learn(2)
    other.learn(2)
    for actor in (one.alg.actor, other.alg.actor):
        for found, expected in zip(actor.parameters(), trained.alg.actor.parameters(), strict=True):
            assert torch.equal(found, expected)


def test_infos_come_back_with_the_step_counter(make_runner, tmp_path: Path):
    runner = make_runner()
    runner.env.unwrapped.common_step_counter = 5
    runner.save(str(tmp_path / "model_0.pt"), infos={"note": "mine"})
    other = make_runner()
    infos = other.load(str(tmp_path / "model_0.pt"))
    assert infos == {"note": "mine", "env_state": {"common_step_counter": 5}}
    assert other.env.unwrapped.common_step_counter == 5


def test_the_old_single_model_layout_is_split(make_runner, tmp_path: Path):
    runner = make_runner()
    today = runner.alg.save()
    old = {"critic_obs_normalizer.count": today["critic_state_dict"]["obs_normalizer.count"]}
    for part in ("actor", "critic"):
        for name, value in today[f"{part}_state_dict"].items():
            renamed = name.replace("mlp.", f"{part}.").replace(
                "obs_normalizer.", f"{part}_obs_normalizer."
            )
            old["std" if name == "distribution.std_param" else renamed] = value + 1
    old["unknown.weight"] = torch.zeros(1)
    file = {
        "model_state_dict": old,
        "optimizer_state_dict": today["optimizer_state_dict"],
        "iter": 9,
        "infos": None,
    }
    torch.save(file, tmp_path / "model_9.pt")
    runner.load(str(tmp_path / "model_9.pt"))
    for part in ("actor", "critic"):
        loaded = runner.alg.save()[f"{part}_state_dict"]
        for name, value in today[f"{part}_state_dict"].items():
            # `today` shares memory with the networks, so it shows what was loaded.
            assert torch.equal(loaded[name], value)
    assert (runner.alg.actor.distribution.std_param == 2.0).all()


@pytest.mark.parametrize(("old", "new"), [("std", "std_param"), ("log_std", "log_std_param")])
def test_the_old_names_of_the_standard_deviation_are_known(old, new):
    value = torch.ones(2)
    file = {"actor_state_dict": {"mlp.0.weight": value, old: value}, "iter": 1}
    migrated = migrate(file)
    assert set(migrated["actor_state_dict"]) == {"mlp.0.weight", f"distribution.{new}"}
    assert old in file["actor_state_dict"]


def draws() -> tuple:
    return (torch.rand(2).tolist(), np.random.rand(), np.random.randn(), random.gauss(0, 1))


def test_generators_go_on_from_a_saved_state(tmp_path: Path):
    # An odd number of Gaussian draws leaves half a pair waiting in NumPy and in Python.
    np.random.randn()
    random.gauss(0, 1)
    save_checkpoint(rng_state(), tmp_path / "rng.pt")
    expected = [draws(), draws()]
    set_rng_state(load_checkpoint(tmp_path / "rng.pt"))
    assert [draws(), draws()] == expected


def test_preserved_rng_puts_generators_back():
    state = rng_state()
    with preserved_rng():
        inside = draws()
    assert draws() == inside
    set_rng_state(state)


def test_an_unwritable_folder_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="file/run.*--log-root"):
        ensure_writable_folder(tmp_path / "file" / "run")
    assert list(ensure_writable_folder(tmp_path / "new" / "run").iterdir()) == []


def test_networks_read_terms_in_the_order_of_training():
    saved = {"actor": {"a.x": [1], "b.y": [2]}, "critic": {"a.x": [1]}, "actions": {"push": [1]}}
    check_terms(saved, saved, ("actor", "critic"), "p")
    check_terms(None, saved, ("actor",), "p")
    swapped = {**saved, "actor": {"b.y": [2], "a.x": [1]}}
    with pytest.raises(CheckpointError, match=r"actor: trained with a\.x \[1\], b\.y \[2\]"):
        check_terms(saved, swapped, ("actor",), "p")
    # Other networks are not loaded.
    check_terms(saved, swapped, ("critic",), "p")
    with pytest.raises(CheckpointError, match=r"actions: trained with push \[1\]; got push \[2\]"):
        check_terms(saved, {**saved, "actions": {"push": [2]}}, (), "p")
