"""The pages in a real browser, used as a person would: pointed at, dragged, tabbed through, on a phone, in the dark."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from mapfuse.datasets.logs import Detection, LogHeader, LogTruth, Odometry, Scan
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.fusion import write_fused
from mapfuse.fusion.compare.sheets import Sheet
from mapfuse.fusion.report import batch_report, compare_report, fused_report, log_report, map_report
from mapfuse.fusion.result import FusedMap
from mapfuse.fusion.show.journey import journey
from mapfuse.fusion.show.log_page import Drive

pytestmark = pytest.mark.xdist_group("browser")

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--hide-scrollbars",
)  # fmt: skip
LANDMARKS = "#main .mark:not(.off)"
HOSTILE = (
    "<script>window.hacked = 1</script>",
    "</script><img src=x onerror='window.hacked = 2'>",
    "\u202egnissim \u05d0\u05d1\u05d2",
    "&lt;b&gt; \"quoted\" 'too' $x$",
    "x" * 10_000,
)

#: Contrast of every text with what lies behind it, by the formula of WCAG.
CONTRASTS = """
  const channel = (v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const lit = (text) => {
    const c = text.match(/[\\d.]+/g).map((v) => channel(v / 255));
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
  };
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const c = getComputedStyle(e).backgroundColor;
      if (!c.startsWith("rgba(0, 0, 0, 0") && c.startsWith("rgb")) return lit(c);
    }
    return 1;
  };
  return [...document.querySelectorAll("h1, h2, h3, p, dt, dd, label, .nats, th, td:not(.shaded), summary")]
    .filter((e) => e.textContent && e.getClientRects().length)
    .map((e) => {
      const [a, b] = [lit(getComputedStyle(e).color), behind(e)];
      return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    });
