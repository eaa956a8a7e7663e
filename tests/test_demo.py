"""The demo page: it is built from npm's packages, its physics is that of `native`, and it plays in headless Chromium."""

import functools
import http.server
import json
import shutil
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest
from conftest import ROOT
from test_browser import CHROMIUM, DRIVER, chromium, until

import mjx_dher
from mjx_dher import envs

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not shutil.which("npm"), reason="needs node and npm")]
PLAY = """
import fs from "fs";
import loadMujoco from "./mujoco.js";
import { Push } from "./push.mjs";
const read = (name) => fs.readFileSync(new URL(name, import.meta.url), "utf8");
const { object, goal, actions } = JSON.parse(read("start.json"));
const env = new Push(await loadMujoco(), read("push.xml"), JSON.parse(read("push.json")));
env.reset(object, goal);
const observations = [env.observation()];
for (const action of actions) { env.step(action); observations.push(env.observation()); }
console.log(JSON.stringify(observations));
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    subprocess.run([sys.executable, ROOT / "docs" / "site" / "demo" / "build.py", out], check=True, timeout=300)
    return out


def test_an_episode_is_that_of_native(page):
    env, policy = envs.make("push", engine="native", num_threads=1), mjx_dher.load_policy("push")
    state, step = env.reset(jax.random.key(3)), jax.jit(env.step)
    start = {"object": state.physics.qpos[env._object_qpos], "goal": state.obs["desired_goal"]}
    actions, observations = [], [state.obs["observation"]]
    for _ in range(50):
        actions.append(policy({name: np.asarray(state.obs[name]) for name in ("observation", "desired_goal")}))
        state = step(state, actions[-1])
        observations.append(state.obs["observation"])
    lists = {name: np.asarray(values).tolist() for name, values in start.items()} | {"actions": np.asarray(actions).tolist()}
    (page / "start.json").write_text(json.dumps(lists))
    (page / "play.mjs").write_text(PLAY)
    (page / "package.json").write_text('{"type": "module"}')
    played = subprocess.run(["node", page / "play.mjs"], check=True, capture_output=True, text=True, timeout=60)
    ours, theirs = np.asarray(observations), np.asarray(json.loads(played.stdout))
    np.testing.assert_allclose(theirs[0], ours[0], atol=1e-5)
    np.testing.assert_allclose(theirs[:, :9], ours[:, :9], atol=1e-3)  # m; float32 against float64 over two seconds
    assert np.linalg.norm(ours[-1, 3:6] - ours[0, 3:6]) > 0.05  # the cube has moved


@pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs chromium and chromedriver")
def test_it_plays_in_a_browser(page, tmp_path):
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=page)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/index.html?episodes=10"
        try:
            with chromium(tmp_path / "chromium", address) as driver:
                until(lambda: driver.execute_script("return document.body.dataset.done"), "ten episodes")
                reached, _, played = driver.find_element("id", "status").text.split()[:3]
                assert (int(reached) >= 8, played) == (True, "10")
        finally:
            server.shutdown()
