"""`train --live`: a view whose process builds while training does."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import viser
import zstandard
from commands import SMALL, TASK
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from mjlab.cli import live
from mjlab.cli.live import live_view
from mjlab.cli.live_view import Exchange, LiveJob, NewestWeights
from mjlab.rl.checkpoint import load_checkpoint
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.evaluation import EvaluationResult
from mjlab.rl.progress import ProgressCfg, TrainingProgress
from mjlab.rl.run_logger import IterationStats
from mjlab.scripts.train import TrainConfig

STATS = IterationStats(
    iteration=3, total_iterations=9, total_steps=96, collection_time=1.0, learning_time=1.0,
    steps_per_second=5.0, time_left=7.0, mean_reward=None, mean_episode_length=None,
    mean_step_reward=0.1, learning_rate=1e-3, action_std=1.0,
)  # fmt: skip


class FakeRunner:
    """A runner with a network, in environments that have made 40 steps."""

    def __init__(self) -> None:
        self.network = torch.nn.Linear(2, 1)
        self.alg = SimpleNamespace(get_policy=lambda: self.network)
        self.env = SimpleNamespace(unwrapped=SimpleNamespace(common_step_counter=40))
        self.observers = []


def process(code: str):
    """Return what starts a process of Python code instead of the view."""

    def start(exchange: Exchange, host: str, port: int) -> subprocess.Popen:
        exchange.url.write_text("http://localhost:1", encoding="utf-8")
        exchange.ready.touch()
        with open(exchange.log, "wb") as log:
            command = [sys.executable, "-c", code, str(exchange.folder)]
            return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log)

    return start


def progress(**evaluation: float) -> TrainingProgress:
    """Return the progress of a run of nine iterations."""
    progress = TrainingProgress(ProgressCfg(evaluation=EvaluationCfg(**evaluation)))
    progress.on_start(0, 9)
    return progress


def evaluated(mean_return: float) -> EvaluationResult:
    """Return the result of an evaluation in four episodes."""
    return EvaluationResult(
        num_episodes=4, mean_return=mean_return, return_interval=None, std_return=None,
        min_return=mean_return, max_return=mean_return, mean_length=10.0,
    )  # fmt: skip


@pytest.fixture
def view(monkeypatch):
    """A view that follows a run; its process only waits for its end."""
    monkeypatch.setattr(live, "_start", process("import sys; sys.stdin.read()"))
    with live_view(TASK, TrainConfig.from_task(TASK)) as view:
        view.follow(FakeRunner(), progress())
        yield view


def test_live_keeps_the_weights_bit_for_bit(run, trained, train, tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(
        live, "_start", lambda *args, f=live._start: started.append(f(*args)) or started[0]
    )
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "2"]
    outcome = run("train", *argv, "--live", "--live-port", "18311")
    assert outcome.status == 0, outcome.err
    assert "Live:    http://localhost:18" in outcome.out
    assert outcome.out.index("Live:") < outcome.out.index("Task:") < outcome.out.index("[1/2]")
    (process,) = started
    assert process.poll() is not None
    assert not Path(process.args[3]).exists()
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    one, other = (load_checkpoint(d / "model_1.pt")["actor_state_dict"] for d in (trained, run_dir))
    assert all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.slow
def test_page_is_filled_before_training(capsys, monkeypatch):
    monkeypatch.setattr(live, "_SECONDS_TO_START", 100.0)
    cfg = TrainConfig.from_task(TASK)
    cfg.live_port = 18351
    with live_view(TASK, cfg) as view:
        address = capsys.readouterr().out.split()[1].replace("http", "ws")
        version = Subprotocol(f"viser-v{viser.__version__}")
        view.follow(FakeRunner(), progress())
        with connect(address, subprotocols=[version], max_size=None) as page:
            messages = decoded(page.recv(timeout=5.0))
    assert b"/bodies/cartpole/pole" in messages
    assert b"Training" in messages


def decoded(message: bytes) -> bytes:
    """Return the text of a message of viser, after its two sizes."""
    size = int.from_bytes(message[8:16], "little")
    return zstandard.ZstdDecompressor().decompress(message[16 : 16 + size])


def test_crash_of_the_page_is_one_warning(monkeypatch, caplog):
    monkeypatch.setattr(live, "_start", process("import sys; sys.exit('no such screen')"))
    with (
        caplog.at_level(logging.WARNING),
        live_view(TASK, TrainConfig.from_task(TASK)) as view,
    ):
        view.follow(FakeRunner(), progress())
        view._process.wait()
        view.on_start(0, 9)
        for _ in range(3):
            view.on_iteration(STATS)
    assert caplog.text.count("process ended; training continues. no such screen") == 1


def test_curve_has_the_numbers_of_the_terminal(view):
    terminal = progress(solved_return=900.0, trigger_fraction=0.8)
    view.follow(FakeRunner(), terminal)
    newest = NewestWeights(view._exchange, view._runner.network, view._runner.env.unwrapped)
    for iteration in (1, 2, 3):
        stats = replace(STATS, iteration=iteration, exploring_return=100.0 * iteration)
        for observer in (terminal, view):
            observer.on_iteration(stats)
    for observer in (terminal, view):
        observer.on_evaluation(3, evaluated(310.0), False)
    shown = newest.take()
    assert shown["curve"] == {1: 100.0, 2: 200.0, 3: 300.0}
    assert (shown["unit"], shown["evaluations"], shown["goal"]) == ("return", {3: 310.0}, 900.0)
    assert (shown["iteration"], shown["total_iterations"]) == (3, 9)
    assert shown["rows"] == terminal.rows()
    assert "310 of 900" in dict(shown["rows"])["last eval"]


HOLD = """
import sys, time
from pathlib import Path
from mjlab.utils.os import create_locked
folder = Path(sys.argv[1])
folder.mkdir()
lock = create_locked(folder / "lock")
print("held", flush=True)
time.sleep(60)
"""


def test_folder_of_a_killed_training_is_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(live.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(live, "_start", process("import sys; sys.stdin.read()"))
    folder = tmp_path / "mjlab-live-abc"
    # Files that another user could create there.
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "lock").touch()
    (tmp_path / "mjlab-live-planted").symlink_to(tmp_path / "elsewhere")
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE)
    try:
        assert holder.stdout is not None
        holder.stdout.readline()
        with live_view(TASK, TrainConfig.from_task(TASK)):
            assert folder.exists()
    finally:
        holder.kill()
        holder.communicate()
    with live_view(TASK, TrainConfig.from_task(TASK)):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "mjlab-live-planted"]
    assert (tmp_path / "elsewhere" / "lock").exists()


def test_view_has_the_config_of_the_run_made_small():
    cfg = TrainConfig.from_task(TASK)
    cfg.env.scene.num_envs = 4096
    cfg.env.sim.engine = "warp"
    cfg.env.rewards["user"] = None
    cfg.env.recorders["tape"] = None
    env = live._view_env_cfg(cfg)
    assert (env.scene.num_envs, env.sim.engine, env.sim.num_threads) == (4, "native", 1)
    assert (env.rewards, env.recorders) == (cfg.env.rewards, {})
    assert (cfg.env.scene.num_envs, cfg.env.sim.engine) == (4096, "warp")
    # Other modules than those that can be imported elsewhere, and lambdas, go over too.
    cfg.env.rewards["user"] = lambda: 5
    job = pickle.loads(live._pickled_job(TASK, cfg))
    assert (job.task, job.env.rewards["user"]()) == (TASK, 5)


def test_unknown_ports_are_errors(run):
    outcome = run("train", TASK, *SMALL, "--live", "--live-port", "70000")
    assert outcome.status == 1
    assert "--live-port" in outcome.message
    assert "70000" in outcome.message


def test_page_shows_the_policy_of_the_job(tmp_path, monkeypatch):
    from mjlab.cli.live_view import make_viewer
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper

    cfg = TrainConfig.from_task(TASK)
    cfg.env.scene.num_envs = 2
    shown = {"iteration": 3, "total_iterations": 9, "rows": [("return", "5, exploring")], "unit": "return",
             "curve": {2: 4.0, 3: 5.0}, "evaluations": {}, "goal": 6.0, "time": time.time()}  # fmt: skip
    exchange = Exchange(tmp_path)
    server = viser.ViserServer(host="127.0.0.1", port=18321, verbose=False)
    monkeypatch.setattr(server, "get_clients", lambda: {0: SimpleNamespace()})
    try:
        job = LiveJob(TASK, live._view_env_cfg(cfg), cfg.agent, MjlabOnPolicyRunner)
        viewer = make_viewer(job, exchange, server, exchange.ready.touch)
        assert isinstance(viewer.env, RslRlVecEnvWrapper)
        network = viewer._take_progress.__self__._network
        other = {key: torch.randn_like(value) for key, value in network.state_dict().items()
                 if value.is_floating_point()}  # fmt: skip
        exchange.write_weights(
            SimpleNamespace(state_dict=lambda: {**network.state_dict(), **other}), 5, shown
        )
        viewer.run(num_steps=3)
        assert exchange.ready.exists()
        assert torch.equal(network.state_dict()["mlp.0.weight"], other["mlp.0.weight"])
        assert viewer._progress["iteration"] == 3
    finally:
        viewer.env.close()
        server.stop()
