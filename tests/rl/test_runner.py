"""Training loop: exact resume, signals, stop when solved, reports and files."""

from __future__ import annotations

import contextlib
import copy
import os
import signal
import sys
import time
import types
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from rl_fake_env import FakeEnv

from mjlab.rl.checkpoint import CheckpointError, RunFolderError, load_checkpoint
from mjlab.rl.config import EvaluationCfg, RslRlPpoAlgorithmCfg
from mjlab.rl.rollout_watch import DivergedError
from mjlab.rl.run_logger import IterationStats, TrainingObserver
from mjlab.utils.random import preserved_rng


class Recorder(TrainingObserver):
    def __init__(self) -> None:
        self.stats: list[IterationStats] = []
        self.events: list[tuple] = []

    def on_start(self, first_iteration, total_iterations):
        self.events.append(("start", first_iteration, total_iterations))

    def on_iteration(self, stats):
        self.stats.append(stats)

    def on_evaluation(self, iteration, result, solved):
        self.events.append(("evaluation", iteration, solved))

    def on_stop_requested(self, signal_name):
        self.events.append(("stop", signal_name))

    def on_end(self, reason):
        self.events.append(("end", reason))


def everything(runner) -> dict[str, torch.Tensor]:
    """Return all that decides how training goes on, by name."""
    state = {"learning_rate": torch.tensor(runner.alg.learning_rate, dtype=torch.float64)}
    for part, values in runner.alg.save().items():
        if part != "optimizer_state_dict":
            state |= {f"{part}.{name}": value for name, value in values.items()}
            continue
        for index, entry in values["state"].items():
            state |= {f"{part}.{index}.{name}": value for name, value in entry.items()}
    env = runner.env.unwrapped
    state |= {"position": env.position, "lengths": env.episode_length_buf}
    state["next_random"] = torch.rand(3)
    return state


def assert_same_bits(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


def test_a_resumed_run_continues_bit_for_bit(make_runner, tmp_path: Path):
    straight = make_runner(tmp_path / "straight")
    straight.learn(6, init_at_random_ep_len=True)
    expected = everything(straight)

    make_runner(tmp_path / "first").learn(3, init_at_random_ep_len=True)
    # Another seed, and draws in between: nothing of the second process may matter.
    second = make_runner(tmp_path / "second", env_cfg={"seed": 77})
    torch.rand(5)
    second.load(str(tmp_path / "first" / "model_2.pt"))
    second.learn(6, init_at_random_ep_len=True)

    assert second.current_learning_iteration == 6
    assert_same_bits(everything(second), expected)


def test_a_killed_run_resumes_from_its_last_checkpoint_bit_for_bit(make_runner, tmp_path: Path):
    straight = make_runner(tmp_path / "straight")
    straight.learn(6)
    expected = everything(straight)

    class Killed(BaseException):
        pass

    class Kill(TrainingObserver):
        def on_iteration(self, stats):
            if stats.iteration == 5:
                raise Killed

    killed = make_runner(tmp_path / "killed")
    killed.observers.append(Kill())
    with pytest.raises(Killed):
        killed.learn(6)
    assert sorted(path.name for path in (tmp_path / "killed").glob("model_*")) == [
        "model_0.pt",
        "model_2.pt",
    ]
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(tmp_path / "killed" / "model_2.pt"))
    resumed.learn(6)
    assert_same_bits(everything(resumed), expected)


def test_learning_on_in_the_same_process_is_the_same_as_learning_at_once(make_runner):
    straight, in_parts = make_runner(), None
    straight.learn(4)
    expected = everything(straight)
    in_parts = make_runner()
    in_parts.learn(2)
    in_parts.learn(4)
    assert_same_bits(everything(in_parts), expected)


def test_observations_and_statistics_of_a_resumed_run_go_on(make_runner, tmp_path: Path):
    straight, recorder = make_runner(tmp_path / "straight"), Recorder()
    straight.observers.append(recorder)
    straight.learn(5)
    make_runner(tmp_path / "first").learn(3)
    resumed, again = make_runner(tmp_path / "second"), Recorder()
    resumed.observers.append(again)
    resumed.load(str(tmp_path / "first" / "model_2.pt"))
    resumed.learn(5)
    assert again.events[0] == ("start", 3, 5)
    for one, other in zip(recorder.stats[3:], again.stats, strict=True):
        for name in ("iteration", "total_steps", "mean_reward", "mean_episode_length", "losses"):
            assert getattr(one, name) == getattr(other, name), name


