"""What is said where nothing can be drawn."""

from __future__ import annotations

from mjlab.viewer.offscreen_renderer import RenderingUnavailableError


def test_a_missing_egl_is_called_so_and_what_to_install_is_named(monkeypatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    noise = AttributeError("'NoneType' object has no attribute 'eglQueryString'")
    text = str(RenderingUnavailableError.offscreen(noise))
    assert "(MUJOCO_GL=unset): no EGL library or driver was found. " in text
    assert "NoneType" not in text
    assert "apt-get install libegl1 libgl1 libgl1-mesa-dri" in text


def test_another_reason_is_kept_in_one_line() -> None:
    text = str(RenderingUnavailableError.offscreen("Cannot initialize\n  a device."))
    assert "Cannot initialize a device. To render" in text
    assert "apt-get install libegl1 libgl1 libgl1-mesa-dri" in text
