"""Entry point of ``python -m jaxrl_vis``: the command line."""

from jaxrl_vis.cli import entry

entry()
