"""The page in Chromium: it opens from disk in silence, answers to mouse and keyboard, and can be read by everyone."""

import re

import pytest
from chromium import launched
from many_records import frontier, hostile, on_demand, write_all

from gsbench.report.page import build

pytestmark = pytest.mark.slow
WIDTHS = (375, 820, 1440)


@pytest.fixture(scope="module")
def browser():
    yield from launched("--disable-gpu")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The files of a page with everything on it, and of one made of hostile records."""
    root = tmp_path_factory.mktemp("pages")
    records = frontier(lengths=(500, 1000))
    whole = [r for r in records if r.model == "7dgs"]
    records += on_demand(whole) + on_demand(whole, label="7dgs")
    good = build.write(records, write_all(records, root, pictures=2))
    (root / "bad").mkdir()
    return {"good": good, "hostile": build.write(hostile(), root / "bad")}


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
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["good", "hostile"])
def test_it_opens_in_silence(visit, name, scheme):
    """Catches a console error, a request that leaves the page, and a record's script that runs."""
    page = visit(name, scheme=scheme)
    page.wait_for_timeout(300)
    assert page.complaints == []
    own = [url for url in page.asked if not url.startswith("data:")]
    assert own == [page.url]
    assert "owned" not in page.title()
    assert page.locator("img[src='x']").count() == 0


@pytest.mark.parametrize("name", ["good", "hostile"])
@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_wider_than_the_screen(visit, name, width):
    """Catches a table, a word or a drawing that makes a phone scroll sideways, and a table that cannot be scrolled."""
    page = visit(name, width=width)
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    loose = """() => [...document.querySelectorAll('table')].filter((table) => {
        const box = table.closest('.scroll');
        const fits = table.getBoundingClientRect().width <= box.getBoundingClientRect().width + 1;
        return !fits && !(getComputedStyle(box).overflowX === 'auto' && box.tabIndex === 0);
    }).length"""
    assert page.evaluate(loose) == 0


def test_no_table_is_cut_on_a_wide_screen(visit):
    """Catches a last column that must be scrolled for at 1,440 pixels, and a phone on which a row loses its name."""
    page = visit(width=1440)
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    boxes = page.locator(".scroll").evaluate_all("all => all.map(s => [s.ariaLabel, s.scrollWidth - s.clientWidth])")
    assert len(boxes) > 5
    assert [name for name, more in boxes if more > 0] == []
    narrow = visit(width=390).locator('[aria-label="stages.csv"]')
    narrow.evaluate("box => { box.scrollLeft = 1000; }")
    edge = narrow.bounding_box()["x"]
    assert narrow.locator("tbody td:first-child").first.bounding_box()["x"] == pytest.approx(edge, abs=1)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_first_screen_holds_the_answers(visit, width):
    """Catches an answer that one must scroll for: four budgets with their models and intervals."""
    page = visit(width=width)
    answers = page.locator(".answer")
    assert answers.count() == 4
    bottom = answers.last.bounding_box()
    assert bottom["y"] + bottom["height"] <= 900
    assert "95 %" in answers.first.inner_text()


def test_tabs_by_mouse_and_keyboard(visit):
    """Catches tabs that only one of the two can turn, and panels that do not follow."""
    page = visit()
    tabs = page.locator("#g0-frontier [role=tab]")
    panels = page.locator("#g0-frontier [role=tabpanel]")
    assert tabs.count() == panels.count() == 3
    assert [panels.nth(i).is_visible() for i in range(3)] == [True, False, False]
    tabs.nth(1).click()
    assert [panels.nth(i).is_visible() for i in range(3)] == [False, True, False]
    page.keyboard.press("ArrowRight")
    assert [panels.nth(i).is_visible() for i in range(3)] == [False, False, True]
    assert tabs.nth(2).get_attribute("aria-selected") == "true"
    page.keyboard.press("ArrowRight")
    assert panels.nth(0).is_visible()
    page.keyboard.press("End")
    assert panels.nth(2).is_visible()
    page.reload()
    assert panels.nth(2).is_visible(), "a page that loads itself again forgets its tab"


def test_the_legend_hides_a_model(visit):
    """Catches a name that hides nothing, hides it in one section only, or leaves its points to the pointer."""
    page = visit()
    entry = page.locator("#g0-frontier button.model", has_text=re.compile("^7dgs$"))
    colour = entry.get_attribute("data-colour")
    hits = page.locator(f'#g0-frontier [role=tabpanel]:not([hidden]) .hit[data-colour="{colour}"]')
    shade = "(id) => getComputedStyle(document.getElementById(id)).getPropertyValue('--model-' + " + colour + ")"
    before = page.evaluate(shade, "g0-frontier")
    assert hits.first.is_visible()
    entry.focus()
    page.keyboard.press("Enter")
    assert entry.get_attribute("aria-pressed") == "false"
    assert [page.evaluate(shade, f"g0-{key}") for key in ("frontier", "quality", "anytime")] == ["transparent"] * 3
    assert page.evaluate(shade, "g0-on-demand") == before, "an effect set has the colour of its model"
    assert not hits.first.is_visible()
    assert page.locator("#g0-frontier button.model[aria-pressed=true]").count() > 0
    page.locator("#g0-anytime button.model", has_text=re.compile("^7dgs$")).click()
    assert page.evaluate(shade, "g0-frontier") == before
    assert hits.first.is_visible()


