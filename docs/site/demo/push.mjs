// Push in JavaScript: the task of envs/fetch.py on MuJoCo's WebAssembly module, without drawing. All numbers come from push.json.

const SITE = 6; // mjtObj: mjOBJ_SITE
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const minus = (a, b) => a.map((x, i) => x - b[i]);

/** The simulation of one Push episode. `settings` is the content of push.json, `xml` the MJCF. */
export class Push {
  constructor(mujoco, xml, settings) {
    Object.assign(this, { mujoco, settings });
    this.model = mujoco.MjModel.from_xml_string(xml);
    this.data = new mujoco.MjData(this.model);
    this.site = this.model.site("grip").id;
    this.gripper = this.model.body("gripper").id;
    this.velocity = new mujoco.DoubleBuffer(6);
  }

  /** Starts an episode: object position and orientation [7], goal [3]. Without arguments both are drawn as in the original. */
  reset(objectQpos = this.drawObject(), goal = this.drawGoal()) {
    const { qpos, qvel, object } = this.settings;
    this.mujoco.mj_resetData(this.model, this.data);
    this.data.qpos.set(qpos);
    this.data.qvel.set(qvel);
    this.data.qpos.set(objectQpos, object.qpos);
    Object.assign(this, { goal, steps: 0 });
    this.update();
  }

  /** Applies an action [4] in [-1, 1] for one step of 40 ms. */
  step(action) {
    const { settings, data } = this;
    const [pos, present] = this.gripperPose();
    const quat = present.map((x, i) => x + settings.pointing_down[i]);
    const length = Math.hypot(...quat);
    data.mocap_pos.set(pos.map((x, i) => x + settings.action_scale * Math.fround(action[i])));
    data.mocap_quat.set(quat.map((x) => x / length));
    for (let i = 0; i < settings.substeps; i++) this.mujoco.mj_step(this.model, data);
    this.steps += 1;
    this.update();
  }

  /** Recomputes poses and velocities from qpos and qvel. */
  update() {
    for (const f of ["mj_kinematics", "mj_comPos", "mj_comVel"]) this.mujoco[f](this.model, this.data);
  }

  grip() {
    return [...this.data.site_xpos.subarray(3 * this.site, 3 * this.site + 3)];
  }

  gripperPose() {
    const { data, gripper: i } = this;
    return [[...data.xpos.subarray(3 * i, 3 * i + 3)], [...data.xquat.subarray(4 * i, 4 * i + 4)]];
  }

  achieved() {
    const { object } = this.settings;
    return [...this.data.qpos.subarray(object.qpos, object.qpos + 3)];
  }

  success() {
    return Math.hypot(...minus(this.achieved(), this.goal)) < this.settings.threshold;
  }

  /** The observation [25] that the policy was trained with (docs/environments.md). */
  observation() {
    const { object, dt } = this.settings;
    const qvel = this.data.qvel.subarray(object.qvel, object.qvel + 6);
    this.mujoco.mj_objectVelocity(this.model, this.data, SITE, this.site, this.velocity, 0);
    const gripVel = [...this.velocity.GetView()].slice(3);
    const scaled = (x) => x.map((v) => v * dt);
    const rotation = matrix(this.data.qpos.subarray(object.qpos + 3, object.qpos + 7));
    const spin = rotation.map((row) => dot(row, [...qvel.subarray(3)]));
    const [grip, box] = [this.grip(), this.achieved()];
    return [
      ...[grip, box, minus(box, grip), [0, 0], euler(rotation)],
      ...[minus([...qvel.subarray(0, 3)], gripVel), spin, gripVel, [0, 0]].map(scaled),
    ].flat();
  }

  drawObject() {
    const { object } = this.settings;
    const span = (i) => object.low[i] + Math.random() * (object.high[i] - object.low[i]);
    const middle = object.low.map((x, i) => (x + object.high[i]) / 2);
    let at;
    do at = [span(0), span(1)];
    while (Math.hypot(at[0] - middle[0], at[1] - middle[1]) < object.min_distance);
    return [...at, object.low[2], 1, 0, 0, 0];
  }

  drawGoal() {
    const { low, high } = this.settings.goal;
    return low.map((x, i) => x + Math.random() * (high[i] - x));
  }
}

/** Rotation matrix, three rows, of a quaternion (w, x, y, z). */
function matrix(quat) {
  const length = Math.hypot(...quat);
  const [w, x, y, z] = [...quat].map((v) => v / length);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** Euler angles (a, b, c), rad, of Rx(a) Ry(b) Rz(c). At a right angle b, a is 0, as in the original. */
function euler(m) {
  const cosB = Math.hypot(m[2][2], m[1][2]);
  const b = Math.atan2(m[0][2], cosB);
  if (cosB <= 5e-7) return [0, b, Math.atan2(m[1][0], m[1][1])];
  return [Math.atan2(-m[1][2], m[2][2]), b, Math.atan2(-m[0][1], m[0][0])];
}
