"""The page in Chromium: it opens from disk in silence, answers to mouse and keyboard, and can be read by everyone."""

import re

import numpy as np
import pytest
from chromium import launched
from records import frontier, hostile, make, on_demand, results, write_all

from gsbench.report import merge, study
from gsbench.report.frame import load
from gsbench.report.render import page as of_report
from gsbench.report.render import site as of_site

pytestmark = pytest.mark.slow
WIDTHS = (375, 820, 1440)


@pytest.fixture(scope="module")
def browser():
    yield from launched("--disable-gpu")


def written(of, path, **options):
    """Write the page of some runs to a file."""
    path.write_text(of_report.page("mini", of, **options))
    return path


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The files of a page with everything on it, and of one made of hostile records."""
    root = tmp_path_factory.mktemp("pages")
    records = frontier(lengths=(500, 1000))
    whole = [r for r in records if r.model == "7dgs"]
    records += on_demand(whole) + on_demand(whole, label="7dgs")
    good = written(load(write_all(records, root, pictures=2)), root / "good.html")
    for name, psnr in (("alice", 20.0), ("bob", 30.0)):
        study.write([make(model, "suzanne", 0, psnr + i) for i, model in enumerate(("3dgs", "4dgs"))], root / name)
    site, _ = of_site.write(merge.read([root / "alice", root / "bob"]), root / "site")
    return {"good": good, "hostile": written(results(*hostile()), root / "bad.html"), "site": site}


@pytest.fixture
def visit(browser, pages):
    """Opens a page and returns it with what it asked for and complained of."""
    contexts = []

    def open_page(name="good", width=1280, scheme="light", **options):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, **options)
        contexts.append(context)
        page = context.new_page()
        page.asked, page.complaints = [], []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("console", lambda message: page.complaints.append(message.text))
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.goto(pages[name].as_uri())
        if options.get("java_script_enabled", True):
            page.evaluate("Promise.all([...document.querySelectorAll('.chart')].map(draw))")
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["good", "hostile", "site"])
@pytest.mark.parametrize("width", WIDTHS)
def test_it_opens_in_silence_on_any_screen(visit, name, width, scheme):
    """Catches a console error, a request that leaves the page, a record's script that runs, what makes a phone scroll
    sideways, a table that cannot be scrolled, numbers that do not stand under their header, and, by all rules of
    axe-core, text of too little contrast, controls without a name and headings out of order."""
    page = visit(name, width=width, scheme=scheme)
    page.wait_for_timeout(300)
    assert page.complaints == []
    assert [url for url in page.asked if not url.startswith("data:")] == [page.url]
    assert "owned" not in page.title()
    assert page.locator("img[src='x']").count() == 0
    page = visit(name, width=width, scheme=scheme, bypass_csp=True)  # axe-core is a script of another
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    loose = """() => [...document.querySelectorAll('table')].filter((table) => {
        const box = table.closest('.scroll');
        const fits = table.getBoundingClientRect().width <= box.getBoundingClientRect().width + 1;
        return !fits && !(getComputedStyle(box).overflowX === 'auto' && box.tabIndex === 0);
    }).length"""
    apart = """() => [...document.querySelectorAll('td.number')].filter((cell) => {
        const text = cell.firstChild.getBoundingClientRect(), box = cell.getBoundingClientRect();
        return box.right - text.right > 13;
    }).length"""
    assert page.locator("td.number").count() > 0
    assert (page.evaluate(loose), page.evaluate(apart)) == (0, 0)
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python (dev extra)")
    violations = axe.Axe().run(page).response["violations"]
    assert [(v["id"], v["nodes"][0]["html"][:160], v["nodes"][0].get("failureSummary")) for v in violations] == []


def test_the_slider_by_mouse_and_keyboard(visit):
    """Catches a slider that does not move the edge between the images, and choices that do not change them."""
    page = visit()
    slider, over, under = (page.locator(f".stage {name}") for name in ("input", ".over", ".under"))
    share = lambda: page.locator(".compare").evaluate("e => e.style.getPropertyValue('--share')")  # noqa: E731
    slider.focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    assert share() == "55%"
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.mouse.click(box["x"] + 0.2 * box["width"], box["y"] + box["height"] / 2)
    assert int(share()[:-1]) in range(17, 24)
    before = over.get_attribute("src"), under.get_attribute("src")
    page.locator(".left").select_option(label="3dgs, error")
    page.locator(".view").select_option(index=1)
    assert not {over.get_attribute("src"), under.get_attribute("src")} & {*before}
    assert over.get_attribute("alt").startswith("3dgs, error of ")
    assert re.fullmatch(r"3dgs, error: PSNR \d\d\.\d\d dB", page.locator(".left-name").inner_text())
    assert page.locator(".right-name").inner_text() == "ground truth"
    assert over.evaluate("i => i.naturalWidth") == 60


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_in_drawings_has_contrast(visit, scheme):
    """Catches text of SVG that fades into its theme, which axe-core does not look at."""
    colours = visit(scheme=scheme).evaluate(
        """() => {
            const back = getComputedStyle(document.body).backgroundColor;
            const fills = [...document.querySelectorAll('svg text')].map((t) => getComputedStyle(t).fill);
            return [back, ...new Set(fills)];
        }"""
    )
    rgb = np.array([[int(part) / 255 for part in colour[4:-1].split(",")] for colour in colours])
    light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722) + 0.05
    assert len(light) > 1
    assert (np.maximum(light[1:], light[0]) / np.minimum(light[1:], light[0])).min() >= 4.5  # WCAG


MARKS = "#g0-frontier .chart >> nth=0 >> .mark-symbol path[aria-label]"


def test_figures_answer(visit):
    """Catches a name in the legend that hides nothing, or in one section only; a choice of a scene that draws nothing
    else, or that a reload forgets; and points without a tooltip, or with one that leaves the screen."""
    page = visit(width=390)
    lines = page.locator("#g0-curves .mark-line path")
    labels = lambda: sorted(page.locator(MARKS).evaluate_all("all => all.map((mark) => mark.ariaLabel)"))  # noqa: E731
    before = lines.count(), labels()
    entry = page.locator("#g0-frontier button.model", has_text=re.compile("^7dgs_noagr$"))
    entry.focus()
    page.keyboard.press("Enter")
    page.wait_for_timeout(300)
    assert entry.get_attribute("aria-pressed") == "false"
    assert lines.count() < before[0]
    assert len(labels()) < len(before[1])
    page.locator("#g0-curves button.model", has_text=re.compile("^7dgs_noagr$")).click()
    page.wait_for_timeout(300)
    assert (lines.count(), labels()) == before
    page.locator(MARKS).last.hover(force=True)
    tip = page.locator("#vg-tooltip-element.visible")
    tip.wait_for()
    assert "PSNR, dB" in tip.inner_text()
    box = tip.bounding_box()
    assert 0 <= box["x"] <= box["x"] + box["width"] <= 390
    page.locator("#g0-frontier select.scene").select_option("suzanne")
    page.wait_for_timeout(300)
    assert labels()
    assert labels() != before[1]
    page.reload()
    assert page.locator("#g0-frontier select.scene").input_value() == "suzanne"


def test_a_table_of_a_site_is_sorted_and_filtered(visit):
    """Catches a title that sorts numbers as texts, a group that loses its name, and a filter that hides other rows."""
    page = visit("site")
    rows = page.locator(".sortable >> nth=0 >> tr")

    def column(i):
        cells = rows.locator(f"td:nth-child({i})").all()
        return [cell.text_content().strip() for cell in cells if cell.is_visible()]

    assert column(4) == ["20.00", "30.00", "21.00", "31.00"]
    title = page.locator(".sort", has_text=re.compile("^PSNR$")).first
    title.click()
    assert column(4) == ["31.00", "30.00", "21.00", "20.00"]
    assert rows.locator("td:first-child").first.get_attribute("class") in (None, "")
    title.click()
    assert column(4) == ["20.00", "21.00", "30.00", "31.00"]
    page.locator("label", has_text=re.compile("^contributor")).locator("select").select_option("bob")
    assert column(3) == ["bob", "bob"]
    assert "2 of 4 rows" in page.get_by_role("status").first.inner_text()
    page.get_by_role("link", name="Figures and statistics").click()
    assert page.locator("h1").inner_text() == "mini"


def test_it_prints_and_has_its_tables_without_script(visit):
    """Catches a page that cannot be printed, and numbers that only a script shows."""
    page = visit()
    page.emulate_media(media="print")
    assert page.locator(".controls").first.is_hidden()
    assert len(page.pdf()) > 10_000
    plain = visit(java_script_enabled=False)
    assert plain.locator("#g0-experiment table").is_visible()
    assert "Figures need JavaScript" in plain.locator("noscript").inner_text()


def test_a_live_page_loads_itself_again(browser, tmp_path):
    """Catches a page that stays old while runs arrive, and one that takes the slider out of a reader's hand."""
    runs = frontier(("3dgs", "4dgs"), ("suzanne",), 2, (1000,))
    folder = write_all(runs[:2], tmp_path, pictures=1)
    page = browser.new_page()
    page.goto(written(load(folder), tmp_path / "live.html", reload=1).as_uri())
    assert "2 runs" in page.locator(".summary").inner_text()
    page.locator(".stage input").focus()
    write_all(runs, tmp_path, pictures=1)
    written(load(folder), tmp_path / "live.html", reload=1)
    page.wait_for_timeout(2500)
    assert "2 runs" in page.locator(".summary").inner_text()
    page.locator(".stage input").evaluate("input => input.blur()")
    page.get_by_text("4 runs").first.wait_for(timeout=15_000)
    page.close()
