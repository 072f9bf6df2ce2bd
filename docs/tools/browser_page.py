"""Write the data of the playable page to build/play: `make page`, before `make docs`.

    vendor/       onnxruntime-web and MuJoCo's WebAssembly, from npm, at the versions and digests below
    policy.onnx   the shipped policy ``fetch``
    task.json     its task: model, start state, scene, inverse kinematics
    golden.json   32 of its frames with our images and actions, and an episode of our physics, for `browser_check.py`

The folder is not committed. The build of the site copies it (`hooks.py`); without it, the page shows a message.
"""

import argparse
import base64
import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxrl_vis
import jaxrl_vis_envs
from jaxrl_vis.run.exported.export import export_run
from jaxrl_vis_envs.physics import inverse_kinematics, mjx_model
from jaxrl_vis_envs.tasks import fetch_arm, fetch_reach

ROOT = Path(__file__).resolve().parents[2]
BUILT = ROOT / "build" / "play"
POLICY = "fetch"
FRAMES, EPISODES = 32, 4
VENDORED = {
    "onnxruntime-web@1.30.0": (
        "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71",
        ("dist/ort.wasm.min.mjs", "dist/ort-wasm-simd-threaded.mjs", "dist/ort-wasm-simd-threaded.wasm"),
    ),
    "@mujoco/mujoco@3.14.0": ("f845a07ab81303cc6579fec07136818bed21d44a31c1911340f61e06f4d11eee", ("mujoco.js", "mujoco.wasm")),
}
"""Package -> SHA-256 of its archive, and the files in it that the page loads."""
LICENCES = """onnxruntime-web: MIT License, Copyright (c) Microsoft Corporation

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated documentation
files (the "Software"), to deal in the Software without restriction, including without limitation the rights to use, copy,
modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit persons to whom the Software
is furnished to do so, subject to the following conditions: The above copyright notice and this permission notice shall be
included in all copies or substantial portions of the Software. THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY
KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND
NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY,
WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR
OTHER DEALINGS IN THE SOFTWARE.

@mujoco/mujoco: Apache License 2.0, DeepMind Technologies Limited

"""


def fetch_packages(folder: Path) -> None:
    """Download `VENDORED` with npm, check the digests, and write the files and their licences to ``folder``.

    Raises:
        SystemExit: npm is missing or fails, or an archive has another digest.
    """
    if shutil.which("npm") is None:
        sys.exit("the page needs npm to fetch onnxruntime-web and @mujoco/mujoco: install Node.js")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "LICENCES.txt").write_text(LICENCES + (ROOT / "LICENSE").read_text())
    for package, (digest, files) in VENDORED.items():
        with tempfile.TemporaryDirectory() as temporary:
            done = subprocess.run(["npm", "pack", package, "--silent"], cwd=temporary, capture_output=True, text=True)
            archives = list(Path(temporary).glob("*.tgz"))
            if done.returncode or len(archives) != 1:
                sys.exit(f"npm cannot fetch {package}: {done.stderr.strip()[-300:]}")
            actual = hashlib.sha256(archives[0].read_bytes()).hexdigest()
            if actual != digest:
                sys.exit(f"{package} has the digest {actual}, not {digest}: nothing of it is used")
            with tarfile.open(archives[0]) as archive:
                for file in files:
                    member = archive.extractfile(f"package/{file}")
                    assert member is not None
                    (folder / Path(file).name).write_bytes(member.read())


def describe_scene(scene: Any, moves: np.ndarray) -> dict[str, Any]:
    """Return the objects, camera and lights of a scene as JSON values.

    Args:
        scene: The scene.
        moves: [ngeom] bool, geoms that joints move.

    Raises:
        ValueError: The scene has something that renderer.js does not render.
    """
    plain = scene.headlight and not any((*scene.light_highlights, *scene.light_shadows, *scene.transparent))
    directional = all(kind == 1 for kind in scene.light_types) and scene.camera_mount.mode == 0 == scene.camera_mount.body
    bare = not any(scene.atlas.mappings) and scene.haze[0] < 0 and scene.sky == "plain"
    if not (plain and directional and bare and scene.projection == "perspective" and not np.any(scene.sky_top)):
        raise ValueError("the page draws shapes without textures, shadows, highlights and sky, from a camera at rest")
    objects = [
        {
            "geom": geom,
            "kind": int(kind),
            "moves": bool(moves[geom]),
            "size": scene.size[geom].tolist(),
            "rgba": scene.rgba[geom].tolist(),
            "emission": float(scene.emission[geom]),
        }
        for geom, kind in zip(scene.object_ids, scene.object_types, strict=True)
    ]
    lights = [
        {
            "direction": scene.light_direction[i].tolist(),
            "ambient": scene.light_ambient[i].tolist(),
            "diffuse": diffuse.tolist(),
        }
        for i, diffuse in enumerate(scene.light_diffuse)
    ]
    camera = {"position": scene.camera_position.tolist(), "axes": scene.camera_axes.tolist(), "fovy": float(scene.fovy)}
    headlight = {"ambient": scene.headlight_ambient.tolist(), "diffuse": scene.headlight_diffuse.tolist()}
    ends = {"znear": float(scene.znear), "zfar": float(scene.zfar), "size": int(scene.height)}
    return {"objects": objects, "lights": lights, "headlight": headlight, "camera": camera, **ends}


