"""Builds the demo page: the bundled Push policy plays in the browser, without a server.

    python docs/site/demo/build.py OUT

OUT gets the page, the policy as ONNX, the MJCF, the task's numbers, and MuJoCo, onnxruntime-web and three.js from npm. It
needs node and npm and, as `python train.py export` does, onnx. The folder OUT can be served by any web server.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_dher import cli
from mjx_dher.cli.settings import check_writable
from mjx_dher.envs import fetch
from mjx_dher.system.files import FolderError

HERE = Path(__file__).parent
PAGE = ("index.html", "demo.mjs", "push.mjs")
LIBRARIES = (
    *("@mujoco/mujoco/mujoco.js", "@mujoco/mujoco/mujoco.wasm", "three/build/three.module.js", "three/build/three.core.js"),
    *(f"onnxruntime-web/dist/{name}" for name in ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs")),
    "onnxruntime-web/dist/ort-wasm-simd-threaded.wasm",
    "three/examples/jsm/controls/OrbitControls.js",
)


def settings(env: fetch.FetchEnv) -> dict[str, object]:
    """The task's numbers as JSON."""
    state, model, task = env.init_state(jnp.zeros(7).at[3].set(1.0), jnp.zeros(3)), env.model, env.task
    return {
        "qpos": np.asarray(state.physics.qpos, float).tolist(),
        "qvel": np.asarray(state.physics.qvel, float).tolist(),
        "object": {
            "qpos": int(model.joint("object").qposadr[0]),
            "qvel": int(model.joint("object").dofadr[0]),
            "low": task.object_bounds[0].tolist(),
            "high": task.object_bounds[1].tolist(),
            "min_distance": task.min_object_distance,
        },
        "goal": dict(zip(("low", "high"), task.goal_bounds.tolist(), strict=True)),
        "pointing_down": fetch.POINTING_DOWN.tolist(),
        "action_scale": fetch.ACTION_SCALE,
        "substeps": fetch.SUBSTEPS,
        "dt": fetch.DT,
        "threshold": env.distance_threshold,
        "episode_length": env.spec.episode_length,
    }


def install(out: Path) -> None:
    """Copies the libraries from npm into `out`."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(HERE / "package.json", folder)
        quiet = ("--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts", "--silent")
        subprocess.run(["npm", "install", *quiet], cwd=folder, check=True)
        for name in LIBRARIES:
            shutil.copy(Path(folder) / "node_modules" / name, out)


def main() -> None:
    """Builds the page into the folder on the command line."""
    if len(sys.argv) != 2 or not sys.argv[1]:
        raise SystemExit(__doc__)
    out = Path(sys.argv[1])
    try:
        check_writable(out)
    except FolderError as error:
        raise SystemExit(f"error: {error}") from None
    if shutil.which("npm") is None:
        raise SystemExit("error: npm is missing; the demo page needs node and npm")
    out.mkdir(parents=True, exist_ok=True)
    env = fetch.Push(engine="native", num_threads=1)
    mujoco.mj_saveLastXML(str(out / "push.xml"), env.load())
    (out / "push.json").write_text(json.dumps(settings(env), indent=1) + "\n")
    if cli.main(["export", "push", "--format", "onnx", "--out", str(out / "push.onnx"), "--overwrite"]):
        raise SystemExit("the policy was not exported")
    for name in PAGE:
        shutil.copy(HERE / name, out)
    install(out)
    print(f"the demo is in {out}; any web server can serve it: python -m http.server --directory {out}")


if __name__ == "__main__":
    main()
