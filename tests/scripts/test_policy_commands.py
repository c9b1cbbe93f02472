"""`play` and `evaluate`: which policy, for how long, and what is printed."""

from __future__ import annotations

import json
import shutil
from types import SimpleNamespace

import onnx
import pytest
from commands import SMALL

from mjlab.cli.flags import parse_flags
from mjlab.runs.evaluation import read_evaluation
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.play import PlayConfig

TASK = "Mjlab-Cartpole-Swingup"
HEADLESS = ("--viewer", "none", "--num-steps", "5", "--num-envs", "3", "--device", "cpu")
SHORT = ("--num-episodes", "4", "--max-steps", "6", "--device", "cpu")


@pytest.mark.parametrize("agent", ["zero", "random"])
def test_an_agent_that_does_not_look_plays_without_a_checkpoint(run, agent):
    outcome = run("play", TASK, "--agent", agent, *HEADLESS)
    assert outcome.status == 0, outcome.err
    assert "5 steps in 3 environments" in outcome.out


def test_the_newest_policy_is_played_unless_one_is_named(run, trained):
    log_root = str(trained.parents[1])
    outcome = run("play", TASK, *HEADLESS, "--log-root", log_root)
    assert outcome.status == 0, outcome.err
    assert str(trained / "model_1.pt") in outcome.err
    outcome = run("play", TASK, *HEADLESS, "--checkpoint-file", str(trained / "model_0.pt"))
    assert outcome.status == 0, outcome.err


def test_the_tutorials_path_finds_the_newest_run(run, trained):
    # The run was finished with model_1, as a solved one would be before model_500.
    named = trained.parent / "model_500.pt"
    outcome = run("play", TASK, *HEADLESS, "--checkpoint-file", str(named))
    assert outcome.status == 0, outcome.err
    assert str(trained / "model_1.pt") in outcome.err


def test_a_policy_of_weights_and_biases_is_played(run, trained, monkeypatch):
    asked = []

    def fetch(experiment, run_path, name):
        asked.append((str(run_path), name))
        return trained / "model_1.pt", True

    monkeypatch.setattr("mjlab.cli.policy_flags.get_wandb_checkpoint_path", fetch)
    outcome = run("play", TASK, *HEADLESS, "--wandb-run-path", "me/project/abc")
    assert outcome.status == 0, outcome.err
    assert asked == [("me/project/abc", None)]


@pytest.mark.parametrize("script", ["play", "evaluate", "train"])
def test_weights_and_biases_without_a_login_is_one_error(run, tmp_path, monkeypatch, script):
    log_out(monkeypatch, tmp_path)
    flags = ["--agent.resume", "True"] if script == "train" else []
    root = ("--log-root", str(tmp_path), "--device", "cpu")
    outcome = run(script, TASK, *root, "--wandb-run-path", "me/project/abc", *flags)
    assert outcome.status == 1
    assert "'me/project/abc': expected a login" in outcome.message
    assert "run `wandb login` or set WANDB_API_KEY" in outcome.message


def test_uploads_need_a_login_first(run, tmp_path, monkeypatch):
    log_out(monkeypatch, tmp_path)
    outcome = run("train", TASK, "--log-root", str(tmp_path / "logs"), "--agent.logger", "wandb")
    assert outcome.status == 1
    assert "--agent.logger wandb: expected a login" in outcome.message
    assert "WANDB_MODE=offline" in outcome.message
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("flags", "shown"),
    [((), ["page", "browser"]), (("--open-browser", "False"), ["page"]),
     (("--viewer", "native"), ["window"])],
)  # fmt: skip
def test_play_shows_the_page_also_with_a_display(run, monkeypatch, flags, shown):
    seen = []

    def viewer(kind):
        def make(*args, **kwargs):
            seen.append(kind)
            return SimpleNamespace(url="http://localhost:8080", run=lambda num_steps: None)

        return make

    monkeypatch.setenv("DISPLAY", ":1")
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    monkeypatch.setattr("webbrowser.open", lambda url: seen.append("browser"))
    monkeypatch.setattr("mjlab.viewer.ViserPlayViewer", viewer("page"))
    monkeypatch.setattr("mjlab.viewer.NativeMujocoViewer", viewer("window"))
    outcome = run("play", TASK, "--agent", "zero", "--num-envs", "1", "--device", "cpu", *flags)
    assert outcome.status == 0, outcome.err
    assert seen == shown
    assert ("http://localhost:8080" in outcome.out) == ("page" in shown)


