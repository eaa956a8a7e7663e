"""Steps any MuJoCo model by MuJoCo C on all cores, inside a compiled JAX program. Here a figure falls and kicks.

python docs/examples/any_model.py
"""

import argparse

import jax
import mujoco

from mjx_dher.envs import Simulator

FIGURE = """
<mujoco model="figure">
  <option timestep="0.004"/>
  <default><geom type="capsule" size="0.05"/><joint range="-60 60" limited="true" damping="1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="torso" pos="0 0 1.0">
      <freejoint/>
      <geom fromto="0 0 -0.2 0 0 0.2" size="0.09"/>
      <geom name="head" type="sphere" pos="0 0 0.35" size="0.1"/>
      <body name="left_thigh" pos="0 0.1 -0.25">
        <joint name="left_hip" axis="0 1 0"/><geom fromto="0 0 0 0 0 -0.35"/>
        <body name="left_shin" pos="0 0 -0.4"><joint name="left_knee" axis="0 1 0"/><geom fromto="0 0 0 0 0 -0.3"/></body>
      </body>
      <body name="right_thigh" pos="0 -0.1 -0.25">
        <joint name="right_hip" axis="0 1 0"/><geom fromto="0 0 0 0 0 -0.35"/>
        <body name="right_shin" pos="0 0 -0.4"><joint name="right_knee" axis="0 1 0"/><geom fromto="0 0 0 0 0 -0.3"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="left_hip" gear="40"/><motor joint="left_knee" gear="40"/>
    <motor joint="right_hip" gear="40"/><motor joint="right_knee" gear="40"/>
  </actuator>
</mujoco>
"""


def main(argv=None):
    """Prints the heights of many figures after random kicks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100, help="steps of five timesteps each")
    args = parser.parse_args(argv)
    model = mujoco.MjModel.from_xml_string(FIGURE)
    sim = Simulator(model, derived=["subtree_com"], substeps=5)

    @jax.jit
    def play(key):
        def start(key):
            data = sim.make_data()
            return data.replace(qvel=data.qvel + 0.1 * jax.random.normal(key, data.qvel.shape))

        def step(data, key):
            ctrl = jax.random.uniform(key, (args.num_envs, model.nu), minval=-1, maxval=1)
            return jax.vmap(sim.step)(data, ctrl), None

        data = jax.vmap(start)(jax.random.split(key, args.num_envs))
        data, _ = jax.lax.scan(step, data, jax.random.split(key, args.steps))
        return jax.vmap(sim.forward)(data)  # updates the centre of mass to the last state

    data = play(jax.random.key(0))
    height = data.derived["subtree_com"][:, 1, 2]  # [num_envs] m, of the torso and the bodies below it
    print(f"after {float(data.time[0]):.2f} s the centre of mass is {height.mean():.2f} m high, {height.max():.2f} m at most")


if __name__ == "__main__":
    main()
