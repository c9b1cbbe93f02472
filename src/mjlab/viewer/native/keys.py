"""Key bindings of the native window.

MuJoCo's window binds every letter, `,` and the digits 0 to 5, and handles them even if a callback
does. The bindings here avoid those keys.
"""

from __future__ import annotations

from mjlab.viewer.base import ViewerAction

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

ACTIONS = {
    KEY_ENTER: ViewerAction.RESET,
    KEY_SPACE: ViewerAction.TOGGLE_PAUSE,
    KEY_MINUS: ViewerAction.SPEED_DOWN,
    KEY_EQUAL: ViewerAction.SPEED_UP,
    KEY_6: ViewerAction.PREV_ENV,
    KEY_7: ViewerAction.NEXT_ENV,
    KEY_8: ViewerAction.TOGGLE_PLOTS,
    KEY_9: ViewerAction.TOGGLE_DEBUG_VIS,
    KEY_F9: ViewerAction.TOGGLE_SHOW_ALL_ENVS,
    KEY_RIGHT: ViewerAction.SINGLE_STEP,
}
"""Actions by GLFW key code."""

KEY_HELP = (
    ("Space / Right", "pause / single step"),
    ("Enter", "reset"),
    ("- / =", "slower / faster"),
    ("6 / 7", "previous / next env"),
    ("8", "reward plots"),
    ("9 / F9", "debug drawings / of all envs"),
)
"""Keys and their actions, as shown in the window."""