def log_out(monkeypatch, folder) -> None:
    """Hide credentials of Weights & Biases, and pretend to be at a terminal, where it would prompt."""
    for variable in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE", "WANDB_MODE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("NETRC", str(folder / "netrc"))
    monkeypatch.setenv("WANDB_CONFIG_DIR", str(folder))
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("prompted"))
    monkeypatch.setattr("getpass.getpass", lambda *_: pytest.fail("prompted"))


@pytest.mark.slow
def test_a_policy_with_networks_from_the_command_line_is_played(run, train, tmp_path):
    run_dir = train(tmp_path, 1, "--agent.actor.hidden-dims", "(8,)")
    outcome = run("play", TASK, *HEADLESS, "--checkpoint-file", str(run_dir / "model_0.pt"))
    assert outcome.status == 0, outcome.err


def test_without_terminations_no_episode_ends(run, monkeypatch):
    from mjlab.tasks.cartpole import cartpole_env_cfg

    make = cartpole_env_cfg.cartpole_balance_env_cfg

    def short(play):
        cfg = make(play)
        cfg.episode_length_s = 0.1
        return cfg

    monkeypatch.setattr(cartpole_env_cfg, "cartpole_balance_env_cfg", short)
    ended = run("play", TASK, "--agent", "zero", *HEADLESS).out
    endless = run("play", TASK, "--agent", "zero", *HEADLESS, "--no-terminations").out
    assert "6 episodes ended" in ended
    assert "0 episodes ended" in endless


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--viewer", "none"), "--num-steps"),
        (("--viewer", "none", "--num-steps", "0"), "--num-steps: expected an integer >= 1, got 0"),
        ((*HEADLESS, "--num-envs", "0"), "--num-envs: expected an integer >= 1, got 0"),
        ((*HEADLESS, "--device", "gpu"), "'gpu'"),
    ],
)
def test_what_cannot_be_played_is_refused(run, flags, named):
    outcome = run("play", TASK, "--agent", "zero", *flags)
    assert outcome.status == 1
    assert named in outcome.message


@pytest.mark.parametrize("script", ["play", "evaluate"])
def test_without_any_checkpoint_the_message_says_what_to_do(run, script, tmp_path):
    outcome = run(script, TASK, "--log-root", str(tmp_path), "--device", "cpu")
    assert outcome.status == 1
    for part in (str(tmp_path / "cartpole"), f"`uv run mjlab train {TASK}`", "--checkpoint-file"):
        assert part in outcome.message