def test_with_another_number_of_environments_only_the_episodes_start_anew(
    make_runner, tmp_path: Path, caplog
):
    first = make_runner(tmp_path / "first")
    first.learn(3)
    second = make_runner(tmp_path / "second", num_envs=6)
    second.load(str(tmp_path / "first" / "model_2.pt"))
    for one, other in zip(first.alg.actor.parameters(), second.alg.actor.parameters(), strict=True):
        assert torch.equal(one, other)
    second.learn(4)
    assert second.current_learning_iteration == 4
    assert "--num-envs 8" in caplog.text


def test_loading_a_policy_touches_neither_generators_nor_environments(make_runner, tmp_path: Path):
    make_runner(tmp_path / "run").learn(2)
    player = make_runner()
    position, generators = player.env.unwrapped.position.clone(), torch.get_rng_state()
    player.load(str(tmp_path / "run" / "model_1.pt"), load_cfg={"actor": True})
    assert torch.equal(player.env.unwrapped.position, position)
    assert torch.equal(torch.get_rng_state(), generators)
    assert player.current_learning_iteration == 0
    # The step counter comes along, so that curricula are at the trained stage.
    assert player.env.unwrapped.common_step_counter == 10


def test_a_finished_run_has_nothing_left_to_train(make_runner, tmp_path: Path, caplog):
    make_runner(tmp_path / "first").learn(2)
    again = make_runner(tmp_path / "second")
    again.load(str(tmp_path / "first" / "model_1.pt"))
    again.learn(2)
    assert "has finished 2 iterations" in caplog.text
    assert not list((tmp_path / "second").glob("model_*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_training_with_a_checkpoint_that_resumes(make_runner, tmp_path: Path, number):
    straight = make_runner(tmp_path / "straight")
    straight.learn(5)
    expected = everything(straight)

    class Interrupt(Recorder):
        def on_iteration(self, stats):
            if stats.iteration == 2:
                os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    runner, observer = make_runner(tmp_path / "run"), Interrupt()
    runner.observers.append(observer)
    runner.learn(5)
    assert runner.stop_reason == "interrupted"
    assert ("stop", number.name) in observer.events
    assert observer.events[-1] == (
        "end",
        "interrupted",
    )
    assert signal.getsignal(number) is before
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(tmp_path / "run" / f"model_{runner.current_learning_iteration - 1}.pt"))
    resumed.learn(5)
    assert_same_bits(everything(resumed), expected)


def interrupt_once_due(runner, place: str, times: int) -> None:
    """Raise SIGINT `times` times in the fourth iteration: in its second step, or in its update."""
    owner, name = (runner.env, "step") if place == "step" else (runner.alg, "update")
    function, calls = getattr(owner, name), []

    def interrupted(*args):
        result = function(*args)
        if runner.current_learning_iteration == 3:
            calls.append(None)
            if len(calls) == (2 if place == "step" else 1):
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)
                time.sleep(1.0 if runner.grace is not None else 0.0)
        return result

    setattr(owner, name, interrupted)


@pytest.mark.parametrize(("place", "grace"), [("step", None), ("update", None), ("step", 0.01)])
def test_a_second_signal_gives_the_iteration_up(make_runner, tmp_path: Path, place, grace):
    straight, recorder = make_runner(), Recorder()
    straight.observers.append(recorder)
    straight.learn(6)
    expected = everything(straight)
    runner, observer = make_runner(tmp_path / "run", save_interval=100), Recorder()
    runner.observers.append(observer)
    runner.grace = grace
    interrupt_once_due(runner, place, times=2 if grace is None else 1)
    runner.learn(6)
    assert (runner.stop_reason, runner.stop_signal) == ("interrupted", signal.SIGINT)
    assert observer.events[-1] == ("end", "interrupted")
    assert runner.current_learning_iteration == 3
    with preserved_rng():
        resumed = make_runner(tmp_path / "resumed")
        resumed.load(str(tmp_path / "run" / "model_2.pt"))
        resumed.learn(6)
        assert_same_bits(everything(resumed), expected)
    # In its process it goes on in the same way.
    runner.learn(6)
    assert_same_bits(everything(runner), expected)
    for one, other in zip(recorder.stats, observer.stats, strict=True):
        assert one.mean_reward == other.mean_reward
        assert one.environment == other.environment


