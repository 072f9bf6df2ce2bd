"""MJX, and the pieces of it that are not public, without the two lines that it prints where Warp is missing."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx._src import collision_driver, constraint, math, sensor, smooth, solver, support

__all__ = ["collision_driver", "constraint", "math", "mjx", "sensor", "smooth", "solver", "support"]
