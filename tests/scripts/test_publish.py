"""`mjlab publish`, and policies of folders, archives and the Hugging Face Hub in other commands."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from fake_hub import FakeHub

from mjlab.cli.record import VideoCfg
from mjlab.runs import Run
from mjlab.scripts import publish as publish_script

TASK = "Mjlab-Cartpole-Swingup"
SHORT = ("--num-episodes", "4", "--max-steps", "6", "--device", "cpu")
FILES = {"README.md", "evaluation.json", "manifest.json", "model_1.pt", "params/agent.yaml",
         "params/env.yaml", "policy.onnx", "run.json"}  # fmt: skip


@pytest.fixture(scope="module")
def evaluated(run, trained, tmp_path_factory) -> Path:
    """Folder of a run with an evaluation, and files that are not for others."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("jane") / trained.name)
    (folder / "replay.pt").write_bytes(b"replay")
    (folder / "git").mkdir(exist_ok=True)
    for path in (folder / "git").iterdir():
        path.unlink()
    (folder / "git" / "tasks.diff").write_text(
        "--- git commit ---\n0123abcd\n\n--- git diff ---\n+x"
    )
    info = Run(folder).info
    secret = {"env.scene.extent": 3.0, "env.commands.motion.motion_file": str(folder / "dance.npz")}
    info |= {"command": [str(folder)], "settings": secret, "resumed": "earlier/model_0.pt"}
    (folder / "run.json").write_text(json.dumps(info))
    outcome = run("evaluate", str(folder), *SHORT, "--output", str(folder / "evaluation.json"))
    assert outcome.status == 0, outcome.err
    return folder


def publish(run, source: Path, to: Path | str, *flags: str):
    """Publish without a clip."""
    return run("publish", str(source), "--to", str(to), "--clip", "False", *flags)


@pytest.fixture(scope="module")
def published(run, evaluated, tmp_path_factory) -> Path:
    """Folder of a published policy; not to be changed."""
    folder = tmp_path_factory.mktemp("published") / "swingup"
    outcome = publish(run, evaluated, folder)
    assert outcome.status == 0, outcome.err
    assert "env.commands.motion.motion_file" in outcome.err
    return folder


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """Server in place of the Hugging Face Hub."""
    server = FakeHub()
    for name, value in {
        "ENDPOINT": server.url,
        "HOME": str(tmp_path / "hf"),
        "TOKEN": "token",
    }.items():
        monkeypatch.setenv(f"HF_{name}", value)
    # The client reads these variables when it is imported.
    for name in [name for name in sys.modules if name.partition(".")[0] == "huggingface_hub"]:
        monkeypatch.delitem(sys.modules, name)
    yield server
    server.close()
    for name in [name for name in sys.modules if name.partition(".")[0] == "huggingface_hub"]:
        monkeypatch.delitem(sys.modules, name)


