"""Import of a package with its sub-packages."""

from __future__ import annotations

import sys

import pytest

from mjlab.utils.lab_api.tasks.importer import import_packages


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with sub-packages, a plain module, and one that fails."""
    for folder in ("", "walk", "walk/config", "run", "mdp"):
        path = tmp_path / "toy_tasks" / folder
        path.mkdir(parents=True, exist_ok=True)
        (path / "__init__.py").touch()
    (tmp_path / "toy_tasks" / "plain.py").touch()
    (tmp_path / "toy_tasks" / "run" / "__init__.py").write_text("1 / 0")
    monkeypatch.syspath_prepend(tmp_path)
    yield "toy_tasks"
    for name in [name for name in sys.modules if name.startswith("toy_tasks")]:
        del sys.modules[name]


def test_sub_packages_are_imported_but_modules_and_the_blacklist_are_not(package):
    import_packages(package, [".run", ".mdp"])
    loaded = {name for name in sys.modules if name.startswith(package)}
    assert loaded == {package, f"{package}.walk", f"{package}.walk.config"}


def test_errors_of_a_package_are_passed_on(package):
    with pytest.raises(ZeroDivisionError):
        import_packages(package)
