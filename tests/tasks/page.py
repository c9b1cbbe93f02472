"""Stand-in for a page of the browser viewer that simulates user input."""

from __future__ import annotations

from types import SimpleNamespace


class Widget:
    """Control or handle of a page."""

    def __init__(self, value=None, low=None, high=None, disabled=False):
        self.value, self.min, self.max, self.disabled = value, low, high, disabled
        self.position, self.content = (0.0, 0.0, 0.0), ""
        self.wxyz = (1.0, 0.0, 0.0, 0.0)
        self.callbacks = []

    def on_update(self, callback):
        self.callbacks.append(callback)
        return callback

    on_click = on_update

    def by_person(self, **values) -> None:
        """Simulate user input in the browser."""
        for name, value in values.items():
            setattr(self, name, value)
        for callback in self.callbacks:
            callback(SimpleNamespace(client=object(), target=self))

    def set_by_person(self, value=None) -> None:
        self.by_person(value=value)


class Page:
    """Page that stores its widgets by label."""

    def __init__(self):
        self.gui = self.scene = self
        self.widgets = {}

    def add_folder(self, name, **_):
        self.widgets[name] = None
        return self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def add_slider(self, label, low, high, step, value, disabled=False, **_):
        assert low <= value <= high
        return self._add(label, Widget(value, low, high, disabled))

    def add_checkbox(self, label, value, disabled=False, **_):
        return self._add(label, Widget(value, disabled=disabled))

    def add_dropdown(self, label, options, *, initial_value, disabled=False, **_):
        return self._add(label, Widget(initial_value, disabled=disabled))

    def add_button(self, label, disabled=False, **_):
        return self._add(label, Widget(disabled=disabled))

    def add_markdown(self, content):
        return self._add("table", Widget())

    def add_transform_controls(self, name, **_):
        return self._add(name, Widget())

    def _add(self, label, widget):
        self.widgets[label] = widget
        return widget