def describe_task(env: Any) -> dict[str, Any]:
    """Return the model, start state, goals, inverse kinematics and scene of VisualFetchReach as JSON values."""
    mj_model, start = env.mj_model, env.sample_start(jax.random.key(0))
    hand, grip = mj_model.body("gripper").id, mj_model.site("grip").id
    chain = mjx_model.ancestor_joints(mj_model, hand)
    fingertip = mj_model.geom("right_fingertip").id
    low, high = env.goal_box
    limited = mj_model.jnt_limited.astype(bool)[:, None]
    return {
        "xml": (Path(fetch_reach.__file__).parent / "assets" / "fetch_reach.xml").read_text(),
        "iterations": int(mj_model.opt.iterations),
        "timestep": float(mj_model.opt.timestep),
        "substeps": env.config.substeps,
        "control_period": float(env.control_period),
        "horizon": env.horizon,
        "threshold": env.threshold,
        "depth_range": list(env.config.depth_range),
        "action_scale": env.config.action_scale,
        "start": {name: np.asarray(getattr(start, name), float).ravel().tolist() for name in _STATE},
        "hand": hand,
        "grip": grip,
        "fingers": env._fingers.tolist(),
        "down": list(fetch_arm._DOWN),
        "goal_box": [np.asarray(low, float).tolist(), np.asarray(high, float).tolist()],
        "grip_offset": (fetch_reach._DOWN_ROTATION @ mj_model.site_pos[grip]).tolist(),
        "lowest": fetch_reach._TABLE_TOP + float(mj_model.geom_pos[fingertip, 0] + mj_model.geom_size[fingertip, 0]),
        "rotation": fetch_reach._DOWN_ROTATION.tolist(),
        "damping": list(inverse_kinematics._DAMPING),
        "chain": np.flatnonzero(chain).tolist() if np.asarray(chain).dtype == bool else np.asarray(chain).tolist(),
        "mobility": (mj_model.dof_damping[chain].max() / mj_model.dof_damping).tolist(),
        "ranges": np.where(limited, mj_model.jnt_range, [-1e9, 1e9]).tolist(),
        "scene": describe_scene(env.scene, mj_model.body_weldid[mj_model.geom_bodyid] != 0),
    }


_STATE = ("qpos", "qvel", "mocap_pos", "mocap_quat", "qacc_warmstart")


def record_golden(policy: Any) -> dict[str, Any]:
    """Roll out `EPISODES` episodes of a policy.

    Returns:
        JSON values: ``frames``, `FRAMES` of them with poses, images (base64) and actions; and ``actions`` and ``grips``, the
        actions and grip positions (m) of the first episode.
    """
    env = policy.env

    def play(key: jax.Array) -> Any:
        goal_data = env.sample_goal(key)
        state = env.state_at(env.sample_start(key), env.goal_state(key, goal_data))
        goal = env.observe(state.replace(data=goal_data))

        def step(state: Any, _: None) -> Any:
            seen = env.observe(state)
            action = policy(seen, goal)
            after = env.advance(state, action)
            return after, (state.data.qpos, seen, action, after.achieved_state)

        return jax.lax.scan(step, state, length=env.horizon)[1], goal, state.goal_state, goal_data.qpos

    (qpos, seen, actions, grips), goals, points, goal_qpos = jax.device_get(
        jaxrl_vis_envs.jit(jax.vmap(play))(jax.random.split(jax.random.key(59), EPISODES))
    )
    frames = []
    for number in range(FRAMES):
        episode, step = number % EPISODES, (number // EPISODES) * env.horizon // (FRAMES // EPISODES)
        frames.append(
            {
                "qpos": qpos[episode, step].tolist(),
                "image": base64.b64encode(seen[episode, step].tobytes()).decode(),
                "goal": base64.b64encode(goals[episode].tobytes()).decode(),
                "point": points[episode].tolist(),
                "goal_qpos": goal_qpos[episode].tolist(),
                "action": actions[episode, step].tolist(),
            }
        )
    return {"frames": frames, "actions": actions[0].tolist(), "grips": grips[0].tolist()}


def main() -> None:
    """Write the data of the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=BUILT)
    out: Path = parser.parse_args().out
    fetch_packages(out / "vendor")
    policy = jaxrl_vis.load_policy(POLICY)
    (out / "task.json").write_text(json.dumps(describe_task(policy.env)))
    (out / "golden.json").write_text(json.dumps(record_golden(policy)))
    with tempfile.TemporaryDirectory() as temporary:
        print(export_run(POLICY, "onnx", Path(temporary) / "onnx"))
        shutil.copyfile(Path(temporary) / "onnx" / "policy.onnx", out / "policy.onnx")
    print(f"{out}: {sum(file.stat().st_size for file in out.rglob('*') if file.is_file()) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
