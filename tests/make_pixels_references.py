"""Generate the reference images of MuJoCo's own renderer for wrapped environments. Needs a GL library.

    MUJOCO_GL=egl python tests/make_pixels_references.py

Write tests/data/render/NAME.npz for each model of `MODELS`: unchanged, seen by one of its cameras, after random actions.
"""

import dataclasses
import pathlib
import sys

import mujoco
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "envs"), str(ROOT / "tests")]

import render_models  # noqa: E402
import render_references  # noqa: E402

from benchmarks.rendering.reference import ReferenceRenderer  # noqa: E402

POSES, HEIGHT, WIDTH = 3, 72, 96
STEPS = 60  # physics steps of random actions before each pose


@dataclasses.dataclass(frozen=True)
class WrappedModel:
    """Model file of an installed package, with its path in the package and the name of one of its cameras."""

    package: str
    path: str
    camera: str

    def load(self) -> mujoco.MjModel:
        """Load the model."""
        return mujoco.MjModel.from_xml_path(str(render_models.package_folder(self.package).joinpath(self.path)))


MODELS = {
    "wrapped_ant": WrappedModel("brax", "envs/assets/ant.xml", "track"),
    "wrapped_cheetah": WrappedModel("dm_control", "suite/cheetah.xml", "side"),
    "wrapped_walker": WrappedModel("dm_control", "suite/walker.xml", "side"),
}


def draw(model: WrappedModel) -> render_references.References:
    """Render one model in `POSES` poses after random actions."""
    mj_model = model.load()
    # OpenGL draws polygons where a ray caster draws balls, and lights their corners: with fine ones the two mean the same.
    quality = mj_model.vis.quality
    quality.numslices, quality.numstacks, quality.numquads = render_models.SLICES, render_models.STACKS, render_models.QUADS
    quality.offsamples = 0
    mj_data, random = mujoco.MjData(mj_model), np.random.default_rng(0)
    columns: dict[str, list] = {field: [] for field in ("qpos", "rgb", "depth", "segmentation")}
    with ReferenceRenderer(mj_model, HEIGHT, WIDTH) as reference:
        for _ in range(POSES):
            for _ in range(STEPS):
                mj_data.ctrl[:] = random.uniform(-1, 1, mj_model.nu)
                mujoco.mj_step(mj_model, mj_data)
            mujoco.mj_forward(mj_model, mj_data)
            frame = reference(mj_data, model.camera)
            columns["qpos"].append(mj_data.qpos.copy())
            for field in ("rgb", "depth", "segmentation"):
                columns[field].append(getattr(frame, field))
    near, far = (mj_model.stat.extent * plane for plane in (mj_model.vis.map.znear, mj_model.vis.map.zfar))
    return render_references.References(
        fingerprint=0,
        mocap_pos=np.zeros((POSES, 0, 3)),
        mocap_quat=np.zeros((POSES, 0, 4)),
        near=near,
        far=far,
        **{field: np.stack(rows) for field, rows in columns.items()},
    )


def main() -> None:
    """Write the files."""
    for name, model in MODELS.items():
        print(render_references.save(name, draw(model)))


if __name__ == "__main__":
    main()
