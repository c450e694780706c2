"""Names and texts that try to become scripts, fed through every view of a real page."""

import contextlib
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page
from pymavlink.dialects.v20 import all as mavlink

from tests.panel.browsing import WAIT_MS, Process, needs_chromium, open_page, show
from tests.panel.scripted_vehicle import SendingVehicle
from tests.panel.test_recording_files import flight

pytestmark = [pytest.mark.io, pytest.mark.slow, needs_chromium]

CONFIG = """
[recording]
folder = "{folder}/recordings"
[panel]
port = 0
tiles_folder = "{folder}/tiles"
map_styles = []
"""
NAMES = ["B :a=q=1", 'B :a="q=1"', '"onload=q=1 ', "<img/onerror=q>", "`${q=1}`", "'+(q=1)+'",
         "{{q=1}}", "x :style=q=1", "' :id='q=1'", "\u202edoog"]  # fmt: skip
MARKUP = '<img src=x onerror=q=1><script>q=1</script>`${q=1}` :a="q=1" {{q=1}}'
VIEWS = (
    "flight", "map", "link", "recordings", "calibration", "tuning", "plots", "events",
)  # fmt: skip


class HostileVehicle(SendingVehicle):
    """Sends parameters, texts and named values whose names are scripts."""

    def __init__(self) -> None:
        super().__init__(0.2)

    def _messages(self) -> Iterator[mavlink.MAVLink_message]:
        yield mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3)
        yield mavlink.MAVLink_attitude_message(0, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0)
        yield mavlink.MAVLink_global_position_int_message(
            0, 470_000_000, 80_000_000, 500_000, 60_000, 0, 0, 0, 0
        )
        for number, name in enumerate(NAMES):
            raw = name.encode()[:16]
            yield mavlink.MAVLink_param_value_message(raw, number / 3, 9, len(NAMES), number)
            yield mavlink.MAVLink_named_value_float_message(0, raw[:10], 1.0)
            yield mavlink.MAVLink_debug_vect_message(raw[:10], 0, 1.0, 2.0, 3.0)
        for part in range(0, len(MARKUP), 50):
            text = MARKUP[part : part + 50].encode()
            yield mavlink.MAVLink_statustext_message(2, text, 7, part // 50)


@pytest.fixture(scope="module")
def page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "recordings").mkdir()
    for name in NAMES:
        with contextlib.suppress(OSError):
            (folder / "recordings" / f"{name.replace('/', '')}_01.tlog").write_bytes(flight())
    vehicle = HostileVehicle()
    vehicle.start()
    connect = f"udp-listen:127.0.0.1:{vehicle.port}"
    panel = Process(folder, "panel", "--connect", connect, config=CONFIG)
    opened = open_page(browser, panel.link())
    yield opened
    opened.close()
    panel.end()
    vehicle.end()


def test_no_name_or_text_of_others_runs_as_a_script(page: Page) -> None:
    troubles: list[str] = []
    page.on("console", lambda message: message.type == "error" and troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("dialog", lambda dialog: troubles.append(dialog.message))
    for view in VIEWS:
        show(page, view)
        page.locator(f"section[data-view='{view}'] > *").first.wait_for()
        # Two messages of each kind have come and were drawn.
        page.evaluate("window.begun_us = mavgate.now_us")
        page.wait_for_function("mavgate.now_us > window.begun_us + 4e5")
        assert page.evaluate("typeof q") == "undefined"
    show(page, "tuning")
    names = page.locator(".parameter .name")
    page.wait_for_function(
        f"document.querySelectorAll('.parameter').length === {len(NAMES)}", timeout=WAIT_MS
    )
    shown = set(names.all_inner_texts())
    assert {'B :a="q=1"', "<img/onerror=q>", "{{q=1}}"} <= shown
    rows = page.locator(".parameter").evaluate_all("rows => rows.map(row => row.dataset.name)")
    assert set(rows) >= {name for name in NAMES if name.isascii()}
    show(page, "events")
    page.locator(".events").get_by_text("<img src=x onerror=q=1>").first.wait_for()
    show(page, "recordings")
    page.locator("tr[data-key='{{q=1}}']").wait_for()
    page.locator("tr[data-key='{{q=1}}']").get_by_label("Delete").click()
    page.get_by_role("dialog").get_by_text("{{q=1}}").first.wait_for()
    page.keyboard.press("Escape")
    assert page.evaluate("typeof q") == "undefined"
    assert troubles == []


def test_policy_of_the_page_stops_an_injected_script(page: Page) -> None:
    policy = page.request.get(page.url).headers["content-security-policy"]
    assert "'nonce-" in policy
    page.evaluate(
        """() => {
            const script = document.createElement('script');
            script.textContent = 'window.ran = 1';
            document.body.append(script);
            document.body.insertAdjacentHTML('beforeend', '<img src=x onerror="window.ran = 2">');
        }"""
    )
    page.wait_for_timeout(300)
    assert page.evaluate("typeof ran") == "undefined"
