"""Models that have nothing of a Fetch robot, and how to play them: for tests and benchmarks of engines."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_dher.envs.engines import Controls, Physics

SUBSTEPS = 10


def arm():
    """Six joints with position servos, a tool, and a cube on the floor; contacts by contype and conaffinity."""
    links = [("0 0 0.1", "0 0 1"), ("0 0 0.2", "0 1 0"), ("0.3 0 0", "0 1 0"), ("0.3 0 0", "1 0 0"), ("0.1 0 0", "0 1 0")]
    body = '<body pos="{}"><joint name="j{}" axis="{}" range="-2 2" damping="2" armature="0.1"/><geom fromto="0 0 0 0.08 0 0"/>'
    chain = "".join(body.format(pos, number, axis) for number, (pos, axis) in enumerate(links))
    tool = '<body pos="0.08 0 0"><joint name="j5" axis="1 0 0" damping="2"/><geom type="box" size=".02 .02 .04"/></body>'
    servos = "".join(f'<position joint="j{number}" kp="50" ctrlrange="-2 2"/>' for number in range(6))
    return f"""
<mujoco>
  <default><geom type="capsule" size="0.03" contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom type="plane" size="3 3 0.1" contype="1" conaffinity="1"/>
    <body pos="0.5 0 0.03"><freejoint/><geom type="box" size="0.03 0.03 0.03" contype="1" conaffinity="1" mass="0.2"/></body>
    {chain}{tool}{"</body>" * 5}
  </worldbody>
  <actuator>{servos}</actuator>
</mujoco>"""


BODY = '<body pos="{0} 0 1" name="{1}"><freejoint/><geom type="box" size="0.1 0.05 0.08"/></body>'
MODELS = {
    "arm": arm(),
    "activations, implicitfast": """
<mujoco><option integrator="implicitfast"/>
<worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/>
<body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body></body></worldbody>
<actuator><general joint="a" dyntype="filter" dynprm="0.1" gainprm="5"/><motor joint="b" gear="2"/>
<intvelocity joint="b" kp="3" actrange="-1 1"/></actuator></mujoco>""",
    "two mocap bodies": f"""
<mujoco><worldbody><body name="left" mocap="true"/><body name="right" mocap="true" pos="1 0 1"/>
{BODY.format(0, "l")}{BODY.format(1, "r")}{BODY.format(2, "held")}</worldbody>
<equality><weld body1="right" body2="r" relpose="0 0 0 1 0 0 0"/><connect body1="held" body2="world" anchor="0 0 0"/>
<weld body1="left" body2="l" relpose="0 0 0 1 0 0 0"/></equality></mujoco>""",
    "fingers": """
<mujoco><option cone="elliptic" noslip_iterations="2"/>
<default><joint frictionloss="0.01" damping="0.1" range="0 1.5"/><geom type="capsule" size="0.01" condim="4"/></default>
<worldbody><geom name="floor" type="plane" size="1 1 0.1"/><body name="egg" pos="0.03 0 0.04"><freejoint/>
<geom type="ellipsoid" size="0.02 0.03 0.02" condim="6"/></body>
<body pos="0 0 0.1"><joint name="a" axis="0 1 0"/><geom name="one" fromto="0 0 0 0.06 0 0"/>
<body pos="0.06 0 0"><joint name="b" axis="0 1 0"/><joint name="c" axis="0 0 1" range="-1 1"/>
<geom name="two" fromto="0 0 0 0.05 0 0"/>
</body></body></worldbody>
<tendon><fixed name="pull" limited="true" range="0 2"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
<equality><joint joint1="c" joint2="b" polycoef="0 0.2 0 0 0"/></equality>
<actuator><position tendon="pull" kp="1" ctrlrange="0 2" forcerange="-1 1"/>
<motor joint="c" gear="-0.1" ctrlrange="-1 1"/></actuator>
</mujoco>""",
    "nothing but a ball": '<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>',
}


def start(model, batch=()):
    """The model's first state and random controls [*batch, 8]."""
    rng = np.random.default_rng(0)
    mocap = np.concatenate([np.zeros((model.nmocap, 3)), np.tile([1.0, 0, 0, 0], (model.nmocap, 1))], axis=1)
    mocap[:, 2], mocap[:, 0] = 1, range(model.nmocap)
    ctrl = rng.uniform(-1, 1, (*batch, 8, model.nu))
    poses = np.broadcast_to(mocap, (*batch, 8, *mocap.shape)) + rng.uniform(-0.1, 0.1, (*batch, 8, *mocap.shape))
    arrays = (model.qpos0, *(np.zeros(size) for size in (model.nv, model.nv, model.na)))
    physics = Physics(*(jnp.asarray(x, jnp.float32) for x in arrays))
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape)), physics)
    return many, Controls(ctrl=jnp.asarray(ctrl, jnp.float32), mocap=jnp.asarray(poses, jnp.float32))


def play(engine, physics, controls):
    """Physics after each of 8 steps."""

    def step(physics, controls):
        physics = engine.advance(physics, controls)
        return physics, physics

    return jax.lax.scan(step, physics, controls)[1]