@pytest.mark.parametrize("times", [2, 3])
def test_only_a_third_signal_ends_a_save(make_runner, tmp_path: Path, times):
    before = signal.getsignal(signal.SIGINT)
    runner = make_runner(tmp_path / "run")
    save = runner.save

    def interrupted(path):
        for _ in range(times if runner.current_learning_iteration == 3 else 0):
            signal.raise_signal(signal.SIGINT)
        save(path)

    runner.save = interrupted
    with pytest.raises(KeyboardInterrupt) if times == 3 else contextlib.nullcontext():
        runner.learn(6)
    assert runner.stop_reason == "interrupted"
    assert signal.getsignal(signal.SIGINT) is before
    last = 2 if times == 2 else 0
    names = [path.name for path in (tmp_path / "run").glob("model_*")]
    assert max(names) == f"model_{last}.pt"


def test_a_signal_in_the_last_iteration_interrupts_nothing(make_runner, tmp_path: Path):
    class Stop(TrainingObserver):
        def on_iteration(self, stats):
            if stats.iteration == 3:
                signal.raise_signal(signal.SIGINT)

    runner = make_runner(tmp_path / "run")
    runner.observers.append(Stop())
    runner.learn(3)
    assert (runner.stop_reason, runner.stop_signal) == ("finished", None)


def test_two_hangups_of_a_closed_terminal_save(make_runner, tmp_path: Path):
    class HangUp(TrainingObserver):
        def on_iteration(self, stats):
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGHUP)

    runner = make_runner(tmp_path / "run")
    runner.observers.append(HangUp())
    runner.learn(5)
    assert runner.stop_reason == "interrupted"
    assert (tmp_path / "run" / "model_0.pt").exists()


def test_a_process_that_ignores_hangups_trains_on(make_runner, tmp_path: Path):
    class HangUp(TrainingObserver):
        def on_iteration(self, stats):
            os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        runner = make_runner(tmp_path / "run")
        runner.observers.append(HangUp())
        runner.learn(3)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert runner.stop_reason == "finished"


@pytest.mark.parametrize("place", ["term", "update", "observer"])
def test_an_error_leaves_what_was_learned_before_it(
    make_runner, tmp_path: Path, monkeypatch, caplog, place
):
    straight = make_runner(tmp_path / "straight", save_interval=100)
    straight.learn(3)
    runner = make_runner(tmp_path / "run", save_interval=100)
    update, step = runner.alg.update, runner.env.step

    def broken_update():
        losses = update()
        if runner.current_learning_iteration == 3:
            raise ZeroDivisionError("in a network")
        return losses

    def broken_step(actions):
        if runner.current_learning_iteration == 3:
            raise ZeroDivisionError("in a term")
        return step(actions)

    class Broken(TrainingObserver):
        def on_iteration(self, stats: IterationStats) -> None:
            if stats.iteration == 4:
                raise ZeroDivisionError("in an observer")

    if place == "observer":
        runner.observers.append(Broken())
    elif place == "update":
        monkeypatch.setattr(runner.alg, "update", broken_update)
    else:
        monkeypatch.setattr(runner.env, "step", broken_step)
    with pytest.raises(ZeroDivisionError, match="in a"):
        runner.learn(6)
    assert "iteration 4" in caplog.text
    assert "new episodes" in caplog.text
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(tmp_path / "run" / "model_2.pt"))
    assert resumed.current_learning_iteration == 3
    for name in ("actor", "critic"):
        saved = getattr(resumed.alg, name).state_dict()
        assert_same_bits(saved, getattr(straight.alg, name).state_dict())
    states = [learner.alg.optimizer.state_dict()["state"] for learner in (resumed, straight)]
    assert_same_bits(states[0][0], states[1][0])
    resumed.learn(4)


