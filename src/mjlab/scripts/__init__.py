"""Commands, one module each: parse arguments and wire objects together, independent of the task.

Commands also run as `python -m mjlab.scripts.<name>`.
"""

import mjlab.cli  # noqa: F401  (prepares threads and Ctrl-C before `python -m` loads a command)
