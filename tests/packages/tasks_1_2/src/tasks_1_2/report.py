"""Tables and videos, with what comes along with the interface."""

from prettytable import PrettyTable

try:
    import mediapy
    import moviepy
    import torchrunx
except ImportError:
    mediapy = moviepy = torchrunx = None

CAN_RECORD = mediapy is not None and moviepy is not None
CAN_LAUNCH = torchrunx is not None


def rover_summary(speeds: dict[str, float]) -> str:
    table = PrettyTable(field_names=["wheel", "rad/s"])
    table.add_rows([[name, f"{speed:.1f}"] for name, speed in speeds.items()])
    return table.get_string()
