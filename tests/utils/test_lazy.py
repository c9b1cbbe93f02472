"""Names that are imported when they are first used."""

from __future__ import annotations

import sys

import pytest

from mjlab.utils.lazy import lazy_names


def test_a_module_that_breaks_with_an_attribute_error_is_named(tmp_path, monkeypatch):
    (tmp_path / "lazy_test_broken.py").write_text("None.missing\n")
    monkeypatch.syspath_prepend(tmp_path)
    find = lazy_names("package", {"Name": "lazy_test_broken"})
    with pytest.raises(ImportError, match=r"lazy_test_broken.*'missing'"):
        find("Name")
    with pytest.raises(AttributeError, match="no attribute 'Other'"):
        find("Other")
    assert "lazy_test_broken" not in sys.modules
