"""What every MJX task needs: loading its model, and states without weak types."""

import contextlib
import io
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

with contextlib.redirect_stdout(io.StringIO()):  # it prints, twice, that Warp is missing, which nothing here needs
    from mujoco import mjx

_ASSETS = pathlib.Path(__file__).parent / "assets"


def load_model(file_name: str) -> mujoco.MjModel:
    """The MuJoCo model of ``tasks/assets/<file_name>``."""
    return mujoco.MjModel.from_xml_path(str(_ASSETS / file_name))


def start_data(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> mjx.Data:
    """`mjx.put_data`, with a strong type on every array.

    A weakly typed ``time`` changes its type in the first step, so that everything compiles twice (mujoco issue 2306).
    """
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), mjx.put_data(mj_model, mj_data))


def simulate(model: mjx.Model, data: mjx.Data, substeps: int) -> mjx.Data:
    """``substeps`` physics steps, after which every pose belongs to the final ``qpos``.

    `mjx.step` leaves the poses of the state *before* its last integration, so one more `mjx.kinematics` is needed for the
    picture, the true state and ``qpos`` to agree.
    """

    def substep(data: mjx.Data, _: Any) -> tuple[mjx.Data, None]:
        return mjx.step(model, data), None

    # Accelerators multiply float32 matrices with ten bits of mantissa unless they are told not to.
    with jax.default_matmul_precision("highest"):
        data, _ = jax.lax.scan(substep, data, length=substeps)
        return mjx.kinematics(model, data)


def point_velocity(data: mjx.Data, point: jax.Array) -> jax.Array:
    """Velocity of a ``point`` [3] (m, world) that moves with the last link of a chain of hinges: [3] float32, m/s.

    Valid where every joint of the model is a hinge that carries the point.
    """
    return data.qvel @ hinge_jacobian(data, point)


def hinge_jacobian(data: mjx.Data, point: jax.Array) -> jax.Array:
    """Change of a ``point`` [3] (m, world) per radian of each hinge: [nv, 3] float32, m/rad; conditions of `point_velocity`."""
    return jnp.cross(data.xaxis, point - data.xanchor)