def test_the_slider_by_mouse_and_keyboard(visit):
    """Catches a slider that does not move the edge between the images, and choices that do not change them."""
    page = visit()
    slider = page.locator(".stage input")
    shares = lambda: page.locator(".compare").evaluate("e => e.style.getPropertyValue('--share')")  # noqa: E731
    assert shares() == "50%"
    slider.focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    assert shares() == "55%"
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    page.mouse.click(box["x"] + 0.2 * box["width"], box["y"] + box["height"] / 2)
    assert int(shares()[:-1]) in range(17, 24)
    over = page.locator(".stage .over")
    before = over.get_attribute("src")
    page.locator(".left").select_option(label="3dgs, error")
    assert over.get_attribute("src") != before
    assert over.get_attribute("alt").startswith("3dgs, error of ")
    assert re.fullmatch(r"3dgs, error: PSNR \d\d\.\d\d dB", page.locator(".left-name").inner_text())
    assert page.locator(".right-name").inner_text() == "ground truth"
    under = page.locator(".stage .under").get_attribute("src")
    page.locator(".view").select_option(index=1)
    assert page.locator(".stage .under").get_attribute("src") != under
    assert page.locator(".left").input_value() == "error:3dgs"
    assert over.evaluate("i => i.naturalWidth") == 60


def test_pointing_at_a_point_names_its_run(visit):
    """Catches points without a name or the command, a card that leaves the screen, and one that cannot be kept."""
    page = visit(width=375)
    page.locator("#g0-frontier [role=tab]").nth(1).click()
    card = page.locator("#card")
    assert card.is_hidden()
    hits = page.locator("#g0-frontier [role=tabpanel]:not([hidden]) .hit")
    lefts = hits.evaluate_all("all => all.map((hit) => hit.getBoundingClientRect().left)")
    for end in (min(lefts), max(lefts)):
        hit = hits.nth(lefts.index(end))
        hit.scroll_into_view_if_needed()
        hit.hover(force=True)
        assert card.is_visible()
        assert "seed" in card.locator(".name").inner_text()
        assert card.locator("code").inner_text().startswith("python -m gsbench ")
        box = card.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 375
        page.mouse.move(0, 0)
        assert card.is_hidden()
    hit.click(force=True)
    page.mouse.move(0, 0)
    assert card.is_visible()
    page.keyboard.press("Escape")
    assert card.is_hidden()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", ["good", "hostile"])
def test_axe_finds_nothing(visit, name, width, scheme):
    """Catches text of too little contrast, controls without a name, headings out of order: all rules of axe-core."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python (dev extra)")
    page = visit(name, width=width, scheme=scheme, bypass_csp=True)
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    found = axe.Axe().run(page).response["violations"]
    assert [(v["id"], v["nodes"][0]["html"][:160], v["nodes"][0].get("failureSummary")) for v in found] == []


def test_text_in_drawings_has_contrast(visit):
    """Catches text of SVG that fades into its theme, which axe-core does not look at."""
    for scheme in ("light", "dark"):
        page = visit(scheme=scheme)
        colours = page.evaluate(
            """() => {
                const back = getComputedStyle(document.body).backgroundColor;
                const fills = [...document.querySelectorAll('svg text')].map((t) => getComputedStyle(t).fill);
                return [back, ...new Set(fills)];
            }"""
        )
        back, *fills = [[int(part) / 255 for part in c[4:-1].split(",")] for c in colours]
        assert fills
        for fill in fills:
            assert ratio(fill, back) >= 4.5, (scheme, fill)


def ratio(a, b):
    """WCAG's contrast of two colours in [0, 1]."""
    linear = [[p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in c] for c in (a, b)]
    light = sorted(0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in linear)
    return (light[1] + 0.05) / (light[0] + 0.05)


def test_texts_of_a_drawing_do_not_overlap(visit):
    """Catches ticks and labels that run into each other at any width."""
    for width in WIDTHS:
        page = visit(width=width)
        clashes = page.evaluate(
            """() => [...document.querySelectorAll("figure svg")].filter((s) => s.clientWidth).flatMap((svg) => {
                const boxes = [...svg.querySelectorAll('text')].map((t) => [t.textContent, t.getBoundingClientRect()]);
                const hits = [];
                boxes.forEach(([a, p], i) => boxes.slice(i + 1).forEach(([b, q]) => {
                    const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
                    const high = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
                    if (wide > 1 && high > 3) hits.push(`${svg.ariaLabel.slice(0, 40)}: ${a} / ${b}`);
                }));
                return hits;
            })"""
        )
        assert clashes == [], width


def test_it_prints(visit):
    """Catches a page that cannot be printed: hidden scenes are shown, controls are not."""
    page = visit()
    page.emulate_media(media="print")
    assert all(page.locator("[role=tabpanel]").nth(i).is_visible() for i in range(3))
    assert page.locator("[role=tablist]").first.is_hidden()
    assert len(page.pdf()) > 10_000


def test_it_reads_without_script(visit):
    """Catches text and figures that only a script makes."""
    page = visit(java_script_enabled=False)
    assert page.locator("#g0-frontier svg").first.is_visible()
    assert page.locator("[role=tabpanel]").nth(2).is_visible()


def test_a_live_page_loads_itself_again(browser, tmp_path):
    """Catches a page that stays old while runs arrive, and one that takes the slider out of a reader's hand."""
    records = frontier(("3dgs", "4dgs"), ("suzanne",), 2, (1000,))
    folder = write_all(records, tmp_path, pictures=1)
    page = browser.new_page()
    page.goto(build.write(records[:2], folder, reload=1).as_uri())
    assert "2 runs" in page.locator(".summary").inner_text()
    page.locator(".stage input").focus()
    build.write(records, folder, reload=1)
    page.wait_for_timeout(2500)
    assert "2 runs" in page.locator(".summary").inner_text()
    page.locator(".stage input").evaluate("input => input.blur()")
    page.get_by_text("4 runs").first.wait_for(timeout=10_000)
    page.close()
