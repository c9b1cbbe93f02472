"""Names imported when they are first used, and modules imported without garbage collection."""

from __future__ import annotations

import gc
import sys

import pytest

from mjlab.utils.lazy import import_to_stay, lazy_names


def test_a_module_that_breaks_with_an_attribute_error_is_named(tmp_path, monkeypatch):
    (tmp_path / "lazy_test_broken.py").write_text("None.missing\n")
    monkeypatch.syspath_prepend(tmp_path)
    find = lazy_names("package", {"Name": "lazy_test_broken"})
    with pytest.raises(ImportError, match=r"lazy_test_broken.*'missing'"):
        find("Name")
    with pytest.raises(AttributeError, match="no attribute 'Other'"):
        find("Other")
    assert "lazy_test_broken" not in sys.modules


@pytest.fixture
def collected():
    """Leave garbage collection as it was."""
    yield
    gc.unfreeze()
    gc.enable()


def test_modules_that_stay_are_not_searched_for_garbage(tmp_path, monkeypatch, collected):
    (tmp_path / "stays.py").write_text("import gc\ncollects = gc.isenabled()\nvalues = [[]]\n")
    monkeypatch.syspath_prepend(tmp_path)
    module = import_to_stay("stays")
    assert not module.collects
    assert gc.isenabled()
    assert not any(candidate is module.values for candidate in gc.get_objects())
    assert import_to_stay("stays") is module
    del sys.modules["stays"]


def test_collection_goes_on_after_a_failed_import(collected):
    with pytest.raises(ModuleNotFoundError):
        import_to_stay("no_such_module")
    assert gc.isenabled()
