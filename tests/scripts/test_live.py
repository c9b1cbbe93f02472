"""`train --live`: a view that training does not wait for."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from commands import SMALL, TASK

from mjlab.rl.checkpoint import load_checkpoint
from mjlab.rl.run_logger import IterationStats
from mjlab.scripts import live
from mjlab.scripts.live import LiveView
from mjlab.scripts.live_view import Exchange, LiveJob, NewestWeights
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


def start(code: str):
    """Return what starts a process of Python code instead of the view."""

    def start(exchange: Exchange, host: str, port: int) -> subprocess.Popen:
        with open(exchange.log, "wb") as log:
            command = [sys.executable, "-c", code, str(exchange.folder)]
            return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log)

    return start


@pytest.fixture
def view(monkeypatch):
    """A view whose process only waits for its end."""
    monkeypatch.setattr(live, "_start", start("import sys; sys.stdin.read()"))
    view = LiveView(TASK, TrainConfig.from_task(TASK), FakeRunner())
    yield view
    view.on_end("finished")


def test_training_with_it_gives_the_same_weights_bit_for_bit_and_leaves_nothing(
    run, trained, train, tmp_path, monkeypatch
):
    started = []
    monkeypatch.setattr(
        live, "_start", lambda *args, f=live._start: started.append(f(*args)) or started[0]
    )
    argv = [TASK, *SMALL, "--log-root", str(tmp_path), "--agent.max-iterations", "2"]
    outcome = run("train", *argv, "--live", "--live-port", "18311")
    assert outcome.status == 0, outcome.err
    assert "Live:    http://localhost:18" in outcome.out
    assert outcome.out.index("Live:") < outcome.out.index("[1/2]")
    (process,) = started
    assert process.poll() is not None
    assert not Path(process.args[3]).exists()
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    one, other = (load_checkpoint(d / "model_1.pt")["actor_state_dict"] for d in (trained, run_dir))
    assert all(torch.equal(one[key], other[key]) for key in one)


def test_a_view_that_crashes_is_told_once_and_training_goes_on(monkeypatch, caplog):
    monkeypatch.setattr(live, "_start", start("import sys; sys.exit('no such screen')"))
    view = LiveView(TASK, TrainConfig.from_task(TASK), FakeRunner())
    with caplog.at_level(logging.WARNING):
        view.on_start(0, 9)
        for _ in range(3):
            view.on_iteration(STATS)
        view.on_end("finished")
    assert caplog.text.count("process ended; training continues. no such screen") == 1


def test_weights_are_handed_over_only_while_someone_watches_and_not_too_often(view):
    weights = view._exchange.weights
    view.on_iteration(STATS)
    assert not weights.exists()
    view._exchange.watched.touch()
    view.on_iteration(STATS)
    written = weights.stat().st_mtime_ns
    view.on_iteration(STATS)
    assert weights.stat().st_mtime_ns == written
    # Whatever one time costs, it is for at most 1 % of the time.
    assert view._next_weights - time.perf_counter() > 0.9
    slow = view._exchange.write_weights
    view._next_weights = 0.0
    view._exchange.write_weights = lambda *args: (time.sleep(0.05), slow(*args))
    view.on_iteration(STATS)
    assert view._next_weights - time.perf_counter() > 4.0


def test_the_view_takes_the_newest_weights_once(view):
    view._exchange.watched.touch()
    network, env = torch.nn.Linear(2, 1), SimpleNamespace(common_step_counter=0)
    newest = NewestWeights(view._exchange, network, env)
    assert newest.take() is None
    view.on_iteration(STATS)
    stats = newest.take()
    assert stats["iteration"] == 3
    assert torch.equal(network.weight, view._runner.network.weight)
    assert env.common_step_counter == 40
    assert newest.take() is None


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


def test_the_folder_of_a_killed_training_is_removed_at_the_next_start_and_not_before(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(live.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(live, "_start", start("import sys; sys.stdin.read()"))
    folder = tmp_path / "mjlab-live-abc"
    # Files that another user could create there.
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "lock").touch()
    (tmp_path / "mjlab-live-planted").symlink_to(tmp_path / "elsewhere")
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        LiveView(TASK, TrainConfig.from_task(TASK), FakeRunner()).on_end("finished")
        assert folder.exists()
    finally:
        process.kill()
        process.communicate()
    LiveView(TASK, TrainConfig.from_task(TASK), FakeRunner()).on_end("finished")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere", "mjlab-live-planted"]
    assert (tmp_path / "elsewhere" / "lock").exists()


def test_what_is_shown_is_the_runs_own_config_made_small():
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
    job = LiveJob(TASK, env, cfg.agent, type("Runner", (), {"made": lambda self: 5}))
    assert pickle.loads(live._pickled(job)).runner_cls().made() == 5


def test_ports_that_do_not_exist_are_refused(run):
    outcome = run("train", TASK, *SMALL, "--live", "--live-port", "70000")
    assert outcome.status == 1
    assert "--live-port" in outcome.message
    assert "70000" in outcome.message


def test_the_process_loads_nothing_heavy_before_a_browser_connects():
    code = (
        "import sys, mjlab.scripts.live_view; from mjlab.viewer.page_server import serve_page; "
        "serve_page('127.0.0.1', 18341).stop(); assert not {'torch', 'mujoco'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_page_shows_the_policy_of_the_job(tmp_path, monkeypatch):
    import viser

    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.scripts.live_view import make_viewer

    cfg = TrainConfig.from_task(TASK)
    cfg.env.scene.num_envs = 2
    exchange = Exchange(tmp_path)
    server = viser.ViserServer(host="127.0.0.1", port=18321, verbose=False)
    monkeypatch.setattr(server, "get_clients", lambda: {0: SimpleNamespace()})
    try:
        job = LiveJob(TASK, live._view_env_cfg(cfg), cfg.agent, MjlabOnPolicyRunner)
        viewer = make_viewer(job, exchange, server)
        assert isinstance(viewer.env, RslRlVecEnvWrapper)
        network = viewer._take_stats.__self__._network
        other = {key: torch.randn_like(value) for key, value in network.state_dict().items()
                 if value.is_floating_point()}  # fmt: skip
        exchange.write_weights(
            SimpleNamespace(state_dict=lambda: {**network.state_dict(), **other}), 5, STATS
        )
        viewer.run(num_steps=3)
        assert exchange.watched.exists()
        assert torch.equal(network.state_dict()["mlp.0.weight"], other["mlp.0.weight"])
        assert viewer._stats["iteration"] == 3
    finally:
        viewer.env.close()
        server.stop()