"""


class Browser:
    """Chromium without a window, and what the tests ask of it."""

    def __init__(self, profile: Path) -> None:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = str(shutil.which("chromium"))
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        self.driver.set_script_timeout(20)

    def open(self, page: Path, width: int = 1300, height: int = 900, scheme: str = "light") -> None:
        """A page in a window of that size, ready to be used; the colours are those that the system asks for."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        features = [
            {"name": "prefers-color-scheme", "value": scheme},
            {"name": "prefers-reduced-motion", "value": "reduce"},
        ]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        self.driver.get(page.as_uri())
        assert self.js("return document.documentElement.dataset.ready") == "yes"
        self.drawn()

    def js(self, code: str, *arguments: Any) -> Any:
        return self.driver.execute_script(code, *arguments)

    def drawn(self) -> None:
        """Returns when what was changed is on the screen."""
        self.driver.execute_async_script("const done = arguments[0]; requestAnimationFrame(() => setTimeout(done))")

    def errors(self) -> list[str]:
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def find(self, selector: str) -> Any:
        return self.driver.find_element("css selector", selector)

    def text(self, selector: str) -> str:
        return str(self.js("return document.querySelector(arguments[0]).textContent", selector))

    def count(self, selector: str) -> int:
        """How many such elements are shown."""
        code = "return [...document.querySelectorAll(arguments[0])].filter((e) => e.getClientRects().length).length"
        return int(self.js(code, selector))

    def boxes(self, selector: str) -> np.ndarray:
        """Where elements are (n, 4): left, top, width, height [pixels]."""
        code = (
            "return [...document.querySelectorAll(arguments[0])].filter((e) => e.getClientRects().length)"
            ".map((e) => { const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })"
        )
        return np.array(self.js(code, selector), dtype=float).reshape(-1, 4)

    def point_at(self, element: Any) -> None:
        from selenium.webdriver import ActionChains

        self.js("arguments[0].scrollIntoView({block: 'center'})", element)
        ActionChains(self.driver, duration=0).move_to_element(element).perform()
        self.drawn()

    def press(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        for key in keys:
            ActionChains(self.driver, duration=0).send_keys(key).perform()
        self.drawn()

    def click(self, selector: str) -> None:
        self.js("document.querySelector(arguments[0]).click()", selector)
        self.drawn()

    def click_label(self, text: str) -> None:
        code = "[...document.querySelectorAll('.check')].find((l) => l.textContent === arguments[0]).click()"
        self.js(code, text)
        self.drawn()

    def slide(self, to: int) -> None:
        code = "const s = document.querySelector('#rival'); s.value = arguments[0]; s.dispatchEvent(new Event('input'))"
        self.js(code, to)
        self.drawn()

    def screenshot(self) -> np.ndarray:
        """The window as pixels (height, width, 3) in [0, 1]."""
        return matplotlib.image.imread(io.BytesIO(self.driver.get_screenshot_as_png()))[..., :3]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if shutil.which("chromium") is None or shutil.which("chromedriver") is None:
        if os.environ.get("CI") == "true":
            pytest.fail("Chromium isn't here, though the set-up installs it")
        pytest.skip("Chromium and its driver aren't here (README, set-up)")
    opened = Browser(tmp_path_factory.mktemp("profile"))
    yield opened
    opened.driver.quit()


@pytest.fixture(scope="session")
def pages(results: Mapping[str, FusedMap], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Name -> a page of every kind."""
    folder = tmp_path_factory.mktemp("pages")
    made = {name: folder / f"{name.replace(' ', '-')}.html" for name in (*results, "map", "log", "empty", "hostile")}
    for name, fused in results.items():
        fused_report(fused, made[name])
    map_report(results["merged"].to_map(), made["map"])
    map_report(LandmarkMap("nothing"), made["empty"])
    fused_report(hostile(results["merged"]), made["hostile"])
    header, drive = a_drive()
    log_report(header, drive, made["log"])
    return made


def a_drive() -> tuple[LogHeader, Drive]:
    events = [Odometry(float(t), float(t), 0.1 * t, 0.1) for t in range(20)]
    events += [Detection(3.0, "door", 2.0, 0.3), Detection(8.0, "door", 2.0, -0.3)]
    events.append(Scan(9.0, -1.0, 0.5, (2.0, None, 3.0, 2.5, 2.0)))
    events.sort(key=lambda event: event.t)
    path = np.array([[t, t + 1.0, 0.1 * t, 0.1] for t in range(20)], dtype=float)
    truth = LogTruth("drive", path, ("d1", None), {"d1": np.array([6.0, 1.0])}, {"d1": "door"})
    return LogHeader("drive", robot="milka"), Drive("drive", journey(events), truth)


def hostile(fused: FusedMap) -> FusedMap:
    """The same result, its names and labels such as nobody should trust."""
    first, second = HOSTILE[0], HOSTILE[1]
    names = dict(zip(fused.maps, (first, second), strict=True))
    types = dict(enumerate(HOSTILE))
    maps = {
        names[name]: replace(
            map_,
            name=names[name],
            robot=HOSTILE[2],
            landmarks=tuple(Landmark(l.id, types[k % len(types)], l.x, l.y) for k, l in enumerate(map_.landmarks)),
        )
        for name, map_ in fused.sources.items()
    }
    pair = replace(fused.pairs[0], maps=(first, second), reason=" ".join(HOSTILE))
    pair = replace(pair, hypotheses=tuple(replace(h, missed={}, evidence={HOSTILE[0]: 2.0}) for h in pair.hypotheses))
    landmarks = tuple(
        replace(l, id=f"{HOSTILE[k % len(HOSTILE)]}{k}", sources={names[n]: ids for n, ids in l.sources.items()})
        for k, l in enumerate(fused.landmarks)
    )
    return replace(
        fused, maps=(first, second), groups=((first, second),), pairs=(pair,), landmarks=landmarks, sources=maps,
        frames={names[n]: frame for n, frame in fused.frames.items()}, joint_covariances=(),
    )  # fmt: skip


# Loading -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["merged", "ambiguous", "no_overlap", "partial", "not embedded", "large", "map", "log", "empty", "hostile"],
)
def test_a_page_loads_without_errors_and_asks_nobody_for_anything(
    browser: Browser, pages: Mapping[str, Path], name: str
) -> None:
    browser.open(pages[name])
    assert browser.errors() == []
    assert browser.js("return performance.getEntriesByType('resource').length") == 0
    assert browser.count("#main svg.view") == 1


def test_a_script_that_the_page_does_not_know_is_not_run(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    browser.js(
        "const s = document.createElement('script'); s.textContent = 'window.foreign = 1'; document.body.append(s)"
    )
    assert browser.js("return window.foreign") is None
    assert "Content Security Policy" in "".join(browser.errors())


def test_text_of_files_is_text(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["hostile"])
    browser.js("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    browser.drawn()
    assert browser.js("return window.hacked") is None
    assert browser.count("img") == 0
    assert browser.errors() == []
    shown = browser.text("body main")
    assert HOSTILE[0] in shown
    assert "\u202e" not in shown
    assert "x" * 100 not in browser.text(".legends")
    assert browser.js("return document.documentElement.scrollWidth <= innerWidth") is True


# Pointing ------------------------------------------------------------------------------------------------------------


def test_a_landmark_says_what_it_is_when_it_is_pointed_at(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    browser.point_at(browser.find("#main [data-key='g0:3'] .sign"))
    said = browser.text(".tip")
    for part in ("m3", "D7p1-0", "D9p1-0", "σ of x, y0.200, 0.300 m", "existence0.970", "correlation0.00"):
        assert part in said
    assert browser.count("#main .mark.hot") == 1
    assert browser.count(".small .mark.hot") == 2, "the same landmark lights up in both recorded maps"
    browser.point_at(browser.find("h1"))
    assert browser.count(".tip") == 0
    assert browser.count(".hot") == 0


def test_evidence_lights_up_the_landmarks_that_it_speaks_of(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    assert [e.get_attribute("data-term") for e in browser.driver.find_elements("css selector", ".term.for")] == [
        "matches", "void",
    ]  # fmt: skip
    assert browser.count(".term.against") == 2
    browser.point_at(browser.find("[data-term='matches']"))
    assert browser.count(".small[data-map='0'] .mark.hot") == 8
    assert browser.count(".small[data-map='1'] .mark.hot") == 8
    browser.js("document.querySelector('[data-term=misses]').focus()")
    browser.drawn()
    assert browser.count(".small[data-map='0'] .mark.hot") == 1
    assert browser.count(".small[data-map='1'] .mark.hot") == 0


# The slider ----------------------------------------------------------------------------------------------------------


def test_the_slider_lays_map_2_where_each_rival_has_it(
    browser: Browser, pages: Mapping[str, Path], results: Mapping[str, FusedMap]
) -> None:
    fused = results["ambiguous"]
    browser.open(pages["ambiguous"])
    places = []
    for k, rival in enumerate(fused.pairs[0].hypotheses):
        browser.slide(k)
        said = browser.text("#rival-said")
        assert f"Placement {k + 1} of 2: probability {100 * rival.probability:g} %" in said
        assert "Possible, not decided" in said
        assert browser.count("#main .match") == len(rival.correspondences)
        # where a landmark of map 2 lies on the screen from two of map 1, which give scale and origin
        code = (
            "const at = (key) => { const b = document.querySelector(`#main [data-key='${key}'] .reach`)"
            ".getBoundingClientRect(); return [b.left + b.width / 2, -(b.top + b.height / 2)]; };"
            "return [at('0:0'), at('0:11'), at('1:0')]"
        )
        a, b, seen = np.array(browser.js(code))
        one, two = (fused.sources[name].positions for name in fused.maps)
        scale = np.linalg.norm(b - a) / np.linalg.norm(one[11] - one[0])
        assert (seen - a) / scale + one[0] == pytest.approx(rival.T12.apply(two[0]), abs=0.05)
        places.append(seen)
    assert not np.allclose(places[0], places[1], atol=20)


def test_where_maps_share_nothing_they_lie_side_by_side(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["no_overlap"])
    assert "These maps show different places" in browser.text("#verdict")
    assert "This is the answer. No overlap" in browser.text("#rival-said")
    first, second = browser.boxes("#main .own0.mark"), browser.boxes("#main .own1.mark")
    assert first[:, 0].max() < second[:, 0].min()
    browser.slide(0)
    assert "Not the answer" in browser.text("#rival-said")


def test_the_shares_say_which_placement_is_shown(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["ambiguous"])
    widths = browser.boxes(".share")[:, 2]
    assert widths[:2] / widths.sum() == pytest.approx([0.55, 0.4], abs=0.03)
    browser.click(".share:nth-child(2)")
    assert browser.js("return document.querySelector('#rival').value") == "1"
    assert browser.js("return document.querySelector('.share:nth-child(2)').ariaPressed") == "true"


# Switching -----------------------------------------------------------------------------------------------------------


def test_switching_a_map_off_hides_what_it_alone_recorded(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    assert browser.count(LANDMARKS) == 15
    browser.click("[data-map='0'][type='checkbox']")
    assert browser.count(LANDMARKS) == 12
    assert browser.count(".small[data-map='0'] .mark") == 0
    browser.click("[data-map='1'][type='checkbox']")
    assert browser.count(LANDMARKS) == 0
    browser.click("#mode-placed")
    assert browser.count(LANDMARKS) == 0
    browser.click("[data-map='0'][type='checkbox']")
    assert browser.count(LANDMARKS) == 12


def test_ellipses_have_the_size_of_the_chosen_confidence(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    code = (
        "const s = document.querySelector('#confidence'); s.value = arguments[0]; s.dispatchEvent(new Event('change'))"
    )
    heights = []
    for p in (0.5, 0.95):
        browser.js(code, str(p))
        browser.drawn()
        heights.append(browser.boxes("#main .ellipse")[0, 3])
    assert heights[1] / heights[0] == pytest.approx(np.sqrt(np.log(0.05) / np.log(0.5)), rel=0.05)
    browser.click_label("ellipses")
    assert browser.count("#main .ellipse") == 0


def test_pairs_and_groups_of_several_maps_are_listed_and_chosen(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["partial"])
    assert browser.count("#pairs tbody tr") == 3
    assert browser.text("#groups") == "merged: D7, D9alone: D1"
    browser.click("#pairs tbody tr:nth-child(2) button")
    assert "D7 and D1" in browser.text("#evidence")
    assert "Overruled by the cycle of D7, D9" in browser.text("#evidence")
    assert browser.count("#main .own2.mark") == 2


# Moving --------------------------------------------------------------------------------------------------------------


def test_wheel_and_drag_zoom_and_move(browser: Browser, pages: Mapping[str, Path]) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    browser.open(pages["merged"])
    view = browser.find("#main svg.view")
    browser.js("arguments[0].scrollIntoView()", view)
    before = browser.boxes(LANDMARKS)
    ActionChains(browser.driver, duration=0).scroll_from_origin(ScrollOrigin.from_element(view), 0, -240).perform()
    browser.drawn()
    after = browser.boxes(LANDMARKS)
    assert np.ptp(after[:, 0]) / np.ptp(before[:, 0]) == pytest.approx(np.exp(0.6), rel=0.1)
    assert after[:, 2] == pytest.approx(before[:, 2], abs=0.5), "signs keep their size"
    ActionChains(browser.driver, duration=0).drag_and_drop_by_offset(view, 50, 30).perform()
    browser.drawn()
    assert browser.boxes(LANDMARKS)[:, :2] - after[:, :2] == pytest.approx(np.tile([50, 30], (len(after), 1)), abs=1.5)


def test_the_keyboard_does_all_of_it(browser: Browser, pages: Mapping[str, Path]) -> None:
    from selenium.webdriver.common.keys import Keys

    browser.open(pages["ambiguous"])
    browser.js("document.querySelector('#rival').focus()")
    browser.press(Keys.ARROW_RIGHT)
    assert "Placement 2 of 2" in browser.text("#rival-said")
    browser.js("document.querySelector('#main svg.view').focus()")
    before = browser.boxes(LANDMARKS)
    browser.press("+")
    assert np.ptp(browser.boxes(LANDMARKS)[:, 0]) > 1.2 * np.ptp(before[:, 0])
    browser.press("0")
    assert browser.boxes(LANDMARKS) == pytest.approx(before, abs=1)
    browser.press(Keys.ARROW_LEFT)
    assert browser.boxes(LANDMARKS)[:, 0] - before[:, 0] == pytest.approx(60, abs=1)
    browser.press("n")
    first = browser.text(".tip strong")
    browser.press("n")
    assert browser.text(".tip strong") != first
    browser.press("b")
    assert browser.text(".tip strong") == first
    browser.press(Keys.ESCAPE)
    assert browser.count(".tip") == 0


def test_everything_that_can_be_used_is_reached_by_tab(browser: Browser, pages: Mapping[str, Path]) -> None:
    from selenium.webdriver.common.keys import Keys

    browser.open(pages["merged"])
    reached = set()
    for _ in range(60):
        browser.press(Keys.TAB)
        reached.add(browser.js("const e = document.activeElement; return e.id || e.className.baseVal || e.className"))
    assert {"theme", "rival", "mode-merged", "confidence", "view", "term for", "joint", "dot"} <= reached


# Phone, dark, structure ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["merged", "ambiguous", "partial", "map", "log"])
def test_a_phone_shows_it_in_one_column(browser: Browser, pages: Mapping[str, Path], name: str) -> None:
    browser.open(pages[name], width=390, height=844)
    assert browser.js("return document.documentElement.scrollWidth") <= 390
    boxes = browser.boxes("main button, main select, main .check")
    assert boxes[:, 3].min() >= 18
    assert browser.boxes("#main svg.view")[0, 2] > 350


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_the_page(browser: Browser, pages: Mapping[str, Path], scheme: str) -> None:
    browser.open(pages["merged"], scheme=scheme)
    assert min(browser.js(CONTRASTS)) >= 4.5
    paper = browser.screenshot()[-1, 5]
    assert (paper.mean() < 0.2) == (scheme == "dark")


def test_the_colour_button_goes_its_own_way(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"], scheme="light")
    browser.click("#theme")
    browser.click("#theme")
    assert browser.text("#theme") == "Colours: dark"
    assert browser.screenshot()[-1, 5].mean() < 0.2


@pytest.mark.parametrize(("name", "owners"), [("merged", "#main .common.mark"), ("ambiguous", "#main .own1.mark")])
def test_the_picture_has_its_signs_where_the_landmarks_are(
    browser: Browser, pages: Mapping[str, Path], name: str, owners: str
) -> None:
    browser.open(pages[name], height=1500)
    pixels = browser.screenshot()
    colour = np.array([26, 26, 26] if name == "merged" else [0xE6, 0x9F, 0x00]) / 255
    for left, top, width, height in browser.boxes(f"{owners} .sign"):
        part = pixels[int(top) : int(top + height) + 1, int(left) : int(left + width) + 1]
        assert (np.abs(part - colour).max(axis=2) < 0.1).mean() > 0.1
    frame = browser.boxes("#main svg.view")[0].astype(int)
    empty = pixels[frame[1] + 2 : frame[1] + 12, frame[0] + 2 : frame[0] + 12]
    assert np.abs(empty - 1).max() < 0.02


def test_maps_are_told_apart_without_colour(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["merged"])
    code = "return [...document.querySelectorAll('.small .link.line')].map((e) => getComputedStyle(e).strokeDasharray)"
    assert len(set(browser.js(code))) == 2


def test_the_joint_covariance_names_the_landmarks_of_a_cell(browser: Browser, pages: Mapping[str, Path]) -> None:
    from selenium.webdriver.common.keys import Keys

    browser.open(pages["merged"])
    browser.js("document.querySelector('#joint').focus()")
    browser.press(Keys.ARROW_RIGHT)
    # neighbours in the picture: p0-1 and p0-0, which only robot 1 saw, are one apart in the joint covariance
    assert browser.text(".tip strong") == f"{np.exp(-1 / 3):.2f}"
    assert browser.text(".tip dl") == "betweenm1andm0"


def test_all_numbers_are_there_when_they_are_opened(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["large"])
    assert browser.js("return document.querySelectorAll('details tbody tr').length") < 10
    browser.click("details summary")
    assert browser.js("return document.querySelectorAll('details tbody tr').length") >= 1000


def test_links_of_a_log_s_page_switch_its_parts(browser: Browser, pages: Mapping[str, Path]) -> None:
    browser.open(pages["log"])
    assert browser.count(".ground .odometry") == 1
    assert browser.count(".ground .alarms") == 1
    browser.click_label("path by odometry")
    assert browser.count(".ground .odometry") == 0


# A batch run ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def batch_page(results: Mapping[str, FusedMap], tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("run")
    write_fused(results["merged"], run / "first.fused.json")
    rows = ["map1,map2,decision,probability,x,y,theta,count,error", "D7,D9,merged,0.998,1,2,0.5,11,"]
    rows += [f"D7,other-{k:03},no_overlap,0.00{k % 7},1,2,0.5,{k % 5}," for k in range(450)]
    rows.append("D9,<b>bold</b>,,,,,,,no such file")
    (run / "pairs.csv").write_text("\n".join(rows), encoding="utf-8")
    batch_report(run, run / "report.html")
    return run / "report.html"


def test_a_batch_s_groups_are_drawn_when_they_are_opened(browser: Browser, batch_page: Path) -> None:
    browser.open(batch_page)
    assert browser.errors() == []
    assert browser.count("svg.view") == 0
    browser.click(".group summary")
    assert browser.count(".group .mark") == 15
    browser.point_at(browser.find(".group [data-key='g0:4'] .sign"))
    assert "D9p1-1" in browser.text(".tip")
    assert browser.errors() == []


def test_a_batch_s_pairs_are_paged_filtered_and_sorted(browser: Browser, batch_page: Path) -> None:
    browser.open(batch_page)
    assert browser.count("#pairs tbody tr") == 200
    assert browser.text("#where") == "1 to 200 of 452 pairs"
    assert browser.text("#pairs tbody tr td:nth-child(4)") == "99.8 %"
    browser.click("#on")
    browser.click("#on")
    assert browser.text("#where") == "401 to 452 of 452 pairs"
    code = "const [i, value, event] = arguments; const e = document.querySelector(i); e.value = value;"
    code += "e.dispatchEvent(new Event(event))"
    browser.js(code, "#name", "other-44", "input")
    assert browser.text("#where") == "1 to 10 of 10 pairs"
    browser.js(code, "#name", "", "input")
    browser.js(code, "#decision", "failed", "change")
    assert browser.text("#pairs tbody tr td:nth-child(2)") == "<b>bold</b>"
    assert browser.text("#pairs tbody tr td:nth-child(6)") == "no such file"
    browser.js(code, "#decision", "all", "change")
    browser.click("#pairs th:nth-child(2) button")
    assert browser.text("#pairs tbody tr td:nth-child(2)") == "other-449"


# A comparison --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def compare_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = tuple((f"map {k}", "heuristic" if k % 2 else "optimised", f"{k / 4:.2f}" if k else "-") for k in range(20))
    sheets = [Sheet("Pairs", ("maps", "method", "rms [m], all"), ((HOSTILE[0], HOSTILE[1], "0.01"), *rows))]
    sheets.append(Sheet("Summary", ("method",), (("heuristic",),), HOSTILE[3]))
    buffer = io.BytesIO()
    matplotlib.image.imsave(buffer, np.zeros((12, 30, 3)), format="png")
    path = tmp_path_factory.mktemp("compare") / "compare.html"
    compare_report(
        HOSTILE[0], HOSTILE[3], sheets, path, facts=[["Data", HOSTILE[1]]], pictures={"Fig. 2": buffer.getvalue()}
    )
    return path


def test_a_comparison_s_tables_are_sorted_and_filtered_and_its_pictures_shown(
    browser: Browser, compare_page: Path
) -> None:
    browser.open(compare_page)
    assert browser.errors() == []
    assert browser.js("return window.hacked") is None
    table = "section:first-of-type"
    assert browser.text(f"{table} output") == "21 of 21 rows"
    assert browser.text(f"{table} td") == HOSTILE[0]
    browser.click(f"{table} th:nth-child(3) button")
    assert browser.text(f"{table} tbody tr:nth-child(1) td:nth-child(3)") == "0.01"
    assert browser.text(f"{table} tbody tr:nth-child(21) td:nth-child(3)") == "-"
    browser.click(f"{table} th:nth-child(3) button")
    assert browser.text(f"{table} tbody tr:nth-child(2) td:nth-child(3)") == "4.75"
    code = (
        "const e = document.querySelector('input[type=search]'); e.value = 'HEUR'; e.dispatchEvent(new Event('input'))"
    )
    browser.js(code)
    assert browser.text(f"{table} output") == "10 of 21 rows"
    assert browser.js("const i = document.querySelector('img.picture'); return [i.naturalWidth, i.alt]") == [
        30,
        "Fig. 2",
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_comparison_s_text_stands_out(browser: Browser, compare_page: Path, scheme: str) -> None:
    browser.open(compare_page, scheme=scheme)
    assert min(browser.js(CONTRASTS)) > 4.5
