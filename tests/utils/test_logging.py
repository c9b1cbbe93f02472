"""Messages to the terminal."""

from __future__ import annotations

import sys

import pytest

from mjlab.utils.logging import print_info


def test_a_message_is_colored_on_a_terminal_only(capsys, monkeypatch):
    print_info("hello", color="red")
    assert capsys.readouterr().out == "hello\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_info("hello", color="red")
    assert capsys.readouterr().out == "\033[31mhello\033[0m\n"


def test_an_unknown_color_is_refused():
    with pytest.raises(ValueError, match=r"\['red'.*'pink'"):
        print_info("hello", color="pink")
