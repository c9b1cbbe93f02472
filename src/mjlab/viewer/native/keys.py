"""Keys of the native window.

MuJoCo's window binds every letter, `,` and the digits 0 to 5 to switches of its own and also acts
on them when we do, so none of those is used here.
"""

from __future__ import annotations

from mjlab.viewer.base import ViewerAction

# GLFW key codes; written out so that this file needs no glfw.
_ENTER, _RIGHT, _F9 = 257, 262, 298

_ACTIONS = {
    _ENTER: ViewerAction.RESET,
    ord(" "): ViewerAction.TOGGLE_PAUSE,
    ord("-"): ViewerAction.SPEED_DOWN,
    ord("="): ViewerAction.SPEED_UP,
    ord("6"): ViewerAction.PREV_ENV,
    ord("7"): ViewerAction.NEXT_ENV,
    ord("8"): ViewerAction.TOGGLE_PLOTS,
    ord("9"): ViewerAction.TOGGLE_DEBUG_VIS,
    _F9: ViewerAction.TOGGLE_SHOW_ALL_ENVS,
    _RIGHT: ViewerAction.SINGLE_STEP,
}

KEY_HELP = (
    ("Space / Right", "pause / single step"),
    ("Enter", "reset"),
    ("- / =", "slower / faster"),
    ("6 / 7", "previous / next env"),
    ("8", "reward plots"),
    ("9 / F9", "debug drawings / of all envs"),
)
"""Keys and what they do, as the window shows them."""


def action_of_key(key: int) -> ViewerAction | None:
    """The action of a GLFW key code, if it has one."""
    return _ACTIONS.get(key)
