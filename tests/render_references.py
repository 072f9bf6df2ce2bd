"""Compact storage of reference images of MuJoCo's own renderer.

One ``.npz`` for each model. Colours are kept exactly. Depth is kept as a 16-bit logarithm between the near and the far plane,
good to 0.01 %, where the comparison allows 0.1 %. Differences of neighbouring pixels are stored, because the compression of
``.npz`` does not exploit the smoothness of images.
"""

import pathlib
from typing import NamedTuple

import numpy as np

FOLDER = pathlib.Path(__file__).parent / "data" / "render"
_STEPS = 65534  # 65535 is the sky


class References(NamedTuple):
    """Images of one model in P poses.

    Attributes:
        fingerprint: Checksum of the rendered model, see `render_models.fingerprint`; 0 if not computed.
        qpos: [P, nq] float64.
        mocap_pos: [P, nmocap, 3] float64.
        mocap_quat: [P, nmocap, 4] float64.
        rgb: [P, H, W, 3] uint8.
        depth: [P, H, W] float32, planar metres.
        segmentation: [P, H, W] int32, see `Frame`.
        near: Distance of the near plane, m.
        far: Distance of the far plane, which is the depth of the sky, m.
    """

    fingerprint: int
    qpos: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
    rgb: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray
    near: float
    far: float


def save(name: str, references: References) -> pathlib.Path:
    """Write a model's images to `FOLDER`, and return the path of the file."""
    near, far = references.near, references.far
    scaled = np.log(references.depth.astype(np.float64) / near) / np.log(far / near)
    depth = np.where(references.segmentation < 0, _STEPS + 1, np.clip(np.rint(scaled * _STEPS), 0, _STEPS)).astype(np.uint16)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{name}.npz"
    packed = {
        "rgb": _differences(np.moveaxis(references.rgb, -1, 1)),
        "depth": _differences(depth),
        "segmentation": _differences(references.segmentation.astype(np.int16)),
    }
    np.savez_compressed(path, **{**references._asdict(), **packed}, allow_pickle=False)
    return path


def load(name: str) -> References:
    """Read a model's images.

    Raises:
        FileNotFoundError: There are none; make_render_references.py generates them.
    """
    path = FOLDER / f"{name}.npz"
    if not path.exists():
        raise FileNotFoundError(f"no references of {name}: run `MUJOCO_GL=egl python tests/make_render_references.py {name}`")
    with np.load(path) as stored:
        fields = {field: stored[field] for field in References._fields}
    near, far = float(fields["near"]), float(fields["far"])
    steps = _sums(fields["depth"])
    depth = near * np.exp(steps / _STEPS * np.log(far / near))
    return References(
        **{
            **fields,
            "fingerprint": int(fields["fingerprint"]),
            "rgb": np.moveaxis(_sums(fields["rgb"]), 1, -1),
            "depth": np.where(steps > _STEPS, far, depth).astype(np.float32),
            "segmentation": _sums(fields["segmentation"]).astype(np.int32),
            "near": near,
            "far": far,
        }
    )


def _differences(planes: np.ndarray) -> np.ndarray:
    """Subtract from each value its left neighbour, modulo the range of the dtype; the left column stays. `_sums` inverts it."""
    return np.diff(planes, axis=-1, prepend=np.zeros_like(planes[..., :1]))


def _sums(differences: np.ndarray) -> np.ndarray:
    return np.cumsum(differences, axis=-1, dtype=differences.dtype)
