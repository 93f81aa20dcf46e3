"""The page in a real browser: it loads without errors, a click or a key shows a design, limits and downloads work.

Debian's chromium and chromium-driver (which `./dev test` installs where it may) and selenium; skipped where one lacks.
"""

from __future__ import annotations

import base64
import io
import os
import shutil
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from synthetic_run import SyntheticRun, synthetic_record, synthetic_run

from finqd.design import Design
from finqd.export import gripper_parts
from finqd.report import write_report

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed (pip install selenium)")
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no chromium and chromedriver (apt-get install chromium chromium-driver)"
)
ALWAYS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--window-size=1400,1000",
)
WITH_WEBGL, WITHOUT = ("--enable-unsafe-swiftshader",), ("--disable-3d-apis",)
PIXELS = "document.getElementById('viewer').toDataURL()"
HOSTILE = '<img src=x onerror="document.title=1">'


class Browser:
    """A headless Chromium that keeps what the page complains of."""

    def __init__(self, folder, switches):
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for switch in (*ALWAYS, *switches, f"--user-data-dir={folder / 'profile'}"):
            options.add_argument(switch)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        options.add_experimental_option("prefs", {"download.default_directory": str(folder / "downloads")})
        self.downloads = folder / "downloads"
        self.driver = webdriver.Chrome(options=options, service=Service(DRIVER))

    def open(self, page, anchor=""):
        self.driver.get("about:blank")
        self.driver.get(page.as_uri() + anchor)
        return self

    def errors(self):
        """Return what the console holds but for the software renderer's own remarks on its speed."""
        return [e for e in self.driver.get_log("browser") if "GL Driver Message" not in e["message"]]

    def script(self, text, *arguments):
        return self.driver.execute_script(f"return {text}", *arguments)

    def text(self, css):
        return self.driver.find_element(By.CSS_SELECTOR, css).text

    def all(self, css):
        return self.driver.find_elements(By.CSS_SELECTOR, css)

    def click(self, css):
        element = self.driver.find_element(By.CSS_SELECTOR, css)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        element.click()

    def press(self, *keys):
        ActionChains(self.driver).send_keys(*keys).perform()

    def downloaded(self, name):
        path = self.downloads / name
        for _ in range(200):
            if path.exists():
                return path.read_bytes()
            time.sleep(0.05)
        raise AssertionError(f"{name} did not come: {os.listdir(self.downloads)}")

    def colours_of_the_view(self):
        """Return how many different colours the picture of the gripper has, as the screen shows it, and the picture."""
        viewer = self.driver.find_element(By.ID, "viewer")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", viewer)
        self.script("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        picture = imread(io.BytesIO(viewer.screenshot_as_png), format="png")
        return len(np.unique((picture[..., :3] * 255).astype(int).reshape(-1, 3), axis=0)), picture


@pytest.fixture(scope="module")
def browsers(tmp_path_factory):
    started = {}

    def start(switches=WITH_WEBGL):
        if switches not in started:
            started[switches] = Browser(tmp_path_factory.mktemp("browser"), switches)
        return started[switches]

    yield start
    for browser in started.values():
        browser.driver.quit()


@pytest.fixture(scope="module")
def run():
    made = synthetic_run(60, cells=6, rechecked=4 if find_spec("finqd.trust") else 0)
    for record in made.told:
        rows = record["objects"]
        record["objects"] = {HOSTILE if name == "cube" else name: row for name, row in rows.items()}
        record["reason"] = record["reason"] and f"{HOSTILE} {record['reason']}"
    return made


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(run, path, name=HOSTILE, argument="RUN")
    return path


@pytest.fixture
def browser(browsers, page):
    opened = browsers().open(page)
    yield opened
    assert opened.errors() == []


def selected(browser):
    return int(browser.script("document.querySelector('.cell[aria-selected=true]').dataset.index"))


def test_the_page_loads_and_names_stay_text(browser, run):
    assert browser.driver.title == HOSTILE and browser.text("h1") == HOSTILE
    assert not browser.all("img")
    assert len(browser.all(".cell")) == len(run.elites())
    assert [chip.text for chip in browser.all(".chip")][0] == HOSTILE
    best = max((r for r in run.records() if r["status"] == "ok"), key=lambda r: r["objective"])
    assert selected(browser) == best["index"]
    failed = sum(record["status"] != "ok" for record in run.records())
    assert browser.text("#figures > div") == f"designs evaluated\n{failed} failed\n60"
    assert HOSTILE in browser.text("#failure-table")


def test_a_click_on_a_cell_shows_its_design(browser, run):
    cell, record = next((c, r) for c, r in run.elites() if r["index"] != selected(browser))
    browser.click(f'.cell[data-index="{record["index"]}"]')
    assert browser.text("#design-title") == f"Cell {cell[0]}, {cell[1]}"
    assert selected(browser) == record["index"]
    assert browser.text("#export-command") == f"finqd export RUN --cell {cell[0]},{cell[1]} --out gripper.stl"
    rows = {row.find_element(By.TAG_NAME, "th").text: row.text for row in browser.all("#design-objects tbody tr")}
    assert len(rows) == 10
    for name, row in record["objects"].items():
        word = "simulation failed" if row["status"] != "ok" else "held" if row["held"] else "lost"
        assert word in rows[name]
    parameters = browser.text("#design-parameters")
    spacing = record["parameters"]["spacing_mm"]
    assert f"spacing [mm] {spacing:.4g}" in parameters
    assert browser.script("location.hash") == f"#design={record['index']}"
    colours, _ = browser.colours_of_the_view()
    assert colours > 100 and browser.all("#viewer.without") == []


def test_the_keyboard_goes_from_cell_to_cell(browser, run):
    cells = {record["index"]: cell for cell, record in run.elites()}
    browser.script("document.querySelector('.cell[tabindex=\"0\"]').focus()")
    here = cells[selected(browser)]
    moved = 0
    ways = ((Keys.ARROW_LEFT, 0, -1), (Keys.ARROW_UP, 1, 1), (Keys.ARROW_RIGHT, 0, 1), (Keys.ARROW_DOWN, 1, -1))
    for key, axis, sign in ways:
        browser.press(key)
        there = cells[selected(browser)]
        assert there == here or (there[axis] - here[axis]) * sign > 0
        moved += there != here
        here = there
    assert moved >= 2
    assert browser.script("document.activeElement.dataset.index") == str(selected(browser))
    assert browser.text("#design-title") == f"Cell {here[0]}, {here[1]}"


def test_everything_that_acts_is_reached_by_the_tab_key(browser, run):
    chosen = browser.script("JSON.parse(document.getElementById('data').textContent).chosen.map((c) => c.index)")
    browser.click(next(f'.cell[data-index="{r["index"]}"]' for _, r in run.elites() if r["index"] not in chosen))
    reached = set()
    browser.script("document.querySelector('.skip').focus()")
    for _ in range(400):
        browser.press(Keys.TAB)
        reached.add(browser.script("((a) => a.id || a.className.baseVal || a.className)(document.activeElement)"))
        if "remove" in reached:
            break
    wanted = {"cell", "viewer", "design-file", "stl", "compare-add", "colour", "finger", "chip", "front-dot", "sort"}
    assert wanted <= reached


def test_limits_fade_what_does_not_meet_them(browser, run):
    browser.click(".chip:nth-of-type(10)")
    name = browser.text(".chip:nth-of-type(10)").removeprefix("✓ ")
    expected = {r["index"] for _, r in run.elites() if not r["objects"][name]["held"]}
    assert {int(c.get_attribute("data-index")) for c in browser.all(".cell.faded")} == expected and expected
    browser.click(".limits summary")
    field = browser.driver.find_element(By.CSS_SELECTOR, '[data-key="volume_mm3"][data-end="1"]')
    field.send_keys("60000", Keys.ENTER)
    expected |= {r["index"] for _, r in run.elites() if r["features"]["volume_mm3"] > 60e3}
    assert {int(c.get_attribute("data-index")) for c in browser.all(".cell.faded")} == expected
    left = len(run.elites()) - len(expected)
    assert browser.text(".limits .match-count") == f"{left} of {len(run.elites())} designs meet the limits"
    assert len(browser.all("#list tbody tr")) == min(left, 50)
    browser.click(".limits .lift")
    assert not browser.all(".cell.faded")


def test_a_drag_along_an_axis_limits_it(browser, run):
    area = browser.all(".brush-area")[0]  # fitness
    browser.script("arguments[0].scrollIntoView({block: 'center'})", area)
    high = area.size["height"]
    chain = ActionChains(browser.driver).move_to_element_with_offset(area, 0, int(-high / 2 + 2)).click_and_hold()
    chain.move_by_offset(0, int(0.25 * high)).release().perform()
    field = browser.driver.find_element(By.CSS_SELECTOR, '[data-key="fitness"][data-end="0"]')
    low = float(field.get_attribute("value"))
    assert 0.7 < low < 0.8
    expected = {r["index"] for _, r in run.elites() if r["fitness"] < low}
    assert {int(c.get_attribute("data-index")) for c in browser.all(".cell.faded")} == expected


def test_the_files_that_come_down_are_the_design(browser, run, tmp_path):
    cell, record = next((c, r) for c, r in run.elites() if r["index"] == selected(browser))
    name = f"gripper_cell_{cell[0]}_{cell[1]}"
    browser.click("#design-file")
    text = browser.downloaded(f"{name}.json").decode()
    assert Design.from_json(text).to_vector().tolist() == pytest.approx(list(record["parameters"].values()))
    browser.click("#stl")
    import trimesh

    (tmp_path / "part.stl").write_bytes(browser.downloaded(f"{name}_shells.stl"))
    corners = trimesh.load(tmp_path / "part.stl", process=False).triangles
    parts = [1e3 * vertices[triangles] for _, vertices, triangles in gripper_parts(Design.from_json(text))]
    assert len(corners) == sum(map(len, parts))
    assert corners == pytest.approx(np.concatenate(parts), abs=0.0051)


def test_a_design_is_added_to_the_comparison_and_taken_off(browser, run):
    before = len(browser.all("#compare-table thead th"))
    chosen = browser.script("JSON.parse(document.getElementById('data').textContent).chosen.map((c) => c.index)")
    other = next(r["index"] for _, r in run.elites() if r["index"] not in chosen)
    browser.click(f'.cell[data-index="{other}"]')
    browser.click("#compare-add")
    assert len(browser.all("#compare-table thead th")) == before + 1
    assert not browser.driver.find_element(By.ID, "compare-add").is_enabled()
    browser.all("#compare-table .remove")[-1].click()
    assert len(browser.all("#compare-table thead th")) == before


def test_the_picture_turns_by_mouse_and_keys(browser):
    _, first = browser.colours_of_the_view()
    canvas = browser.driver.find_element(By.ID, "viewer")
    ActionChains(browser.driver).drag_and_drop_by_offset(canvas, 80, 20).perform()
    _, second = browser.colours_of_the_view()
    assert np.any(first != second)
    browser.script("document.getElementById('viewer').focus()")
    browser.press(Keys.ARROW_LEFT, "+")
    _, third = browser.colours_of_the_view()
    assert np.any(second != third)


def test_an_address_leads_to_its_design(browsers, page, run):
    _, record = run.elites()[0]
    browser = browsers().open(page, f"#design={record['index']}")
    assert selected(browser) == record["index"]
    assert browsers().open(page, "#design=99999").errors() == []


def test_without_webgl_the_gripper_is_painted_all_the_same(browsers, page):
    browser = browsers(WITHOUT).open(page)
    assert "Drawn without WebGL" in browser.text("#shape-note")
    colours, _ = browser.colours_of_the_view()
    assert colours > 20
    colour_before = browser.script(PIXELS)
    browser.script("document.getElementById('viewer').focus()")
    browser.press(Keys.ARROW_LEFT)
    browser.colours_of_the_view()  # waits for a frame
    assert browser.script(PIXELS) != colour_before
    assert browser.errors() == []


@pytest.mark.parametrize("width", [360, 768, 1400])
def test_nothing_sticks_out_of_the_window(browsers, page, width):
    browser = browsers()
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.open(page)
        assert browser.script("innerWidth") == width
        assert browser.script("document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.parametrize("width", [400, 1400])
def test_screenshots_of_the_whole_page(browsers, page, tmp_path, width):
    """Kept where FINQD_SCREENSHOTS says, to be looked at."""
    browser, folder = browsers(), Path(os.environ.get("FINQD_SCREENSHOTS") or tmp_path)
    size = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.open(page)
        height = browser.script("document.documentElement.scrollHeight")
        browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", {**size, "height": height})
        browser.colours_of_the_view()  # waits for what is drawn anew
        taken = browser.driver.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})["data"]
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"report_{width}.png").write_bytes(base64.b64decode(taken))
    picture = imread(folder / f"report_{width}.png")
    assert picture.shape[:2] == (height, width)
    ground = picture[0, 0, :3]
    drawn = np.abs(picture[..., :3] - ground).max(axis=2) > 0.02
    assert np.all(drawn.reshape(-1)[: 10 * (drawn.size // 10)].reshape(10, -1).any(axis=1))  # no tenth of it is empty


@pytest.mark.parametrize("kind", ["empty", "all failed", "one", "without shapes", "one axis", "three axes"])
def test_pages_of_unusual_runs_load_too(browsers, tmp_path, kind):
    units = np.random.default_rng(3).random((6, 28))
    ranges = {"workspace_mm2": (1169.0, 2079.0), "volume_mm3": (35e3, 94e3), "finger_volume_mm3": (30e3, 90e3)}
    axes = {"one axis": 1, "three axes": 3}.get(kind, 2)
    records = [synthetic_record(i, unit) for i, unit in enumerate(units)]
    if kind == "all failed":
        nothing = {"status": "error", "reason": "never", "fitness": None, "objects": {}, "features": {}}
        records = [{**record, **nothing} for record in records]
    records = {"empty": [], "one": records[:1]}.get(kind, records)
    path = tmp_path / "report.html"
    shapes = 0 if kind == "without shapes" else 400
    made = SyntheticRun(records, cells=3, ranges=dict(list(ranges.items())[:axes]))
    write_report(made, path, name=kind, argument="RUN", shapes=shapes)
    browser = browsers().open(path)
    assert browser.errors() == []
    assert browser.text("h1") == kind
    if kind in ("empty", "all failed"):
        assert browser.text("#no-design") == "There is no design to show." and not browser.all(".cell")
    elif kind == "without shapes":
        assert browser.text("#shape-note").startswith("No 3-D view: the page holds the shapes of the best 0 designs")
    else:
        assert browser.all(".cell") and browser.colours_of_the_view()[0] > 100
