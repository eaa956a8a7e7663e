// The demo page: loads MuJoCo, the policy and the task, plays episodes and draws them.

import * as ort from "./ort.wasm.min.mjs";
import * as THREE from "three";
import { OrbitControls } from "./OrbitControls.js";
import loadMujoco from "./mujoco.js";
import { Push } from "./push.mjs";

ort.env.wasm.numThreads = 1; // more would need special headers from the server
ort.env.wasm.wasmPaths = new URL(".", import.meta.url).href;

const read = async (name, how) => (await fetch(new URL(name, import.meta.url)))[how]();
const say = (text) => (document.getElementById("status").textContent = text);

/** Loads everything that an episode needs. */
async function load() {
  const [mujoco, xml, settings, policy] = await Promise.all([
    loadMujoco(),
    read("push.xml", "text"),
    read("push.json", "json"),
    ort.InferenceSession.create(new URL("push.onnx", import.meta.url).href),
  ]);
  const act = async (env) => {
    const tensor = (values) => new ort.Tensor("float32", Float32Array.from(values), [1, values.length]);
    const feeds = { observation: tensor(env.observation()), desired_goal: tensor(env.goal) };
    return [...(await policy.run(feeds)).action.data];
  };
  return { env: new Push(mujoco, xml, settings), act, length: settings.episode_length };
}

const SHAPES = {
  0: () => new THREE.PlaneGeometry(20, 20),
  2: ([r]) => new THREE.SphereGeometry(r, 24, 16),
  3: ([r, half]) => new THREE.CapsuleGeometry(r, 2 * half, 8, 16).rotateX(Math.PI / 2),
  5: ([r, half]) => new THREE.CylinderGeometry(r, r, 2 * half, 24).rotateX(Math.PI / 2),
  6: ([x, y, z]) => new THREE.BoxGeometry(2 * x, 2 * y, 2 * z),
}; // by mjtGeom

/** Draws the model's geoms and the goal. */
class Scene {
  constructor(env, canvas) {
    this.env = env;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color(0xe8edf2);
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.05, 20);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(2.3, 0.05, 1.2);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.target.set(1.25, 0.75, 0.45);
    const sun = new THREE.DirectionalLight(0xffffff, 2);
    sun.position.set(2, -1, 4);
    sun.castShadow = true;
    this.scene.add(sun, new THREE.HemisphereLight(0xffffff, 0x888888, 1.5));
    this.geoms = [];
    for (let i = 0; i < env.model.ngeom; i++) this.addGeom(i);
    this.goal = new THREE.Mesh(
      new THREE.SphereGeometry(0.02, 24, 16),
      new THREE.MeshStandardMaterial({ color: 0xd62728, transparent: true, opacity: 0.7 }),
    );
    this.scene.add(this.goal);
  }

  addGeom(i) {
    const { model } = this.env;
    const shape = SHAPES[model.geom_type[i]];
    const [r, g, b, opacity] = model.geom_rgba.subarray(4 * i, 4 * i + 4);
    if (!shape || opacity === 0) return;
    const color = new THREE.Color(r, g, b);
    const mesh = new THREE.Mesh(shape([...model.geom_size.subarray(3 * i, 3 * i + 3)]), new THREE.MeshStandardMaterial({ color }));
    mesh.castShadow = mesh.receiveShadow = true;
    mesh.matrixAutoUpdate = false;
    this.geoms.push([i, mesh]);
    this.scene.add(mesh);
  }

  draw() {
    const { data, goal } = this.env;
    this.env.mujoco.mj_kinematics(this.env.model, data);
    for (const [i, mesh] of this.geoms) {
      const [p, m] = [data.geom_xpos.subarray(3 * i, 3 * i + 3), data.geom_xmat.subarray(9 * i, 9 * i + 9)];
      mesh.matrix.set(m[0], m[1], m[2], p[0], m[3], m[4], m[5], p[1], m[6], m[7], m[8], p[2], 0, 0, 0, 1);
    }
    this.goal.position.set(...goal);
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.renderer.render(this.scene, this.camera);
  }
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Plays `count` episodes without drawing and returns how many ended at the goal. */
async function measure({ env, act, length }, count) {
  let reached = 0;
  for (let i = 0; i < count; i++) {
    env.reset();
    while (env.steps < length) env.step(await act(env));
    reached += env.success();
  }
  return reached;
}

async function main() {
  const parts = await load();
  const { env, act, length } = parts;
  const count = Number(new URLSearchParams(location.search).get("episodes") ?? 0);
  if (count > 0) {
    say(`${await measure(parts, count)} of ${count} episodes reached the goal`);
    document.body.dataset.done = "true";
    return;
  }
  env.reset();
  const scene = new Scene(env, document.getElementById("scene"));
  document.getElementById("again").onclick = () => env.reset();
  const draw = () => {
    scene.draw();
    requestAnimationFrame(draw);
  };
  draw();
  let [played, reached] = [0, 0];
  for (;;) {
    const began = performance.now();
    env.step(await act(env));
    if (env.steps >= length) {
      played += 1;
      reached += env.success();
      env.reset();
    }
    say(`${reached} of ${played} episodes reached the goal`);
    await pause(Math.max(0, 1000 * env.settings.dt - (performance.now() - began)));
  }
}

main().catch((error) => say(`The demo cannot run in this browser: ${error.message ?? error}`));
