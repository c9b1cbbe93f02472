"""The replay: what is drawn from it is what happened, and nothing that did not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.replay import ReplayFiles, ReplayStorage

Damage = Callable[[dict[str, Any]], Any]
NUM_ENVS = 3
GOES_ON, TERMINATED, TIMED_OUT, CUT_OFF = range(4)


def observation(values: torch.Tensor) -> TensorDict:
    return TensorDict({"actor": values[:, None].float()}, batch_size=[len(values)])


class History:
    """A made-up run: the observation after step t of environment e is 100 e + t, unless it ended.

    An episode ends in the negative of that, and the next one begins at 100 e + t.
    """

    def __init__(self, num_steps: int, kinds: list[list[int]]) -> None:
        self.offsets = 100.0 * torch.arange(NUM_ENVS)
        self.kinds = kinds
        self.ends: list[tuple[int, int]] = []
        self.storage = ReplayStorage(num_steps, observation(self.offsets), ["actor"], 1)
        for step, of_envs in enumerate(kinds, start=1):
            kind = torch.tensor(of_envs)
            known = (kind == TIMED_OUT).nonzero().flatten()
            self.ends += [(env, step - 1) for env in known.tolist()]
            reached = self.offsets + step
            self.storage.add(
                actions=reached[:, None],
                rewards=reached,
                dones=kind != GOES_ON,
                time_outs=kind >= TIMED_OUT,
                next_observations=observation(reached),
                final_ids=known,
                final_observations=observation(-reached[known]),
            )

    def check(self, num_steps: int, gamma: float) -> int:
        """Compare a sample with the history; return how many distinct steps were drawn."""
        generator = torch.Generator().manual_seed(0)
        batch = self.storage.sample(400, gamma, num_steps, generator)
        first = len(self.kinds) - self.storage.num_filled
        seen = set()
        for i in range(400):
            start = batch.observations["actor"][i].item()
            env, step = int(start // 100), int(start % 100)
            assert first <= step < len(self.kinds)
            seen.add((env, step))
            expected, kind, taken = 0.0, GOES_ON, 0
            for ahead in range(min(num_steps, self.storage.num_filled)):
                expected += gamma**ahead * (100.0 * env + step + ahead + 1)
                kind, taken = self.kinds[step + ahead][env], ahead + 1
                if kind != GOES_ON:
                    break
            last = (env, step + taken - 1)
            if kind == TIMED_OUT and last not in self.ends[-NUM_ENVS:]:
                # There is room for no more ends than environments here.
                kind = CUT_OFF
            reached = 100.0 * env + step + taken
            assert batch.actions[i].item() == 100.0 * env + step + 1
            assert batch.returns[i].item() == pytest.approx(expected, rel=1e-5)
            assert batch.weights[i].item() == (0.0 if kind == CUT_OFF else 1.0)
            discount = 0.0 if kind == TERMINATED else gamma**taken
            assert batch.discounts[i].item() == pytest.approx(discount, rel=1e-5)
            if kind in (GOES_ON, TIMED_OUT):
                wanted = -reached if kind == TIMED_OUT else reached
                assert batch.next_observations["actor"][i].item() == wanted
        return len(seen)


@settings(max_examples=40, deadline=None)
@given(
    kinds=st.lists(
        st.lists(st.integers(0, 3), min_size=NUM_ENVS, max_size=NUM_ENVS), min_size=1, max_size=9
    ),
    capacity=st.integers(1, 6),
    num_steps=st.integers(1, 4),
)
def test_a_sample_is_what_happened(kinds, capacity, num_steps):
    history = History(capacity, kinds)
    drawn = history.check(num_steps, gamma=0.9)
    filled = min(capacity, len(kinds))
    # 400 draws of at most 18 transitions miss none.
    assert drawn == NUM_ENVS * (filled - min(num_steps, filled) + 1)


def test_a_time_out_whose_end_was_overwritten_does_not_count():
    # There is room for the ends of one step in 32, but for one of each environment at least.
    history = History(5, [[TIMED_OUT] * NUM_ENVS] * 5)
    batch = history.storage.sample(200, 0.9, 1)
    newest = batch.observations["actor"].flatten() % 100 == 4
    assert torch.equal(batch.weights, newest.float())
    assert newest.any()


def test_what_did_not_lead_to_the_next_observation_is_cut_off():
    history = History(4, [[GOES_ON] * NUM_ENVS] * 3)
    moved = history.offsets + 3
    moved[1] = 7.0
    history.storage.start(observation(moved))
    batch = history.storage.sample(300, 0.9, 1)
    start = batch.observations["actor"].flatten()
    assert torch.equal(batch.weights == 0.0, start == 102.0)
    assert (start == 102.0).any()


def test_contents_survive_a_file(tmp_path):
    history = History(4, [[GOES_ON, TERMINATED, TIMED_OUT]] * 6)
    files = ReplayFiles(tmp_path / "model_6.pt")
    files.write(history.storage)
    restored = History(4, [])
    restored.storage.load_state_dict(files.read(restored.storage))
    restored.kinds, restored.ends = history.kinds, history.ends
    restored.check(2, 0.9)
    one, other = (
        replay.storage.sample(50, 0.9, 3, torch.Generator().manual_seed(1))
        for replay in (history, restored)
    )
    assert torch.equal(one.returns, other.returns)


def test_only_the_newest_checkpoint_keeps_its_replay(tmp_path):
    (tmp_path / "replay_model_0.pt" / "mine").mkdir(parents=True)
    storage = History(2, [[GOES_ON] * NUM_ENVS]).storage
    for number in (1, 2):
        files = ReplayFiles(tmp_path / f"model_{number}.pt")
        files.write(storage)
        files.remove_others()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["replay_model_0.pt", "replay_model_2.pt"]


def test_a_replay_of_other_environments_is_left_out(tmp_path, caplog):
    files = ReplayFiles(tmp_path / "model_1.pt")
    files.write(History(2, [[GOES_ON] * NUM_ENVS]).storage)
    assert files.read(History(3, []).storage) is None
    assert "starts empty" in caplog.text


@pytest.mark.parametrize("name", ["rewards", "kinds", "observations/actor"])
def test_an_edited_replay_is_an_error(tmp_path, name):
    files = ReplayFiles(tmp_path / "model_1.pt")
    files.write(History(4, [[GOES_ON, TERMINATED, TIMED_OUT]] * 6).storage)
    state = torch.load(files.path, weights_only=True)
    state["tensors"][name].view(-1)[0] += 1
    torch.save(state, files.path)
    storage = History(4, []).storage
    with pytest.raises(CheckpointError, match="delete this file") as caught:
        files.read(storage)
    assert str(files.path) in str(caught.value)
    assert storage.num_filled == 0


@pytest.mark.parametrize("content", [b"", b"nothing", b"PK\x03\x04 cut"])
def test_an_unreadable_replay_is_an_error(tmp_path, content):
    files = ReplayFiles(tmp_path / "model_1.pt")
    files.path.write_bytes(content)
    with pytest.raises(CheckpointError, match="delete this file"):
        files.read(History(2, []).storage)


@pytest.mark.parametrize(
    ("written", "wanted"), [("a-1", "b-1"), ("a-1", "a-2"), ("a-1", None), (None, "a-1")]
)
def test_a_replay_of_another_checkpoint_is_an_error(tmp_path, written, wanted):
    files = ReplayFiles(tmp_path / "model_1.pt")
    storage = History(2, [[GOES_ON] * NUM_ENVS]).storage
    files.write(storage, written)
    with pytest.raises(CheckpointError, match="another one.*delete this file"):
        files.read(storage, wanted)
    # That of the checkpoint itself, and of checkpoints of earlier versions.
    assert files.read(storage, written) is not None