def test_a_clip_is_recorded_beside_the_checkpoint(run, trained, tmp_path, gl):
    run_dir = shutil.copytree(trained, tmp_path / "run")
    outcome = run(
        "play", TASK, "--video", "--viewer", "none", "--num-steps", "3", "--device", "cpu",
        "--video-height", "48", "--video-width", "64",
        "--checkpoint-file", str(run_dir / "model_1.pt"),
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    (clip,) = (run_dir / "videos" / "play").glob("*.mp4")
    assert clip.stat().st_size > 0
    assert f"Video: {clip}" in outcome.out


def test_evaluation_prints_figures_for_machines_and_nothing_else(run, trained):
    outcome = run("evaluate", TASK, *SHORT, "--json", "--log-root", str(trained.parents[1]))
    assert outcome.status == 0, outcome.err
    figures = json.loads(outcome.out)
    assert figures["task"] == TASK
    assert figures["policy"] == str(trained / "model_1.pt")
    assert figures["num_episodes"] == 4
    low, high = figures["return_interval"]
    assert low <= figures["mean_return"] <= high
    assert figures["success_rate"] == 0.0


def test_evaluation_is_written_for_pages(run, trained, tmp_path):
    path = tmp_path / "new" / "evaluation.json"
    flags = ("--json", "--log-root", str(trained.parents[1]), "--output", str(path))
    outcome = run("evaluate", TASK, *SHORT, *flags)
    assert outcome.status == 0, outcome.err
    found = read_evaluation(path, TASK, trained / "model_1.pt")
    assert found == json.loads(outcome.out)


@pytest.mark.parametrize(
    ("flags", "num_envs"),
    [
        ((), 4),
        (("--env.scene.num-envs", "3"), 3),
    ],
)
def test_episodes_are_played_in_as_many_environments_as_asked_for(run, flags, num_envs):
    outcome = run("evaluate", TASK, *SHORT, "--agent", "zero", "--json", *flags)
    assert outcome.status == 0, outcome.err
    figures = json.loads(outcome.out)
    assert (figures["num_envs"], figures["num_episodes"]) == (num_envs, 4)


@pytest.mark.parametrize(
    ("flags", "at_once"),
    [
        ((), 4),
        (("--num-envs", "2"), 2),
    ],
)
def test_num_envs_are_episodes_at_once(run, flags, at_once):
    outcome = run("evaluate", TASK, "--agent", "zero", *SHORT, "--json", *flags)
    assert outcome.status == 0, outcome.err
    metrics = json.loads(outcome.out)
    assert (metrics["num_episodes"], metrics["num_envs"]) == (4, at_once)


def test_evaluation_prints_a_table_for_people(run, trained):
    outcome = run("evaluate", TASK, *SHORT, "--log-root", str(trained.parents[1]))
    assert outcome.status == 0, outcome.err
    for part in ("4 in 4 environments", "Mean return", "95 % interval", "Success      0.0%",
                 "at least 900", "native", "Note         4 of 4 episodes were truncated", "rare failures"):  # fmt: skip
        assert part in outcome.out
    # The swing-up ends by its time limit only.
    assert "no termination but time limits" in outcome.out
    assert "time_out" not in outcome.out


def test_one_episode_is_shown_without_an_interval(run):
    outcome = run("evaluate", TASK, "--agent", "zero", "--num-episodes", "1", *SHORT[2:])
    assert outcome.status == 0, outcome.err
    (line,) = (line for line in outcome.out.splitlines() if line.startswith("Mean return"))
    assert "no interval" in line
    assert "1 in 1 environment, " in outcome.out


def test_episodes_that_are_cut_off_succeed_by_no_definition(run, with_images):
    argv = ("--num-episodes", "64", "--device", "cpu", "--agent", "random", "--json")
    cut = json.loads(run("evaluate", with_images, *argv, "--max-steps", "6").out)
    assert (cut["success_rate"], cut["num_unfinished"]) == (0.0, 64)
    assert "64 of 64" in cut["notes"][0]


def leans_right(env):
    """Return whether the cart stands right of the middle, (num_envs,) bool."""
    return env.sim.data.qpos[:, 0] > 0.0


def test_success_that_the_task_defines_is_told_with_its_definition(run, with_images):
    argv = ("--num-episodes", "64", "--device", "cpu", "--agent", "random")
    argv += ("--env.episode-length-s", "0.12")
    figures = json.loads(run("evaluate", with_images, *argv, "--json").out)
    low, high = figures["success_interval"]
    assert low < figures["success_rate"] < high
    definition = "leans_right, one step before the end"
    assert figures["success_definition"] == definition
    table = run("evaluate", with_images, *argv).out
    assert f"Success      {figures['success_rate']:.1%}" in table
    assert f"({definition})" in table


def pixels(env):
    return env.sim.data.qpos[:, :1, None, None].expand(-1, 2, 8, 8).clone()


@pytest.fixture(scope="module")
def with_images():
    """A task whose policy sees images of 2 x 8 x 8, and which says what success is."""
    from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
    from mjlab.tasks import registry

    def env_cfg(play: bool = False):
        cfg = registry.load_env_cfg(TASK, play=play)
        term = ObservationTermCfg(func=pixels)
        cfg.observations["camera"] = ObservationGroupCfg(terms={"pixels": term})
        return cfg

    def rl_cfg():
        cfg = registry.load_rl_cfg(TASK)
        cfg.experiment_name = "with_images"
        cfg.obs_groups = {"actor": ("actor", "camera"), "critic": ("critic", "camera")}
        for model in (cfg.actor, cfg.critic):
            model.class_name = "mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel"
            model.cnn_cfg = {"output_channels": [4], "kernel_size": [3], "padding": "zeros"}
        cfg.evaluation.success = f"{__name__}:leans_right"
        return cfg

    registry.register_mjlab_task("Test-With-Images", env_cfg, rl_cfg=rl_cfg)
    yield "Test-With-Images"
    del registry._tasks["Test-With-Images"]


@pytest.mark.slow
def test_a_policy_that_sees_images_trains_plays_and_is_scored(run, with_images, tmp_path):
    logs = ("--log-root", str(tmp_path))
    outcome = run("train", with_images, *SMALL, *logs, "--agent.max-iterations", "1")
    assert outcome.status == 0, outcome.err
    (run_dir,) = (tmp_path / "with_images").iterdir()
    scores = []
    for name in ("model_0.pt", f"{run_dir.name}.onnx"):
        given = ("--checkpoint-file", str(run_dir / name))
        scored = run("evaluate", with_images, *SHORT, *given, "--json")
        assert scored.status == 0, scored.err
        scores.append(json.loads(scored.out)["mean_return"])
        played = run("play", with_images, *HEADLESS, *given)
        assert played.status == 0, played.err
    assert scores[0] == pytest.approx(scores[1], rel=1e-4)
    wrong = run(
        "train", with_images, *SMALL, *logs, "--agent.actor.class-name", "MLPModel",
        "--agent.run-name", "wrong",
    )  # fmt: skip
    assert wrong.status == 1
    assert "MLPModel" in wrong.message


def _truncate(model) -> bytes:
    return model.SerializeToString()[:-500]


def _shorten_a_bias(model) -> bytes:
    bias = next(item for item in model.graph.initializer if len(item.dims) == 1)
    bias.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(bias)[:-1], bias.name))
    return model.SerializeToString()


