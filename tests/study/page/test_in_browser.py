"""The page in a real browser, opened from the disk: each control does what it says."""

import re
import shutil

import pytest

CHROMIUM = shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("chromium is not installed", allow_module_level=True)
sync_api = pytest.importorskip("playwright.sync_api")

pytestmark = pytest.mark.xdist_group("page")
PATIENCE = 120_000  # milliseconds; machines may be busy


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM)
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, site):
    """Opens the page, offline, and fails at the end where the console has an error or a warning."""
    said, contexts = [], []

    def open_page(width=1280, theme="light", path="index.html"):
        context = browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=theme, offline=True
        )
        contexts.append(context)
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.on("console", lambda one: said.append(one.text) if one.type != "log" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("requestfailed", lambda request: said.append(request.url))
        page.goto((site / path).as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert said == []


def ground(page):
    return page.evaluate("getComputedStyle(document.body).backgroundColor")


def brightness(page):
    return sum(map(int, re.findall(r"\d+", ground(page))[:3])) / 3


def colours(page, side="left"):
    return page.locator(f"#{side} .place").evaluate_all(
        "all => all.map(one => one.getAttribute('fill'))"
    )


def traces(page, chart):
    return page.evaluate(f"document.getElementById('{chart}').data")


def test_the_theme_follows_the_system_and_the_button(opened):
    page = opened(theme="dark")
    assert brightness(page) < 60 and page.locator("#theme").inner_text() == "Light"
    page.click("#theme")
    assert brightness(page) > 200 and page.locator("#theme").inner_text() == "Dark"
    font = page.evaluate("document.getElementById('chart').layout.font.color")
    assert max(map(int, re.findall(r"\d+", font)[:3])) < 100  # charts are drawn again
    page.reload()
    assert brightness(page) > 200  # the choice is kept
    assert brightness(opened(theme="light")) > 200


def test_the_chart_of_the_finding(opened):
    page = opened()
    entries = page.evaluate("data.differences")
    for entry in (entries[0], entries[-1], entries[len(entries) // 2]):
        page.select_option("#chart-figure", entry["figure"])
        page.select_option("#chart-panel", entry["panel"])
        page.select_option("#chart-maze", entry["maze"])
        (drawn,) = traces(page, "chart")
        assert drawn["x"] == [bar["middle"] for bar in entry["bars"]]
        assert drawn["y"] == [bar["name"] for bar in entry["bars"]]


def test_the_explorer(opened):
    page = opened()
    assert page.locator("#step-shown").inner_text() == "step 5,000"
    seen = [colours(page)]

    def changed():
        seen.append(colours(page))
        return seen[-1] not in seen[:-1]

    page.locator("#step").fill("2")
    assert changed() and page.locator("#step-shown").inner_text() == "step 500"
    assert page.evaluate("document.getElementById('curves').layout.shapes[0].x0") == 500
    for quantity in ("value", "relative", "unroll"):
        page.select_option("#quantity", quantity)
        assert changed(), quantity
    page.select_option("#sampler", "outcome_spread")
    assert changed() and "outcome spread" in page.locator("#left-title").inner_text()
    page.select_option("#seed", "1")
    assert changed()
    page.select_option("#maze", "1")
    assert changed() and len(traces(page, "curves")) == 4
    page.select_option("#quantity", "p")
    points = colours(page, "right")
    assert "p is 1 at the" in page.locator("#right-title").inner_text() and len(set(points)) == 3
    page.select_option("#beside", "aser")
    assert colours(page, "right") != points
    page.select_option("#sampler", "uniform")
    assert set(colours(page)) == {"url(#hatch)"}
    assert page.locator("#left-scale").inner_text() == "This sampler has no criterion."
    arrows = page.locator("#left .arrow")
    assert arrows.count() > 10
    page.uncheck("#arrows")
    assert arrows.count() == 0


def test_a_state_tells_its_numbers(opened):
    page = opened()
    state = page.evaluate("data.explorer.mazes[0].decision.indexOf(1)")
    page.locator(f"#left [data-state='{state}']").dispatch_event("click")
    run = page.evaluate("data.explorer.runs[0]")
    text = page.locator("#state").inner_text()
    assert "a decision point" in text and f"{run['draws'][0][-1][state]} draws" in text
    shape = page.locator(f"#left [data-state='{state}']").get_attribute("d")
    assert page.locator("#left .chosen").get_attribute("d") == shape
    assert page.locator("#right .chosen").get_attribute("d") == shape


def test_play_goes_on_to_the_last_step_and_stops(opened):
    page = opened()
    page.locator("#step").fill("7")
    page.click("#play")
    assert page.locator("#play").inner_text() == "Stop"
    page.wait_for_function("document.getElementById('play').textContent === 'Play'")
    assert page.locator("#step").input_value() == "9"
    page.click("#play")  # from the beginning
    page.click("#play")
    assert page.locator("#play").inner_text() == "Play"
    assert int(page.locator("#step").input_value()) < 9


def test_figures_are_searched(opened):
    page = opened()
    shown = page.locator("article.figure:not([hidden])")
    every = shown.count()
    page.fill("#figure-search", "pendulum curvature")
    assert 0 < shown.count() < every
    assert page.locator("#figure-count").inner_text() == f"{shown.count()} of {every} figures"
    page.evaluate("location.hash = '#figure-fig04'")  # a link to a hidden one shows it
    page.wait_for_selector("#figure-fig04:not([hidden])")
    assert shown.count() == every


def test_the_ledger_is_filtered_and_sorted(opened):
    page = opened()
    rows = page.locator("#ledger tbody tr:not([hidden])")
    texts = lambda column: rows.locator(f"td:nth-child({column})").all_inner_texts()  # noqa: E731
    pooled = rows.count()
    page.check("#claim-single")
    assert rows.count() > pooled
    page.uncheck("#claim-single")
    assert rows.count() == pooled
    page.select_option("#claim-verdict", "not reproduced")
    assert 0 < rows.count() < pooled and set(texts(8)) == {"not reproduced"}
    page.select_option("#claim-verdict", "")
    page.select_option("#claim-part", "beyond")
    assert set(texts(2)) == {"ours"}
    page.select_option("#claim-figure", "nine_mazes")
    assert set(texts(3)) == {"nine_mazes"}
    page.fill("#claim-search", "oracle DRAWS")
    assert rows.count() and all("oracle" in t.lower() and "draws" in t.lower() for t in texts(1))
    assert page.locator("#claim-count").inner_text().startswith(f"{rows.count()} of ")
    for filter in ("search", "part", "figure"):
        (page.fill if filter == "search" else page.select_option)(f"#claim-{filter}", "")

    def numbers():
        cells = rows.locator("td:nth-child(7)")
        values = cells.evaluate_all("cells => cells.map(cell => cell.dataset.value)")
        known = [value for value in values if value]
        assert values[: len(known)] == known  # those without a number stand at the end
        return [float(value) for value in known]

    page.click("#ledger th:nth-child(7) button")
    assert numbers() == sorted(numbers()) and len(numbers()) > 50
    assert page.locator("#ledger th:nth-child(7)").get_attribute("aria-sort") == "ascending"
    page.click("#ledger th:nth-child(7) button")
    assert numbers() == sorted(numbers(), reverse=True)
    page.select_option("#claim-sort", "2 1")
    assert texts(3) == page.evaluate(
        "names => names.sort((a, b) => a.localeCompare(b, 'en', { numeric: true }))", texts(3)
    )
    page.select_option("#claim-sort", "")
    assert (
        page.locator("#ledger tbody tr").first.get_attribute("data-claim") == "uniform_unreliable"
    )


@pytest.mark.parametrize(
    ("width", "theme"),
    [
        *((390, "light"), (1280, "dark")),
        *(
            pytest.param(*other, marks=pytest.mark.slow)
            for other in ((390, "dark"), (1280, "light"))
        ),
    ],
)
def test_it_fits_the_screen_in_both_themes(opened, width, theme, tmp_path):
    for path in ("index.html", "docs/criterion.html"):
        page = opened(width, theme, path)
        assert page.evaluate("document.documentElement.scrollWidth") == width, path
        page.screenshot(path=tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 10_000
        assert (brightness(page) < 60) == (theme == "dark")
    top = (
        opened(width, theme)
        .locator(".top nav")
        .evaluate("nav => nav.scrollWidth - nav.clientWidth")
    )
    assert top <= 0  # no link of the navigation is cut off
