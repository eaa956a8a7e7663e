"""The viewer in a real browser: headless Chromium, which draws without a GPU."""

import contextlib
import math
import shutil
import threading
import time

import numpy as np
import pytest

from mjx_dher import envs
from mjx_dher.policy import bundled
from mjx_dher.viewer import address, server, sources

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (CHROMIUM and DRIVER), reason="needs chromium and chromedriver (Debian: apt install chromium-driver)"
    ),
]
FLAGS = """
    --headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update
    --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --window-size=1280,800
""".split()  # noqa: SIM905
PATIENCE = 120.0  # s; a page that is drawn without a GPU takes a second a picture on a machine that is busy


def until(condition, what):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"waited in vain: {what}"
        time.sleep(0.1)


@pytest.fixture(scope="module")
def viewer():
    """A viewer that plays Push, in a thread, as the command runs it in the program's own."""
    found = [sources.of_run(name, bundled.FOLDER / name) for name in ("push", "reach")]
    port, ended = address.check("127.0.0.1", 0), threading.Event()
    with server.Viewer(
        found, lambda source: envs.make(source.env, engine="native", num_threads=1), "127.0.0.1", port, 1
    ) as viewer:
        thread = threading.Thread(target=viewer.run, args=(ended.is_set,))
        thread.start()
        yield viewer
        ended.set()
        thread.join()


@contextlib.contextmanager
def chromium(folder, address):
    """A headless browser on a page, with its data in `folder`. The page must log no error."""
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        driver.set_page_load_timeout(PATIENCE)
        driver.get(address)
        yield driver
        assert [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []
    finally:
        driver.quit()


@pytest.fixture(scope="module")
def browser(viewer, tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("chromium"), viewer.address) as driver:
        until(lambda: "Episodes reached" in driver.page_source, "the panel")
        yield driver


def press(browser, text):
    from selenium.webdriver.common.by import By

    path = (By.XPATH, f"//button[normalize-space()='{text}']")
    until(lambda: browser.find_elements(*path), f"the button {text}")
    browser.find_element(*path).click()


def to_pixels(camera, point):
    """Where a point [3] is on the page: (x, y)."""
    forward = camera.look_at - camera.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = np.asarray(point) - camera.position
    depth = offset @ forward
    scale = camera.image_height / 2 / math.tan(camera.fov / 2)
    up = np.cross(right, forward)
    return camera.image_width / 2 + scale * (offset @ right) / depth, camera.image_height / 2 - scale * (offset @ up) / depth


def drag(browser, start, end):
    """Drags with the mouse, in steps, as a hand does."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    actions = ActionBuilder(browser, duration=150)
    pointer = actions.pointer_action
    pointer.move_to_location(round(start[0]) - 3, round(start[1]))
    pointer.move_to_location(*map(round, start))
    pointer.pause(1)
    pointer.pointer_down()
    for part in np.linspace(0, 1, 11)[1:]:
        pointer.move_to_location(*(round(a + part * (b - a)) for a, b in zip(start, end)))
    pointer.pause(0.5)
    pointer.pointer_up()
    actions.perform()


def test_the_page_shows_a_policy_at_play(viewer, browser):
    until(lambda: viewer.player.episodes.attempts > 0, "an episode")
    assert viewer.player.episodes.reached > 0
    until(lambda: "Distance to the goal" in browser.page_source, "the curve")


def test_it_stops_and_goes_on(viewer, browser):
    press(browser, "Pause")
    until(lambda: not viewer.player.playing, "the clock to stop")
    before = viewer.player.clock, viewer.player.episodes.attempts
    time.sleep(1)
    assert (viewer.player.clock, viewer.player.episodes.attempts) == before
    press(browser, "New episode")
    until(lambda: viewer.player.clock == 0, "a new episode")
    press(browser, "Step")
    until(lambda: viewer.player.clock == 1, "one step")
    press(browser, "Play")
    until(lambda: viewer.player.clock > 1, "the clock to go on")


def test_a_dragged_goal_is_reached(viewer, browser):
    """With the mouse, at the handle's arrow along x, which is where its place and the camera's say."""
    press(browser, "Pause")
    until(lambda: not viewer.player.playing, "the clock to stop")
    (client,) = viewer._server.get_clients().values()
    goal = viewer.player.obs["desired_goal"].astype(float)
    middle = np.mean(viewer.player.game.env.goal_bounds, axis=0)
    towards = 0.08 * np.array([np.sign(middle[0] - goal[0]), 0.0, 0.0])  # where it may go
    arrow = goal + np.array([0.11, 0.0, 0.0])
    drag(browser, to_pixels(client.camera, arrow), to_pixels(client.camera, arrow + towards))
    until(lambda: viewer.player.is_own, "the goal to follow the mouse")
    until(lambda: not viewer._held, "the mouse to let go")
    moved = viewer.player.obs["desired_goal"] - goal
    assert moved[0] * towards[0] > 0.03 * 0.08
    np.testing.assert_allclose(moved[1:], 0, atol=1e-4)
    press(browser, "Play")
    until(lambda: viewer.player.own.attempts == 1, "the attempt to end")
    assert viewer.player.own.reached == 1
    assert "Your own:" in browser.page_source


def test_another_policy_brings_its_scene(viewer, browser):
    from selenium.webdriver.common.by import By

    browser.find_element(By.XPATH, "//input[@value='push']").click()
    until(lambda: browser.find_elements(By.XPATH, "//*[@role='option'][normalize-space()='reach']"), "the list")
    browser.find_element(By.XPATH, "//*[@role='option'][normalize-space()='reach']").click()
    until(lambda: viewer.player.game.env.name == "reach", "the other task")
    until(lambda: viewer.player.episodes.reached > 0, "an episode of it")
