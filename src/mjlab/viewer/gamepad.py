"""Gamepad of a browser: a page around the viewer's page that reads it, and the requests that it sends.

Browsers show gamepads to scripts only, and viser's page runs no script of its users. The page here shows
viser's in a frame and sends the position of the sticks, when it changes, as a request
`/gamepad?forward=0.5&left=0&turn=-0.25`.
"""

from __future__ import annotations

from urllib.parse import parse_qs

PATH = "/gamepad"

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>mjlab with gamepad</title>
<style>
  html, body, iframe { margin: 0; border: 0; width: 100%; height: 100%; overflow: hidden }
  p { position: fixed; left: 1em; bottom: 0; font: 14px sans-serif; color: #555 }
</style>
<iframe src="/" title="viewer"></iframe>
<p>Press a button of the gamepad.</p>
<script>
  const DEAD_ZONE = 0.1, PERIOD_MS = 50;
  const help = document.querySelector("p");
  let sent = "forward=0&left=0&turn=0";

  // Rescaled, so that the command starts at zero at the edge of the dead zone.
  function share(axis) {
    const size = Math.max(0, Math.abs(axis) - DEAD_ZONE) / (1 - DEAD_ZONE);
    return Math.round(-100 * Math.sign(axis) * Math.min(1, size)) / 100 || 0;
  }

  async function poll() {
    const pad = [...navigator.getGamepads()].find((pad) => pad?.connected);
    if (pad) help.textContent = `${pad.id}: left stick to move, right stick to turn.`;
    // A robot whose gamepad is gone stops.
    const axes = pad && !document.hidden ? pad.axes : [0, 0, 0];
    const query = `forward=${share(axes[1])}&left=${share(axes[0])}&turn=${share(axes[2])}`;
    if (query !== sent) {
      const answer = await fetch(`/gamepad?${query}`).catch(() => null);
      if (answer?.ok) sent = query;
      else help.textContent = answer ? await answer.text() : "The viewer has ended.";
    }
    setTimeout(poll, PERIOD_MS);
  }
  if (navigator.getGamepads) poll();
  else help.textContent = "Browsers show gamepads to https pages and to localhost only; use ssh -L.";
</script>
</html>
"""


def stick_position(query: str) -> tuple[float, float, float]:
    """Return (forward, left, turn left), each in [-1, 1], of the query of a request.

    Raises:
        ValueError: one of the three is missing or no number in [-1, 1].
    """
    fields = parse_qs(query)
    forward, left, turn = (float(fields.get(name, [""])[0]) for name in ("forward", "left", "turn"))
    # NaN is outside, too.
    if not all(-1.0 <= share <= 1.0 for share in (forward, left, turn)):
        raise ValueError(f"gamepad: expected shares in [-1, 1], got {query!r}.")
    return forward, left, turn
