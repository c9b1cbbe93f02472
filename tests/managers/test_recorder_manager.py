"""Recorders and their hooks."""

from __future__ import annotations

import pytest
import torch

from mjlab.managers import RecorderManager, RecorderTerm, RecorderTermCfg, SceneEntityCfg


class Notes(RecorderTerm):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.notes = []

    def record_pre_reset(self, env_ids):
        self.notes.append(("pre", env_ids.tolist()))

    def record_post_reset(self, env_ids):
        self.notes.append(("post", env_ids.tolist()))

    def record_post_step(self):
        self.notes.append("step")

    def close(self):
        self.notes.append("close")


def test_hooks_reach_every_recorder(env, caplog):
    cfg = {"a": RecorderTermCfg(func=Notes), "off": None, "b": RecorderTermCfg(func=Notes)}
    with caplog.at_level("INFO"):
        manager = RecorderManager(cfg, env)
    assert caplog.text == "", "recorders are switched off without notice"
    manager.record_pre_reset(torch.tensor([1]))
    manager.record_post_reset(torch.tensor([1, 2]))
    manager.record_post_step()
    manager.close()
    for name in ("a", "b"):
        assert manager.get_term(name).notes == [("pre", [1]), ("post", [1, 2]), "step", "close"]


def test_names_are_known_and_unknown_ones_listed(env):
    manager = RecorderManager({"a": RecorderTermCfg(func=Notes)}, env)
    assert "a" in manager
    assert "b" not in manager
    assert manager.active_terms == ["a"]
    with pytest.raises(KeyError, match=r"'b'.*\['a'\]"):
        manager.get_term("b")


@pytest.mark.parametrize("func", [lambda env: None, dict, "Notes"])
def test_what_is_no_recorder_is_refused(env, func):
    with pytest.raises(TypeError, match="'a'.*RecorderTerm"):
        RecorderManager({"a": RecorderTermCfg(func=func)}, env)


def test_selections_are_resolved_before_the_recorder_is_built(env):
    class Selecting(RecorderTerm):
        def __init__(self, cfg, env):
            super().__init__(cfg, env)
            self.ids = cfg.params["asset_cfg"].joint_ids

    params = {"asset_cfg": SceneEntityCfg("robot", joint_names="joint_b")}
    manager = RecorderManager({"a": RecorderTermCfg(func=Selecting, params=params)}, env)
    assert manager.get_term("a").ids == [1]


class Broken(RecorderTerm):
    def __init__(self, cfg, env):
        raise ValueError("no folder")


def test_an_error_while_a_recorder_is_built_names_it(env):
    with pytest.raises(ValueError, match="RecorderManager term 'a': no folder"):
        RecorderManager({"a": RecorderTermCfg(func=Broken)}, env)


def test_a_recorder_that_is_called_says_what_to_override(env):
    with pytest.raises(NotImplementedError, match="Notes: .*override.*record_post_step"):
        Notes(RecorderTermCfg(func=Notes), env)()
