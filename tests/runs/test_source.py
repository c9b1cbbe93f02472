"""Policies in ZIP archives, and names of repositories."""

from __future__ import annotations

import shutil
import stat
import sys
import zipfile
from collections import namedtuple
from pathlib import Path

import pytest

from mjlab.runs.source import is_fetched, local_policy
from mjlab.utils.errors import UserError
from mjlab.utils.hub import repository

FILES = ("model_0.pt", "model_1.pt", "policy.onnx", "params/env.yaml")


def write_zip(path: Path, names, prefix: str = "") -> Path:
    """Write an archive whose files hold their names."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(prefix + name, name)
    return path


@pytest.mark.parametrize("prefix", ["", "policy/", "a/b/"])
def test_policies_are_found_in_folders_of_an_archive(tmp_path, prefix):
    folder = local_policy(write_zip(tmp_path / "policy.zip", FILES, prefix))
    assert {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} == {*FILES}
    assert (folder / "params" / "env.yaml").read_text() == "params/env.yaml"
    assert tmp_path not in folder.parents


@pytest.mark.parametrize(
    "name", ["../evil.pt", "/evil.pt", "a/../../evil.pt", "C:/evil.pt", "..\\evil.pt"]
)
def test_files_outside_of_the_folder_are_rejected(tmp_path, monkeypatch, name):
    # The parent of the folder that the archive is unpacked to.
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(UserError):
        local_policy(write_zip(tmp_path / "policy.zip", [*FILES, name]))
    assert not list(tmp_path.rglob("evil.pt"))


def test_links_are_not_followed(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("secret")
    with zipfile.ZipFile(write_zip(tmp_path / "policy.zip", FILES), "a") as archive:
        entry = zipfile.ZipInfo("params/agent.yaml")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, str(secret))
    assert (local_policy(tmp_path / "policy.zip") / "params/agent.yaml").read_text() != "secret"


@pytest.mark.parametrize("names", [[], ["readme.md"], ["a/model_0.pt", "b/model_0.pt"]])
def test_archives_without_one_policy_are_rejected(tmp_path, names):
    with pytest.raises(UserError, match=r"policy\.zip: expected one folder"):
        local_policy(write_zip(tmp_path / "policy.zip", names))


@pytest.mark.parametrize("keep", [0, 10, -30])
def test_damaged_archives_are_rejected(tmp_path, keep):
    path = write_zip(tmp_path / "policy.zip", FILES)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(UserError, match=r"policy\.zip: expected a ZIP archive"):
        local_policy(path)


def test_archives_larger_than_the_free_space_are_rejected(tmp_path, monkeypatch):
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(20))
    with pytest.raises(UserError, match="expected at most 20 bytes"):
        local_policy(write_zip(tmp_path / "policy.zip", FILES))


def test_paths_are_returned_as_they_are(tmp_path):
    for path in (tmp_path, tmp_path / "model_0.pt", tmp_path / "missing.zip"):
        assert local_policy(path) == path
        assert not is_fetched(path)
    assert is_fetched(local_policy(write_zip(tmp_path / "policy.zip", FILES)))


def test_repositories_have_names_and_revisions():
    assert repository("hf:me/my-walk.v2") == ("me/my-walk.v2", None)
    assert repository("hf:me/walk@feature/x") == ("me/walk", "feature/x")


@pytest.mark.parametrize(
    "text", ["hf:walk", "hf:", "hf:me/walk/more", "hf:me/walk@", "hf:me /walk"]
)
def test_malformed_names_are_rejected(text):
    with pytest.raises(UserError, match="hf:NAME/REPO"):
        local_policy(text)


def test_missing_client_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match=r"mjlab\[hub\]"):
        local_policy("hf:me/walk")
