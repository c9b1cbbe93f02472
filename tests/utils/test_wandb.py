"""Weights & Biases: login, and tags of runs."""

from __future__ import annotations

import os
import sys
import types

import pytest

from mjlab.utils.errors import UserError
from mjlab.utils.wandb import add_wandb_tags, check_wandb_login


@pytest.fixture(autouse=True)
def wandb(monkeypatch):
    """A stand-in for the wandb module, without a live run."""
    module = types.SimpleNamespace(run=None)
    monkeypatch.setitem(sys.modules, "wandb", module)
    # Set first, so that what the tests write is undone.
    monkeypatch.setenv("WANDB_TAGS", "")
    return module


def test_tags_wait_for_the_next_run():
    add_wandb_tags(["a", "b"])
    add_wandb_tags(["b", "c"])
    assert os.environ["WANDB_TAGS"] == "a,b,c"


def test_a_live_run_gets_the_tags(wandb):
    wandb.run = types.SimpleNamespace(tags=("a",))
    add_wandb_tags(["b", "a"])
    assert wandb.run.tags == ("a", "b")
    assert os.environ["WANDB_TAGS"] == ""


def test_a_run_may_have_no_tags_and_wandb_need_not_be_imported(wandb, monkeypatch):
    wandb.run = types.SimpleNamespace(tags=None)
    add_wandb_tags(["b"])
    assert wandb.run.tags == ("b",)
    monkeypatch.delitem(sys.modules, "wandb")
    add_wandb_tags(["c"])
    assert os.environ["WANDB_TAGS"] == "c"
    assert "wandb" not in sys.modules


@pytest.mark.parametrize("present", [None, ""])
def test_without_tags_the_variable_is_not_left_empty(monkeypatch, present):
    # wandb reads an empty variable as one empty tag, and rejects runs with empty tags.
    if present is None:
        monkeypatch.delenv("WANDB_TAGS")
    add_wandb_tags([])
    assert "WANDB_TAGS" not in os.environ
    add_wandb_tags(["", "a"])
    assert os.environ["WANDB_TAGS"] == "a"


@pytest.mark.parametrize(
    ("key", "mode", "has_login"),
    [("0" * 40, "online", False), (None, "offline", False), (None, "disabled", False),
     (None, "online", True)],
)  # fmt: skip
def test_with_a_login_or_offline_nothing_is_asked(wandb, monkeypatch, key, mode, has_login):
    set_login(wandb, monkeypatch, key, mode, has_login)
    check_wandb_login("--agent.logger wandb", records=True)


def test_without_a_login_the_error_names_the_cure(wandb, monkeypatch):
    set_login(wandb, monkeypatch, None, "online", False)
    with pytest.raises(UserError, match=r"a/b/c: expected a login.*`wandb login`.*API_KEY\.$"):
        check_wandb_login("a/b/c")
    with pytest.raises(UserError, match="WANDB_MODE=offline"):
        check_wandb_login("--agent.logger wandb", records=True)


def set_login(wandb, monkeypatch, key: str | None, mode: str, has_login: bool) -> None:
    def login(prompt: bool, verify: bool) -> bool:
        assert not prompt
        return has_login

    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    if key is not None:
        monkeypatch.setenv("WANDB_API_KEY", key)
    wandb.login = login
    wandb.setup = lambda: types.SimpleNamespace(settings=types.SimpleNamespace(mode=mode))
