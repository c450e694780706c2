"""Every view at three widths in both themes: nothing cut, nothing overlapping, accessible."""

import json
from collections.abc import Iterator
from typing import Any, Final

import pytest
from playwright.sync_api import Browser, Page

from tests.panel.browsing import Process, needs_chromium, open_page

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]

VIEWS: Final = (
    "flight", "map", "link", "recordings", "calibration", "tuning", "plots", "events",
)  # fmt: skip
WIDTHS: Final = {390: 844, 1024: 768, 1920: 1080}
SWITCH_MS: Final = 200
"""From a click to the view, which the browser shows by itself."""

FAULTS: Final = """
(view) => {
  const section = document.querySelector(`section[data-view='${view}']`);
  const controls = 'button, input, select, a, [role=slider], h1, h2, dt, dd, .chip';
  const seen = (element) => {
    const box = element.getBoundingClientRect();
    const style = getComputedStyle(element);
    return box.width > 1 && box.height > 1 && style.visibility !== 'hidden' && +style.opacity > 0;
  };
  const scrolls = (element) => {
    for (let e = element.parentElement; e && e !== section; e = e.parentElement)
      if (/auto|scroll/.test(getComputedStyle(e).overflowX)) return true;
    return false;
  };
  const found = [];
  const text = (e) => (e.ariaLabel || e.textContent || '').trim().slice(0, 30);
  const name = (e) => `${e.tagName}.${e.className} ${text(e)}`;
  const around = document.querySelectorAll('.head button, .head input, .rail button');
  const all = [...section.querySelectorAll(controls), ...around].filter(seen);
  for (const element of all) {
    const box = element.getBoundingClientRect();
    const is_cut = box.right > innerWidth + 1 || box.left < -1;
    if (is_cut && !scrolls(element)) found.push(`cut: ${name(element)}`);
  }
  const boxes = all.filter((e) => e.matches('button, select, a') && !scrolls(e));
  for (const a of boxes)
    for (const b of boxes) {
      if (a.contains(b) || b.contains(a) || a.compareDocumentPosition(b) & 2) continue;
      const [p, q] = [a.getBoundingClientRect(), b.getBoundingClientRect()];
      const wide = Math.min(p.right, q.right) - Math.max(p.left, q.left);
      const high = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
      const inside = section.contains(a) === section.contains(b);
      if (inside && wide > 2 && high > 2) found.push(`overlap: ${name(a)} and ${name(b)}`);
    }
  return found;
}
"""


@pytest.fixture(scope="module")
def page(browser: Browser, demo: Process) -> Iterator[Page]:
    opened = open_page(browser, demo.link())
    yield opened
    opened.close()


def shown(page: Page, view: str) -> None:
    page.locator(f".rail button[data-view='{view}']").click()
    page.locator(f"section[data-view='{view}'] > *").first.wait_for()
    page.wait_for_timeout(300)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_no_control_is_cut_or_overlapped_and_no_error_is_logged(
    page: Page, width: int, scheme: Any
) -> None:
    troubles: list[str] = []

    def note(message: Any) -> None:
        if message.type == "error":
            troubles.append(message.text)

    page.on("console", note)
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": WIDTHS[width]})
    faults: dict[str, list[str]] = {}
    for view in VIEWS:
        shown(page, view)
        if found := page.evaluate(FAULTS, view):
            faults[view] = found
    page.remove_listener("console", note)
    assert faults == {}
    assert troubles == []


def test_view_is_shown_at_once_without_the_server(page: Page) -> None:
    for view in VIEWS:
        shown(page, view)
    times_ms = [
        page.evaluate(
            """(view) => new Promise((resolve) => {
                const begin = performance.now();
                document.querySelector(`.rail button[data-view='${view}']`).click();
                const section = document.querySelector(`section[data-view='${view}']`);
                const look = () => section.hidden
                    ? requestAnimationFrame(look) : resolve(performance.now() - begin);
                look();
            })""",
            view,
        )
        for view in VIEWS
    ]
    assert min(times_ms) < SWITCH_MS
    assert sorted(times_ms)[len(times_ms) // 2] < SWITCH_MS


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_fault(page: Page, scheme: Any) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core").Axe()
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": 1024, "height": 768})
    faults: dict[str, list[str]] = {}
    for view in VIEWS:
        shown(page, view)
        for fault in axe.run(page).response["violations"]:
            if fault["impact"] in ("serious", "critical"):
                nodes = [node["html"][:160] for node in fault["nodes"][:4]]
                faults.setdefault(view, []).append(f"{fault['id']}: {json.dumps(nodes)}")
    assert faults == {}
