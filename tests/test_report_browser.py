"""The page about a training run in a browser without a window: Debian's chromium and chromium-driver, by Selenium."""

from __future__ import annotations

import shutil
import time

import pytest
from _runs import small_run

from torchrl_pomdp.problems import make_problem, tiger
from torchrl_pomdp.report.page import write_report

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
selenium = pytest.importorskip("selenium", reason="selenium, of the extra dev, is not installed")
pytestmark = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="no chromium and chromedriver: install Debian's chromium and chromium-driver"
)


@pytest.fixture(scope="module")
def browser():
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture(scope="module", params=["linear20", "tiger"])
def report(request, tmp_path_factory):
    # With a smaller discount a simulation ends sooner.
    problem = tiger(0.5) if request.param == "tiger" else make_problem(request.param)
    return write_report(small_run(tmp_path_factory.mktemp("runs") / request.param, problem), problem=problem)


def opened(browser, path, width=1000, scheme="light"):
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(path.as_uri())


def by_id(browser, name):
    return browser.find_element("id", name)


def stage(browser):
    return by_id(browser, "stage-text").text


def shown(browser):
    return by_id(browser, "sides").get_attribute("innerHTML")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1400])
def test_the_page_fits_and_can_be_read(browser, report, width, scheme):
    opened(browser, report, width, scheme)
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    ink, paper = browser.execute_script(
        "const style = getComputedStyle(document.body);"
        "return [style.color, style.backgroundColor].map(c => c.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + +b, 0));"
    )
    assert (ink - paper > 450) if scheme == "dark" else (paper - ink > 450)
    sides = browser.find_elements("class name", "side")
    assert len(sides) == 2
    beside = sides[0].rect["y"] == sides[1].rect["y"]
    assert beside == (width == 1400), "side by side where there is room"
    for control in ("start", "play", "stage"):
        assert by_id(browser, control).accessible_name
    sizes = browser.execute_script(
        "return [...document.querySelectorAll('p, td, th, .side span, .side div, button')]"
        ".filter(e => e.offsetParent && e.textContent).map(e => parseFloat(getComputedStyle(e).fontSize))"
    )
    assert min(sizes) >= 12
    assert browser.get_log("browser") == []


def test_arrow_keys_step(browser, report):
    from selenium.webdriver.common.keys import Keys

    opened(browser, report)
    body = browser.find_element("tag name", "body")
    last = int(by_id(browser, "stage").get_attribute("max"))
    assert last > 3
    assert stage(browser) == f"stage 0 of {last}"
    first = shown(browser)
    right, left = Keys.ARROW_RIGHT, Keys.ARROW_LEFT
    for key, now in ((right, 1), (right, 2), (left, 1), (Keys.END, last), (right, last)):
        body.send_keys(key)
        assert stage(browser) == f"stage {now} of {last}"
        assert shown(browser) != first
    body.send_keys(Keys.HOME)
    assert shown(browser) == first
    # With the slider in focus the keys are its own: one step, not two.
    by_id(browser, "stage").send_keys(right)
    assert stage(browser) == f"stage 1 of {last}"
    assert browser.get_log("browser") == []


def test_the_slider_and_the_start_state_choose(browser, report):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.support.select import Select

    opened(browser, report)
    slider = by_id(browser, "stage")
    last = int(slider.get_attribute("max"))
    first = shown(browser)
    ActionChains(browser).move_to_element(slider).click().perform()
    middle = int(slider.get_attribute("value"))
    assert 0.3 * last < middle < 0.7 * last
    assert stage(browser) == f"stage {middle} of {last}"
    assert shown(browser) != first
    Select(by_id(browser, "start")).select_by_index(1)
    assert stage(browser).startswith("stage 0 of ")
    assert len(Select(by_id(browser, "start")).options) == 3
    assert browser.get_log("browser") == []


def test_play_goes_on_to_the_end_and_pauses(browser, report):
    from selenium.webdriver.common.keys import Keys

    opened(browser, report)
    button, slider = by_id(browser, "play"), by_id(browser, "stage")
    last = int(slider.get_attribute("max"))
    button.click()
    assert button.text == "Pause"
    wait(lambda: int(slider.get_attribute("value")) >= 2)
    button.click()
    assert button.text == "Play"
    paused = stage(browser)
    time.sleep(0.8)
    assert stage(browser) == paused
    browser.find_element("tag name", "body").send_keys(Keys.END, Keys.ARROW_LEFT)
    button.click()
    wait(lambda: button.text == "Play")
    assert stage(browser) == f"stage {last} of {last}"
    button.click()
    assert stage(browser) == f"stage 0 of {last}", "once more from the start"
    assert browser.get_log("browser") == []


def wait(condition):
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_frames_show_costs_controls_and_the_truth(browser, report):
    opened(browser, report)
    texts = [side.text for side in browser.find_elements("class name", "side")]
    for text in texts:
        assert "cost so far 0.00" in text
        assert "the truth" in text
        assert "what is known" in text
        assert "least" in text
    if "linear20" in str(report):
        assert all("robot 1 " in text for text in texts)
        assert len(browser.find_elements("css selector", ".net .place")) == 4 * 20
        assert len(browser.find_elements("css selector", ".net .robot")) == 4
