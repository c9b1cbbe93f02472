"""Messages to the terminal."""

from __future__ import annotations

import sys

import pytest

from mjlab.utils.logging import first_line, print_info


def test_a_message_is_colored_on_a_terminal_only(capsys, monkeypatch):
    print_info("hello", color="red")
    assert capsys.readouterr().out == "hello\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_info("hello", color="red")
    assert capsys.readouterr().out == "\033[31mhello\033[0m\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("\n odd\nmore"), "odd"),
        (KeyError(), "KeyError"),
        (ValueError(" \n"), "ValueError"),
        (OSError(13, "Permission denied", "a/file"), "[Errno 13] Permission denied: 'a/file'"),
        (OSError("reset\nby peer"), "reset"),
        (RuntimeError("x" * 999), "x" * 160),
    ],
)
def test_an_error_is_reduced_to_one_line(error, line):
    assert first_line(error) == line
