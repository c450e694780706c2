"""A gateway on its simulated receiver with its panel, and a browser, for all tests of pages."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

from tests.panel.browsing import Process, launch
from tests.panel.test_map_tiles import picture, tiles_around, write_mbtiles


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        opened = launch(playwright)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    folder = tmp_path_factory.mktemp("demo")
    for name, shade in (("field", 40), ("other", 200)):
        write_mbtiles(folder / f"{name}.mbtiles", picture(shade), tiles_around(-7.77, 110.38))
    started = Process(folder, "demo", "--plain")
    yield started
    started.end()
