"""``python -m jaxrl_vis`` is the command line."""

import sys

from jaxrl_vis.cli import main

sys.exit(main())
