"""``python -m jaxrl_vis`` is the command line."""

from jaxrl_vis.cli import entry

entry()
