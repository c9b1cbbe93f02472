"""Keys of both viewers.

MuJoCo's window binds every letter, `,`, Page Up and the digits 0 to 5, and handles them even if a callback
does; in the browser, W, A, S, D, Q and E move the camera. The bindings here avoid those keys, and are the
same in both viewers. Viser's hotkeys have no minus, equal or function keys: these work in the window only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mjlab.viewer.base import Steering, ViewerAction

# GLFW key codes, written out because importing glfw loads its shared library.
KEY_UNKNOWN = -1
KEY_SPACE = 32
KEY_APOSTROPHE = 39
KEY_COMMA, KEY_MINUS, KEY_PERIOD, KEY_SLASH = range(44, 48)
KEY_0, KEY_1, KEY_2, KEY_3, KEY_4, KEY_5, KEY_6, KEY_7, KEY_8, KEY_9 = range(48, 58)
KEY_SEMICOLON, KEY_EQUAL = 59, 61
KEY_A, KEY_B, KEY_C, KEY_D, KEY_E, KEY_F, KEY_G, KEY_H, KEY_I, KEY_J = range(65, 75)
KEY_K, KEY_L, KEY_M, KEY_N, KEY_O, KEY_P, KEY_Q, KEY_R, KEY_S, KEY_T = range(75, 85)
KEY_U, KEY_V, KEY_W, KEY_X, KEY_Y, KEY_Z = range(85, 91)
KEY_LEFT_BRACKET, KEY_BACKSLASH, KEY_RIGHT_BRACKET = range(91, 94)
KEY_GRAVE_ACCENT = 96
KEY_ESCAPE, KEY_ENTER, KEY_TAB, KEY_BACKSPACE, KEY_INSERT, KEY_DELETE = range(256, 262)
KEY_RIGHT, KEY_LEFT, KEY_DOWN, KEY_UP = range(262, 266)
KEY_PAGE_UP, KEY_PAGE_DOWN, KEY_HOME, KEY_END = range(266, 270)
KEY_CAPS_LOCK, KEY_SCROLL_LOCK, KEY_NUM_LOCK, KEY_PRINT_SCREEN, KEY_PAUSE = range(280, 285)
KEY_F1, KEY_F2, KEY_F3, KEY_F4, KEY_F5, KEY_F6 = range(290, 296)
KEY_F7, KEY_F8, KEY_F9, KEY_F10, KEY_F11, KEY_F12 = range(296, 302)
KEY_KP_0, KEY_KP_1, KEY_KP_2, KEY_KP_3, KEY_KP_4 = range(320, 325)
KEY_KP_5, KEY_KP_6, KEY_KP_7, KEY_KP_8, KEY_KP_9 = range(325, 330)
KEY_KP_DECIMAL, KEY_KP_DIVIDE, KEY_KP_MULTIPLY, KEY_KP_SUBTRACT = range(330, 334)
KEY_KP_ADD, KEY_KP_ENTER, KEY_KP_EQUAL = range(334, 337)
KEY_LEFT_SHIFT, KEY_LEFT_CONTROL, KEY_LEFT_ALT, KEY_LEFT_SUPER = range(340, 344)
KEY_RIGHT_SHIFT, KEY_RIGHT_CONTROL, KEY_RIGHT_ALT, KEY_RIGHT_SUPER = range(344, 348)


class Binding(NamedTuple):
    """Key of both viewers, or of the window only, and its action."""

    code: int
    """GLFW key code, for MuJoCo's window."""
    hotkey: Any
    """Viser's name of the key, for the browser. None: the window only."""
    label: str
    """Label in the browser's command palette (Ctrl+K)."""
    action: ViewerAction
    payload: Steering | None = None


_STEER = ViewerAction.STEER
BINDINGS = (
    Binding(KEY_UP, "arrowup", "Faster forward", _STEER, Steering.FORWARD),
    Binding(KEY_DOWN, "arrowdown", "Faster backward", _STEER, Steering.BACKWARD),
    Binding(KEY_LEFT, "arrowleft", "Turn left", _STEER, Steering.TURN_LEFT),
    Binding(KEY_RIGHT, "arrowright", "Turn right (paused: single step)", _STEER, Steering.TURN_RIGHT),
    Binding(KEY_DELETE, "delete", "Step left", _STEER, Steering.LEFT),
    Binding(KEY_PAGE_DOWN, "pagedown", "Step right", _STEER, Steering.RIGHT),
    Binding(KEY_END, "end", "Stop; twice: sampled commands", _STEER, Steering.STOP),
    Binding(KEY_SPACE, "space", "Pause", ViewerAction.TOGGLE_PAUSE),
    Binding(KEY_ENTER, "enter", "Reset", ViewerAction.RESET),
    Binding(KEY_INSERT, "insert", "Slower simulation", ViewerAction.SPEED_DOWN),
    Binding(KEY_HOME, "home", "Faster simulation", ViewerAction.SPEED_UP),
    Binding(KEY_MINUS, None, "Slower simulation", ViewerAction.SPEED_DOWN),
    Binding(KEY_EQUAL, None, "Faster simulation", ViewerAction.SPEED_UP),
    Binding(KEY_6, "6", "Previous environment", ViewerAction.PREV_ENV),
    Binding(KEY_7, "7", "Next environment", ViewerAction.NEXT_ENV),
    Binding(KEY_8, None, "Reward plots", ViewerAction.TOGGLE_PLOTS),
    Binding(KEY_9, "9", "Debug drawings", ViewerAction.TOGGLE_DEBUG_VIS),
    Binding(KEY_BACKSPACE, "backspace", "Debug drawings of all envs", ViewerAction.TOGGLE_SHOW_ALL_ENVS),
    Binding(KEY_F9, None, "Debug drawings of all envs", ViewerAction.TOGGLE_SHOW_ALL_ENVS),
)  # fmt: skip
"""Keys and their actions."""

ACTIONS = {binding.code: binding.action for binding in BINDINGS}
"""Actions by GLFW key code."""

KEY_HELP = (
    ("Space / Enter", "pause / reset"),
    ("Right, paused", "single step"),
    ("Insert / Home", "slower / faster"),
    ("6 / 7", "previous / next env"),
    ("8", "reward plots (window)"),
    ("9 / Backspace", "debug drawings / of all envs"),
)
"""Keys and their actions, as shown in the viewers."""

STEERING_HELP = (
    ("Up / Down", "faster forward / backward"),
    ("Left / Right", "turn left / right"),
    ("Delete / Page Down", "step left / right"),
    ("End", "stop; twice: sampled commands"),
)
"""Keys that steer the robot, as shown in the viewers of tasks with such commands."""