def files_in(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by name."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def card_of(folder: Path) -> tuple[dict, str]:
    """Return the metadata and the text of a card."""
    _, head, text = (folder / "README.md").read_text().split("---\n", 2)
    return yaml.safe_load(head), text


def scores(run, *policy: str) -> dict:
    """Return what `evaluate` measures, without the name of the policy and the time that it takes."""
    outcome = run("evaluate", *policy, *SHORT, "--json")
    assert outcome.status == 0, outcome.err
    found = json.loads(outcome.out)
    return {name: found[name] for name in found.keys() - {"policy", "settings", "duration"}}


def test_nothing_of_the_machine_is_published(evaluated, published):
    files = files_in(published)
    assert set(files) == FILES
    folders = [str(folder.parent) for folder in (evaluated, published)]
    private = [*folders, str(Path.home()), "jane", "resumed"]
    for name, content in files.items():
        assert not [text for text in private if text.encode() in content], name


def test_the_manifest_lists_all_files(published):
    manifest = json.loads((published / "manifest.json").read_text())
    assert manifest["files"].keys() == FILES - {"manifest.json"}
    assert (manifest["task"], manifest["seed"], manifest["commit"]) == (TASK, 7, "0123abcd")
    assert manifest["iteration"] == 2


def test_the_iteration_of_an_exported_policy_is_unknown(run, evaluated, published, tmp_path):
    source = shutil.copytree(published, tmp_path / "source")
    (source / "model_1.pt").unlink()
    assert publish(run, source, tmp_path / "policy").status == 0
    manifest = json.loads((tmp_path / "policy" / "manifest.json").read_text())
    assert manifest["iteration"] is None
    assert "iterations" not in card_of(tmp_path / "policy")[1]


def test_a_signal_leaves_nothing(run, evaluated, tmp_path, monkeypatch):
    def stop(*_) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(publish_script, "write_manifest", stop)
    assert publish(run, evaluated, tmp_path / "out" / "policy").status == 128 + signal.SIGTERM
    assert not list((tmp_path / "out").iterdir())


def test_commands_quote_names_with_spaces(run, published, tmp_path):
    outcome = publish(run, published, tmp_path / "my policy")
    line = outcome.out.splitlines()[-1]
    assert shlex.split(line) == ["uv", "run", "mjlab", "play", str(tmp_path / "my policy")]
    assert "uv run mjlab play 'my policy'\n" in card_of(tmp_path / "my policy")[1]


def test_checkpoints_are_published_without_episodes(evaluated, published):
    before, after = Run(evaluated).newest.content, Run(published).newest.content
    torch.testing.assert_close(
        after["actor_state_dict"], before["actor_state_dict"], rtol=0, atol=0
    )
    assert (
        after["optimizer_state_dict"]["state"].keys()
        == before["optimizer_state_dict"]["state"].keys()
    )
    assert "observations" in before["training_state"]
    assert "observations" not in after["training_state"]


def test_a_policy_is_the_same_from_every_source(run, evaluated, published, hub, tmp_path):
    archive = shutil.make_archive(str(tmp_path / "policy"), "zip", published.parent)
    hub.create("me/swingup", files_in(published))
    expected = scores(run, str(evaluated))
    for source in (str(published), archive, "hf:me/swingup"):
        assert scores(run, source) == expected
        assert scores(run, TASK, "--checkpoint-file", source) == expected
    # The client's folder is not written to.
    outcome = run(
        "play", "hf:me/swingup", "--viewer", "none", "--num-steps", "3", "--device", "cpu"
    )
    assert outcome.status == 0, outcome.err


@pytest.mark.parametrize("kind", ["folder", "export", "archive"])
def test_a_published_policy_is_deployed(run, published, tmp_path, kind):
    source = shutil.copytree(published, tmp_path / "policy")
    if kind == "export":
        (source / "model_1.pt").unlink()
    if kind == "archive":
        source = shutil.make_archive(str(tmp_path / "policy"), "zip", source)
    outcome = run("deploy", str(source), "--output", str(tmp_path / "bundle"), "--steps", "4")
    assert outcome.status == 0, outcome.err
    contract = json.loads((tmp_path / "bundle" / "contract.json").read_text())
    assert contract["source"]["task"] == TASK
    assert contract["source"]["commit"] == "0123abcd"
    assert np.isfinite(np.load(tmp_path / "bundle" / "golden.npz")["action"]).all()


def test_a_run_resumes_from_a_published_policy(run, published, tmp_path):
    flags = ("--log-root", str(tmp_path), "--device", "cpu", "--agent.max-iterations", "3")
    experiment = tmp_path / "cartpole"
    shutil.copytree(published, experiment / "2026-01-01_00-00-00")
    outcome = run("train", TASK, *flags, "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    assert Run(max(experiment.iterdir())).newest.number == 2


def test_the_card_states_what_was_measured(evaluated, published):
    measured = json.loads((evaluated / "evaluation.json").read_text())
    head, text = card_of(published)
    assert head["library_name"] == "mjlab"
    assert TASK in head["tags"]
    assert "license" not in head
    (result,) = head["model-index"][0]["results"]
    values = {one["type"]: one["value"] for one in result["metrics"]}
    assert values["mean_reward"] == measured["mean_return"]
    low, high = measured["return_interval"]
    assert f"{low:,.4g} to {high:,.4g}" in text
    # 4 episodes of 6 steps.
    assert all(note in text for note in measured["notes"])
    assert "0123abcd`, with uncommitted changes" in text


def test_the_card_is_a_model_card(evaluated, published):
    from huggingface_hub import ModelCard

    measured = json.loads((evaluated / "evaluation.json").read_text())
    results = ModelCard.load(published / "README.md").data.eval_results
    assert results[0].metric_value == measured["mean_return"]
    assert {result.dataset_name for result in results} == {TASK}


@pytest.mark.parametrize("change", ["none", "checkpoint", "task"])
def test_the_card_claims_nothing_else(run, evaluated, tmp_path, change):
    source = shutil.copytree(evaluated, tmp_path / "run")
    path = source / "evaluation.json"
    if change == "none":
        path.unlink()
    else:
        other = {"checkpoint": {"policy": "model_0.pt"}, "task": {"task": "Other"}}[change]
        path.write_text(json.dumps(json.loads(path.read_text()) | other))
    outcome = publish(run, source, tmp_path / "out", "--license", "apache-2.0")
    assert outcome.status == 0, outcome.err
    assert "evaluate" in outcome.err
    head, text = card_of(tmp_path / "out")
    assert "model-index" not in head
    assert head["license"] == "apache-2.0"
    assert "Not evaluated" in text
    assert not (tmp_path / "out" / "evaluation.json").exists()


def test_files_of_the_user_are_not_overwritten(run, evaluated, published, tmp_path):
    folder = tmp_path / "policy"
    folder.mkdir()
    (folder / "README.md").write_text("mine")
    (folder / ".git").mkdir()
    outcome = publish(run, evaluated, folder)
    assert outcome.status == 1
    assert "--overwrite" in outcome.message
    assert files_in(folder) == {"README.md": b"mine"}
    # Nothing else is left beside it.
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]


def test_the_earlier_publication_is_replaced_on_request(run, evaluated, published, tmp_path):
    folder = shutil.copytree(published, tmp_path / "policy")
    (folder / "notes.txt").write_text("mine")
    outcome = publish(run, evaluated / "model_0.pt", folder, "--overwrite")
    assert outcome.status == 0, outcome.err
    # The evaluation is of the last checkpoint.
    expected = FILES - {"model_1.pt", "evaluation.json"} | {"model_0.pt", "notes.txt"}
    assert files_in(folder).keys() == expected
    assert Run(folder).newest.number == 0


@pytest.mark.parametrize("to", ["run", "file", None])
def test_destinations_that_are_rejected(run, evaluated, tmp_path, to):
    before = files_in(evaluated)
    (tmp_path / "file").write_text("mine")
    places = {"run": str(evaluated), "file": str(tmp_path / "file")}
    flags = () if to is None else ("--to", places[to], "--overwrite")
    outcome = run("publish", str(evaluated), *flags)
    assert outcome.status == 1
    assert "--to" in outcome.message
    assert files_in(evaluated) == before


def test_policies_are_published_to_the_hub(run, evaluated, hub):
    outcome = publish(run, evaluated, "hf:me/swingup", "--private")
    assert outcome.status == 0, outcome.err
    assert hub.files("me/swingup").keys() == FILES
    assert hub.private == {"me/swingup"}
    assert b"uv run mjlab play hf:me/swingup\n" in hub.files("me/swingup")["README.md"]
    first = hub.repositories["me/swingup"]["main"]
    again = publish(run, evaluated / "model_0.pt", "hf:me/swingup")
    assert again.status == 1
    assert "--overwrite" in again.message
    assert publish(run, evaluated / "model_0.pt", "hf:me/swingup", "--overwrite").status == 0
    assert "model_1.pt" not in hub.files("me/swingup")
    newest, oldest = scores(run, "hf:me/swingup"), scores(run, f"hf:me/swingup@{first}")
    assert oldest == scores(run, str(evaluated))
    assert newest["mean_return"] != oldest["mean_return"]
    assert "README.md" in hub.downloads


def test_branches_are_published(run, evaluated, hub):
    hub.create("me/swingup", {".gitattributes": b""})
    outcome = publish(run, evaluated, "hf:me/swingup@v2")
    assert outcome.status == 0, outcome.err
    assert hub.files("me/swingup", "v2").keys() == {*FILES, ".gitattributes"}
    assert hub.files("me/swingup").keys() == {".gitattributes"}


def test_publishing_needs_a_login_first(run, evaluated, hub, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    outcome = publish(run, evaluated, "hf:me/swingup")
    assert outcome.status == 1
    assert "HF_TOKEN" in outcome.message
    assert not hub.repositories


@pytest.mark.parametrize(
    ("policy", "named"),
    [("hf:me/missing", "hf:me/missing"), ("hf:me/swingup@missing", "hf:me/swingup@missing"),
     ("hf:me/swingup", "my_robots 1.2"), ("missing.zip", "ZIP archive"), ("runs/missing", "a run folder")],
)  # fmt: skip
def test_policies_that_cannot_be_played(run, hub, policy, named):
    info = {"task": "My-Task", "package": "my_robots 1.2"}
    hub.create("me/swingup", {"run.json": json.dumps(info).encode(), "policy.onnx": b""})
    outcome = run("play", policy, "--viewer", "none", "--num-steps", "1")
    assert outcome.status == 1
    assert named in outcome.message


def test_the_clip_is_published(run, evaluated, tmp_path, monkeypatch, gl):
    # Rendering 200 frames takes long where OpenGL is software.
    monkeypatch.setattr(publish_script, "_CLIP", VideoCfg(length=2, width=64, height=32))
    outcome = run("publish", str(evaluated), "--to", str(tmp_path / "policy"), "--device", "cpu")
    assert outcome.status == 0, outcome.err
    assert (tmp_path / "policy" / "replay.mp4").stat().st_size > 100
    assert "(replay.mp4)" in card_of(tmp_path / "policy")[1]