@pytest.mark.parametrize(
    "script",
    [
        pytest.param("play", marks=pytest.mark.slow),
        "evaluate",
    ],
)
@pytest.mark.parametrize(
    "spoil",
    [
        _truncate,
        _shorten_a_bias,
    ],
)
def test_a_spoilt_onnx_file_is_one_message(run, trained, tmp_path, script, spoil):
    path = tmp_path / "policy.onnx"
    path.write_bytes(spoil(onnx.load(next(trained.glob("*.onnx")))))
    flags = HEADLESS if script == "play" else SHORT
    outcome = run(script, TASK, *flags, "--checkpoint-file", str(path))
    assert outcome.status == 1
    assert str(path) in outcome.message
    assert "Traceback" not in outcome.err


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures_and_another_does_not(run):
    def figures(seed: int) -> float:
        argv = ("--agent", "random", "--json", "--seed", str(seed))
        return json.loads(run("evaluate", TASK, *SHORT, *argv).out)["mean_return"]

    assert figures(1) == figures(1)
    assert figures(1) != figures(2)


def test_no_episodes_are_refused(run):
    outcome = run("evaluate", TASK, "--agent", "zero", "--num-episodes", "0")
    assert outcome.status == 1
    assert "--num-episodes: expected an integer >= 1, got 0" in outcome.message


@pytest.mark.parametrize(
    ("config_type", "flags", "field", "value"),
    [
        (PlayConfig, ["--num-envs", "4"], "num_envs", 4),
        (PlayConfig, ["--checkpoint-file", "a/model_500.pt"], "checkpoint_file", "a/model_500.pt"),
        (PlayConfig, ["--wandb-run-path", "a/b/c"], "wandb_run_path", "a/b/c"),
        (PlayConfig, ["--engine", "warp"], "engine", "warp"),
        (PlayConfig, ["--viewer", "viser"], "viewer", "viser"),
        (PlayConfig, ["--camera", "1"], "camera", 1),
        (PlayConfig, ["--camera", "cartpole/side"], "camera", "cartpole/side"),
        (PlayConfig, ["--video"], "video", True),
        (EvaluateConfig, ["--json"], "json", True),
        (EvaluateConfig, ["--device", "cuda:1"], "device", "cuda:1"),
    ],
)
def test_flags_reach_their_fields(config_type, flags, field, value):
    assert getattr(parse_flags(config_type, config_type(), flags, "x"), field) == value


def test_the_page_is_served_to_this_machine_only_unless_told_otherwise():
    assert PlayConfig().host == "127.0.0.1"


@pytest.mark.parametrize("command", [("play", *HEADLESS), ("evaluate", *SHORT)])
def test_agents_ignore_a_checkpoint(run, command):
    argv = (*command, "--agent", "random", "--checkpoint-file", "model_1.pt")
    outcome = run(argv[0], TASK, *argv[1:])
    assert outcome.status == 0, outcome.err
    assert outcome.err.count("--checkpoint-file is ignored with --agent random") == 1
