"""Peak memory of one training run over the number of environments.

    python bench/memory_use.py [--env push] [--engine auto] [--preset gpu] [--num-envs 512 2048 8192]

Each row is a separate program that trains one epoch of one cycle. On a GPU: the peak of JAX's allocator, and Warp's memory. On
a CPU: the peak of the whole program.
"""

import argparse
import json
import resource
import sys
from typing import Any

from mjx_dher import presets
from mjx_dher.contract import env_spec
from mjx_dher.system import subprocesses

MEASURE = "measure"  # argument of the programs that this one starts


def measure(env: str, engine: str, preset: str, num_envs: str) -> list[str]:
    """Sizes of the replay ring and of the peaks, in this program."""
    import dataclasses

    import jax

    from mjx_dher import envs, learners, samplers, trainer
    from mjx_dher.runs.loop import train
    from mjx_dher.system.machine import format_bytes

    spec = presets.preset(preset, env)
    config = dataclasses.replace(
        spec.config, num_envs=int(num_envs), cycles_per_epoch=1, updates_per_cycle=100, target_period=1
    )
    environment = envs.make(env, engine=engine)
    program = trainer.make_train(environment, config)
    learner = learners.make(spec.learner, config, env_spec(environment), spec.networks)
    run: Any = train(environment, config, spec.hparams, sampler=samplers.make("weighted"), learner=learner)
    next(run)
    run.close()
    found = [format_bytes(program.replay_bytes)]
    stats = jax.devices()[0].memory_stats()
    if stats is None:
        return [*found, format_bytes(1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)]
    import warp

    return [*found, format_bytes(stats["peak_bytes_in_use"]), format_bytes(warp.get_mempool_used_mem_high("cuda:0"))]


def main() -> None:
    import jax
    from timing import print_table

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["push"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default=presets.machine_preset())
    parser.add_argument("--num-envs", type=int, nargs="+", default=[512, 2048, 8192])
    args = parser.parse_args()
    rows = []
    # This program and the measured ones share the device.
    environ = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    for env in args.env:
        for num_envs in args.num_envs:
            command = [sys.executable, __file__, MEASURE, env, args.engine, args.preset, str(num_envs)]
            answer = subprocesses.ask(command, environ)
            if answer.failure:
                sys.exit(f"{' '.join(command)} failed:\n{answer.err.strip() or answer.failure}")
            rows.append((env, num_envs, *answer.last_json()))
    on_gpu = jax.default_backend() != "cpu"
    print_table(("task", "num_envs", "of it: replay ring", *(("JAX, peak", "Warp, peak") if on_gpu else ("peak",))), rows)


if __name__ == "__main__":
    if sys.argv[1:2] == [MEASURE]:
        print(json.dumps(measure(*sys.argv[2:])))
    else:
        main()
