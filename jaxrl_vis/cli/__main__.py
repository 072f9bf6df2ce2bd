"""``python -m jaxrl_vis.cli``."""

import sys

from jaxrl_vis.cli import main

sys.exit(main())
