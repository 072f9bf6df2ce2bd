"""Generate the reference images of MuJoCo's own renderer for our tests. Needs a GL library; the tests do not.

    MUJOCO_GL=egl python tests/make_render_references.py [MODEL ...]

Write tests/data/render/MODEL.npz for each model of render_models.py (all if none is named).
"""

import argparse
import pathlib
import sys

import mujoco
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "envs"), str(ROOT / "tests")]

import render_models  # noqa: E402
import render_references  # noqa: E402

from benchmarks.rendering.reference import ReferenceRenderer  # noqa: E402

# Fewer and smaller than in the live comparison (benchmarks/render_parity.py): together they stay well under 5 MB.
POSES, HEIGHT, WIDTH = 4, 72, 96


def draw(name: str) -> render_references.References:
    """Render one model in its first `POSES` poses."""
    mj_model, camera = render_models.build(name)
    truth, _ = render_models.build(name, truth=True)
    mj_data = mujoco.MjData(mj_model)
    columns: dict[str, list] = {field: [] for field in render_references.References._fields}
    with ReferenceRenderer(truth, HEIGHT, WIDTH, site_groups=render_models.MODELS[name].site_groups) as reference:
        for number in range(POSES):
            render_models.set_pose(mj_model, mj_data, number)
            for field in ("qpos", "mocap_pos", "mocap_quat"):
                columns[field].append(getattr(mj_data, field).copy())
            frame = reference(mj_data, camera)
            for field in ("rgb", "depth", "segmentation"):
                columns[field].append(getattr(frame, field))
    near, far = (mj_model.stat.extent * plane for plane in (mj_model.vis.map.znear, mj_model.vis.map.zfar))
    arrays = {field: np.stack(rows) for field, rows in columns.items() if rows}
    return render_references.References(fingerprint=render_models.fingerprint(mj_model), near=near, far=far, **arrays)


def main() -> None:
    """Write the files and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", metavar="MODEL")
    for name in parser.parse_args().models or render_models.MODELS:
        path = render_references.save(name, draw(name))
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)
    total = sum(path.stat().st_size for path in render_references.FOLDER.glob("*.npz"))
    print(f"all: {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
