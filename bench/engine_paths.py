"""Both paths of the engine warp beside native, on the models of tests/engine_models.py and on the guide's arm.

    PYTHONPATH=.:tests python bench/engine_paths.py [--allow-cpu]

Prints the largest distance of all coordinates within 8 environment steps of 10 timesteps, of 64 environments under random
controls.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import mujoco
import numpy as np
from engine_models import MODELS, SUBSTEPS, play, start
from timing import print_table

from mjx_dher.envs.engines import make_engine

ARM = Path(__file__).parent.parent / "docs" / "examples" / "arm.xml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--allow-cpu", action="store_true")
    args = parser.parse_args()
    models = {name: mujoco.MjModel.from_xml_string(xml) for name, xml in MODELS.items()}
    models["guide's arm"] = mujoco.MjModel.from_xml_path(str(ARM))
    rows = []
    for name, model in models.items():
        first, controls = start(model, (64,))
        seen = {}
        for path in ("native", "fused", "graph"):
            options = {} if path == "native" else {"path": path, "allow_cpu": args.allow_cpu}
            try:
                engine = make_engine("native" if path == "native" else "warp", model, SUBSTEPS, **options)
            except ValueError:
                continue  # the kernel leaves out a feature
            played = jax.jit(jax.vmap(lambda *given, engine=engine: play(engine, *given)))
            seen[path] = np.asarray(played(first, controls).qpos)
            engine.check()
        native = seen.pop("native")
        for path, qpos in seen.items():
            error = np.abs(qpos - native).max(axis=(1, 2))
            rows.append((name, path, f"{np.median(error):.1e}", f"{error.max():.1e}"))
    print_table(("model", "path", "median distance", "largest"), rows)


if __name__ == "__main__":
    main()