def test_losses_that_are_not_finite_are_told_once(make_runner, monkeypatch, caplog):
    runner = make_runner()
    update = runner.alg.update
    monkeypatch.setattr(runner.alg, "update", lambda: {**update(), "mine": float("inf")})
    runner.learn(3)
    (told,) = [r.getMessage() for r in caplog.records if "Losses" in r.getMessage()]
    assert "iteration 1: mine" in told


def test_weights_of_nan_end_training_with_those_before(make_runner, tmp_path: Path, monkeypatch):
    runner = make_runner(tmp_path / "run", save_interval=2)
    update = runner.alg.update

    def breaking_update():
        losses = update()
        if runner.current_learning_iteration == 2:
            with torch.no_grad():
                next(runner.alg.get_policy().parameters()).fill_(float("nan"))
        return losses

    monkeypatch.setattr(runner.alg, "update", breaking_update)
    with pytest.raises(DivergedError, match="weights are NaN.*learning rate"):
        runner.learn(6)
    # Even if that iteration saves.
    assert sorted(path.name for path in (tmp_path / "run").glob("model_*")) == [
        "model_0.pt", "model_1.pt",
    ]  # fmt: skip
    make_runner().load(str(tmp_path / "run" / "model_1.pt"))


def test_errors_after_a_resume_keep_the_checkpoint(make_runner, tmp_path: Path, monkeypatch):
    make_runner(tmp_path / "first").learn(2)
    resumed = make_runner(tmp_path / "second")
    resumed.load(str(tmp_path / "first" / "model_1.pt"))
    monkeypatch.setattr(resumed.alg, "update", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        resumed.learn(4)
    assert not list((tmp_path / "second").glob("model_*"))


def test_an_error_does_not_replace_a_checkpoint_that_resumes_exactly(
    make_runner, tmp_path: Path, monkeypatch
):
    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    whole = (tmp_path / "run" / "model_0.pt").read_bytes()
    monkeypatch.setattr(runner.alg, "update", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        runner.learn(3)
    assert (tmp_path / "run" / "model_0.pt").read_bytes() == whole


@pytest.mark.parametrize("made_again", [False, True])
def test_a_run_whose_folder_is_gone_is_saved_beside_it(
    make_runner, tmp_path: Path, made_again: bool
):
    straight = make_runner(tmp_path / "straight")
    straight.learn(4)
    expected = everything(straight)
    folder = tmp_path / "run"

    class Move(TrainingObserver):
        def on_iteration(self, stats):
            if stats.iteration == 2:
                folder.rename(tmp_path / "moved")
                if made_again:
                    folder.mkdir()

    runner = make_runner(folder)
    runner.observers.append(Move())
    with pytest.raises(RunFolderError) as caught:
        runner.learn(4)
    rescued = tmp_path / "run_rescued" / "model_1.pt"
    assert str(folder) in str(caught.value)
    assert str(rescued) in str(caught.value)
    resumed = make_runner(tmp_path / "resumed")
    resumed.load(str(rescued))
    resumed.learn(4)
    assert_same_bits(everything(resumed), expected)


def test_updates_and_exploration_fade_with_the_iterations(make_runner, tmp_path: Path):
    algorithm = RslRlPpoAlgorithmCfg(num_learning_epochs=1, desired_kl=0.02, entropy_coef=0.01)
    changes = {"algorithm": asdict(algorithm), "annealing": ((1, 1.0), (3, 0.5))}
    runner = make_runner(tmp_path / "run", **copy.deepcopy(changes))
    divergences, bonuses = [], []
    for iterations in range(1, 6):
        runner.learn(iterations)
        divergences.append(runner.alg.desired_kl)
        bonuses.append(runner.alg.entropy_coef)
    assert divergences == pytest.approx([0.02, 0.02, 0.015, 0.01, 0.01])
    assert bonuses == pytest.approx([0.01, 0.01, 0.0075, 0.005, 0.005])
    resumed = make_runner(**changes)
    resumed.load(str(tmp_path / "run" / "model_4.pt"))
    resumed.learn(6)
    assert resumed.alg.desired_kl == pytest.approx(0.01)


def test_without_annealing_settings_that_others_change_stay(make_runner):
    runner = make_runner()
    runner.alg.entropy_coef, runner.alg.desired_kl = 0.3, 0.4
    runner.learn(2)
    assert (runner.alg.entropy_coef, runner.alg.desired_kl) == (0.3, 0.4)


def solved_at(value: float, **changes) -> dict:
    return asdict(EvaluationCfg(solved_return=value, num_episodes=4, min_interval=1, **changes))


def test_training_stops_when_solved_and_evaluation_leaves_no_trace(make_runner, tmp_path: Path):
    plain = make_runner(tmp_path / "plain")
    plain.learn(2)
    expected = everything(plain)

    recorder = Recorder()
    # A return that the second evaluation reaches for sure, and no other: every policy does.
    runner = make_runner(tmp_path / "run", evaluation=solved_at(0.01) | {"min_interval": 2})
    runner.observers.append(recorder)
    runner.learn(50)
    assert runner.stop_reason == "solved"
    assert runner.current_learning_iteration == 2
    assert ("evaluation", 2, True) in recorder.events
    assert runner.last_evaluation.num_episodes == 4
    assert runner.last_evaluation.mean_length <= 12
    assert_same_bits(everything(runner), expected)


class Killed(BaseException):
    pass


@pytest.mark.parametrize(
    "evaluation",
    [
        1,
        pytest.param(2, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("how", ["SIGTERM", "twice", "killed"])
def test_an_interrupted_evaluation_is_made_up_for(
    make_runner, tmp_path: Path, monkeypatch, evaluation, how
):
    """The first evaluation, or the second one that confirms it."""
    solved = solved_at(0.01) | {"min_interval": 2}
    straight = make_runner(tmp_path / "straight", evaluation=solved)
    straight.learn(50)
    expected = everything(straight)
    built, step, steps = [], FakeEnv.step, []

    def built_env(env, *args, **kwargs):
        init(env, *args, **kwargs)
        built.append(env)

    def interrupted(env, action):
        if len(built) > evaluation and env is built[evaluation]:
            steps.append(None)
            if len(steps) == 3:
                assert load_checkpoint(tmp_path / "run" / "model_1.pt")["owes_evaluation"]
                if how == "killed":
                    raise Killed
                for _ in range(2 if how == "twice" else 1):
                    signal.raise_signal(signal.SIGINT if how == "twice" else signal.Signals[how])
        return step(env, action)

    init = FakeEnv.__init__
    with monkeypatch.context() as patch:
        patch.setattr(FakeEnv, "__init__", built_env)
        patch.setattr(FakeEnv, "step", interrupted)
        runner = make_runner(tmp_path / "run", evaluation=solved)
        with pytest.raises(Killed) if how == "killed" else contextlib.nullcontext():
            runner.learn(50)
        if how != "killed":
            assert runner.stop_reason == "interrupted"
            assert len(steps) == 3
            # A resumed run is interrupted while it makes up for the evaluation.
            steps.clear()
            with preserved_rng():
                again = make_runner(tmp_path / "again", evaluation=solved)
                built[:] = built[:1]
                again.load(str(tmp_path / "run" / "model_1.pt"))
                again.learn(50)
            assert (again.stop_reason, len(steps)) == ("interrupted", 3)
    with preserved_rng():
        resumed, recorder = make_runner(tmp_path / "resumed", evaluation=solved), Recorder()
        resumed.observers.append(recorder)
        resumed.load(str(tmp_path / ("run" if how == "killed" else "again") / "model_1.pt"))
        resumed.learn(50)
        assert resumed.stop_reason == "solved"
        assert ("evaluation", 2, True) in recorder.events
        assert resumed.last_evaluation.returns == straight.last_evaluation.returns
        assert_same_bits(everything(resumed), expected)
    last = load_checkpoint(tmp_path / "resumed" / "model_1.pt")
    assert (last["last_evaluated"], last["owes_evaluation"]) == (2, False)
    if how != "killed":
        # In its process it goes on in the same way.
        runner.learn(50)
        assert_same_bits(everything(runner), expected)
        assert not load_checkpoint(tmp_path / "run" / "model_1.pt")["owes_evaluation"]


def test_each_checkpoint_is_written_once_and_knows_its_evaluation(make_runner, tmp_path: Path):
    runner = make_runner(
        tmp_path / "run", evaluation=solved_at(13.0, trigger_fraction=0.0) | {"min_interval": 2}
    )
    written, save = [], runner.save
    runner.save = lambda path: (written.append(Path(path).name), save(path))
    runner.learn(6)
    assert written == [
        "model_0.pt",
        "model_1.pt",
        "model_2.pt",
        "model_3.pt",
        "model_4.pt",
        "model_5.pt",
    ]
    for iteration, evaluated in ((1, 0), (2, 2), (3, 2), (4, 4), (5, 4), (6, 6)):
        content = load_checkpoint(tmp_path / "run" / f"model_{iteration - 1}.pt")
        assert (content["last_evaluated"], content["owes_evaluation"]) == (evaluated, False)


@pytest.mark.parametrize("remaining", [0, 3])
def test_an_evaluation_owed_by_the_last_iteration_is_made(make_runner, tmp_path: Path, remaining):
    evaluated = solved_at(13.0, trigger_fraction=0.0) | {"min_interval": 3}

    class Stop(TrainingObserver):
        def on_iteration(self, stats):
            if stats.iteration == 3:
                signal.raise_signal(signal.SIGINT)

    first = make_runner(tmp_path / "first", evaluation=evaluated)
    first.observers.append(Stop())
    first.learn(3 + remaining)
    assert first.last_evaluation is None
    second, recorder = make_runner(tmp_path / "second", evaluation=evaluated), Recorder()
    second.observers.append(recorder)
    second.load(str(tmp_path / "first" / "model_2.pt"))
    second.learn(3)
    assert recorder.events == [("start", 3, 3), ("evaluation", 3, False), ("end", "finished")]
    assert not load_checkpoint(tmp_path / "second" / "model_2.pt")["owes_evaluation"]


def test_first_iteration_of_evaluations(make_runner):
    recorder = Recorder()
    runner = make_runner(evaluation=solved_at(0.01, first_iteration=4))
    runner.observers.append(recorder)
    runner.learn(50)
    assert min(event[1] for event in recorder.events if event[0] == "evaluation") == 4
    assert runner.current_learning_iteration == 4


def test_training_goes_on_when_told_so_and_when_not_solved(make_runner):
    on = make_runner(evaluation=solved_at(0.01, stop_when_solved=False))
    on.learn(3)
    assert on.stop_reason == "finished"
    assert on.last_evaluation is not None
    # 12 steps have at most 12 reward; the training data reach the trigger, the evaluation fails.
    unsolved = make_runner(evaluation=solved_at(13.0, trigger_fraction=0.0))
    unsolved.learn(3)
    assert unsolved.stop_reason == "finished"
    assert unsolved.last_evaluation is not None
    untried = make_runner(evaluation=solved_at(13.0, trigger_fraction=1.0))
    untried.learn(3)
    assert untried.last_evaluation is None


def test_a_task_may_be_solved_by_its_metrics(make_runner):
    metrics = {"distance": lambda env: env.position.norm(dim=-1)}
    cfg = {"num_episodes": 4, "min_interval": 1, "metrics": metrics}
    near = make_runner(evaluation=asdict(EvaluationCfg(solved_below={"distance": 9.0}, **cfg)))
    near.learn(3)
    assert near.stop_reason == "solved"
    far = make_runner(evaluation=asdict(EvaluationCfg(solved_above={"distance": 9.0}, **cfg)))
    far.learn(3)
    assert far.stop_reason == "finished"
    assert far.last_evaluation.metrics["distance"].mean < 9.0
    waiting = make_runner(
        evaluation=asdict(EvaluationCfg(solved_below={"distance": 9.0}, trigger_return=13.0, **cfg))
    )
    waiting.learn(3)
    assert waiting.last_evaluation is None


def test_a_trigger_evaluates_without_a_goal(make_runner, tmp_path: Path):
    from mjlab.rl.plot import read_scalars

    cfg = {"num_episodes": 4, "min_interval": 1}
    plain = make_runner(evaluation=asdict(EvaluationCfg(**cfg)))
    plain.learn(2)
    assert plain.last_evaluation is None
    triggered = make_runner(
        tmp_path / "run", evaluation=asdict(EvaluationCfg(trigger_return=-1e9, **cfg))
    )
    triggered.learn(2)
    assert triggered.stop_reason == "finished"
    assert triggered.last_evaluation.num_episodes == 4
    steps, seconds = read_scalars(tmp_path / "run", "Perf/evaluation_time")
    assert steps.tolist() == [0, 1]
    assert (seconds > 0.0).all()


def test_evaluations_may_be_harder_than_training(make_runner):
    cfg = {"num_episodes": 4, "min_interval": 1, "solved_below": {"mean_length": 3.0}}
    as_trained = make_runner(evaluation=asdict(EvaluationCfg(**cfg)))
    as_trained.learn(2)
    prepared = make_runner(evaluation=asdict(EvaluationCfg(**cfg)))
    prepared.evaluate_in(replace(prepared.env.cfg, episode_steps=1))
    prepared.learn(2)
    assert prepared.last_evaluation.mean_length < as_trained.last_evaluation.mean_length
    assert prepared.env.cfg.episode_steps == as_trained.env.cfg.episode_steps


@pytest.mark.parametrize("name", ["speed", "success_rate"])
def test_conditions_on_what_is_not_measured_are_refused_at_once(make_runner, name):
    with pytest.raises(ValueError, match=f"'{name}' is not measured.*'mean_return'"):
        make_runner(evaluation=asdict(EvaluationCfg(solved_below={name: 1.0})))


def test_statistics_are_those_of_the_episodes(make_runner, tmp_path: Path):
    runner, recorder = make_runner(env_cfg={"always_terminate": True}), Recorder()
    runner.observers.append(recorder)
    runner.learn(2)
    stats = recorder.stats[-1]
    assert stats.iteration == 2
    assert stats.total_iterations == 2
    assert stats.time_left == 0.0
    assert stats.total_steps == 2 * 5 * 8
    assert stats.mean_episode_length == 1.0
    # Rewards are in units of the step's half second; `mean_step_reward` is not.
    assert 0.0 < stats.mean_reward < 0.5
    assert stats.mean_step_reward > stats.mean_reward
    assert stats.environment["Episode/plain"] == 2.0
    assert stats.environment["Metrics/distance"] > 0.0
    assert set(stats.losses) == {"value", "surrogate", "entropy"}
    assert stats.steps_per_second > 0.0


def test_figures_are_in_the_event_files(make_runner, tmp_path: Path):
    from mjlab.rl.plot import read_scalars

    make_runner(tmp_path / "run").learn(4)
    steps, values = read_scalars(tmp_path / "run", "Train/mean_step_reward")
    assert steps.tolist() == [0, 1, 2, 3]
    assert (values > 0).all()
    for tag in ("Loss/value", "Perf/total_fps", "Policy/mean_std", "Metrics/distance"):
        assert len(read_scalars(tmp_path / "run", tag)[0]) == 4


def test_nan_from_the_environment_ends_training_and_names_the_group(make_runner, tmp_path: Path):
    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    runner.env.unwrapped.drift = torch.full((8, 2), torch.nan)
    with pytest.raises(ValueError, match="'actor'.*NaN"):
        runner.learn(3)
    assert runner.stop_reason == "failed"
    load_checkpoint(tmp_path / "run" / "model_0.pt")


def test_an_unwritable_log_folder_is_one_error_before_training(make_runner, tmp_path: Path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    runner, recorder = make_runner(blocker / "run"), Recorder()
    runner.observers.append(recorder)
    with pytest.raises(RunFolderError, match="cannot be written to.*--log-root"):
        runner.learn(2)
    assert recorder.stats == []


def test_a_full_disk_keeps_the_last_checkpoint(make_runner, tmp_path: Path, monkeypatch):
    import errno

    from mjlab.rl import checkpoint

    runner = make_runner(tmp_path / "run")
    runner.learn(1)
    before = (tmp_path / "run" / "model_0.pt").read_bytes()

    replacing = checkpoint.replacing

    @contextlib.contextmanager
    def fail(path, **kwargs):
        with replacing(path, **kwargs) as file:
            yield file
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "replacing", fail)
    with pytest.raises(CheckpointError, match="disk is full.*model_0.pt.*is intact"):
        runner.learn(3)
    assert (tmp_path / "run" / "model_0.pt").read_bytes() == before
    assert not [path for path in (tmp_path / "run").iterdir() if "tmp" in path.name]


def test_only_the_first_process_writes(make_runner, tmp_path: Path):
    runner = make_runner(tmp_path / "run")
    runner.gpu_global_rank = 1
    runner.logger.disable_logs = True
    runner.learn(2)
    assert not (tmp_path / "run").exists()


def test_nothing_is_printed(make_runner, tmp_path: Path, capsys):
    make_runner(tmp_path / "run").learn(2)
    assert capsys.readouterr().out == ""


def test_failed_uploads_are_warnings(make_runner, tmp_path: Path, monkeypatch, caplog):
    def fail(*args, **kwargs):
        raise RuntimeError("the service is down")

    client = types.ModuleType("wandb")
    for name in ("init", "log"):
        setattr(client, name, lambda *args, **kwargs: None)
    client.config = types.SimpleNamespace(update=lambda values: None)
    client.save = client.finish = fail
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", client)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", client)
    make_runner(tmp_path / "run", logger="wandb").learn(1)
    assert (tmp_path / "run" / "model_0.pt").is_file()
    for name in ("model_0.pt", "last values"):
        assert f"{name} to the logging service: the service is down" in caplog.text
    assert caplog.text.count("the service is down") == 3


def test_weights_and_biases_gets_figures_and_files_only_on_request(
    make_runner, tmp_path: Path, monkeypatch
):
    calls: list[tuple] = []
    client = types.ModuleType("wandb")
    for name in ("init", "log", "save", "finish"):
        setattr(client, name, lambda *args, _name=name, **kwargs: calls.append((_name, args)))
    client.config = types.SimpleNamespace(update=lambda values: calls.append(("config", values)))
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setitem(sys.modules, "wandb", client)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", client)

    make_runner(tmp_path / "plain").learn(1)
    assert calls == []
    make_runner(tmp_path / "run", logger="wandb").learn(1)
    names = [name for name, _ in calls]
    assert names[0] == "init"
    assert names[-1] == "finish"
    assert any(name == "log" and "Loss/value" in args[0] for name, args in calls)
    files = [Path(args[0]).name for name, args in calls if name == "save"]
    assert files == ["model_0.pt", "run.onnx"]
    # TensorBoard's file is written all the same.
    assert list((tmp_path / "run").glob("events.*"))

    calls.clear()
    make_runner(tmp_path / "kept", logger="wandb", upload_model=False).learn(1)
    assert not [args for name, args in calls if name == "save" and "kept." in args[0]]
    assert not [args for name, args in calls if name == "save" and "model_" in args[0]]


@pytest.mark.parametrize("base", ["MjlabOnPolicyRunner", "ExportingOnPolicyRunner"])
def test_a_subclass_decides_where_policies_are_exported(make_runner, tmp_path: Path, base):
    from mjlab import rl
    from mjlab.rl.runner import ExportingOnPolicyRunner

    class Own(
        {"ExportingOnPolicyRunner": ExportingOnPolicyRunner}.get(base, rl.MjlabOnPolicyRunner)
    ):
        @staticmethod
        def _get_export_paths(checkpoint_path: str) -> tuple[Path, str, Path]:
            folder = Path(checkpoint_path).parent / "exported"
            name = f"{Path(checkpoint_path).stem}.onnx"
            return folder, name, folder / name

    runner = make_runner(tmp_path / "run")
    runner.__class__ = Own
    runner.learn(1)
    assert [p.name for p in (tmp_path / "run" / "exported").iterdir()] == ["model_0.onnx"]
    assert not list((tmp_path / "run").glob("*.onnx"))


def test_exports_have_the_name_of_the_run(tmp_path: Path):
    from mjlab.rl import MjlabOnPolicyRunner

    folder, name, path = MjlabOnPolicyRunner._get_export_paths(str(tmp_path / "run" / "model_7.pt"))
    assert (folder, name) == (tmp_path / "run", "run.onnx")
    assert path == folder / name
