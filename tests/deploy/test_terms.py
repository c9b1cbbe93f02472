"""The tables of observation functions and commands."""

from __future__ import annotations

import importlib

import pytest

from mjlab.deploy.commands import COMMANDS
from mjlab.deploy.terms import TERMS


@pytest.mark.parametrize("name", [*TERMS, *COMMANDS])
def test_rows_are_of_existing_functions(name):
    module, _, attribute = name.partition(":")
    found = getattr(importlib.import_module(module), attribute)
    assert f"{found.__module__}:{found.__qualname__}" == name
