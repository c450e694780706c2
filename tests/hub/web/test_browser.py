"""The page of docs/programs.md in a browser: it draws the horizon from raw frames."""

import asyncio
import re
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from playwright.async_api import Page, async_playwright
from pymavlink.dialects.v20 import common as dialect

from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S

CHROMIUM = shutil.which("chromium")
PROGRAMS = Path(__file__).resolve().parents[3] / "docs" / "programs.md"
SKY, GROUND = [74, 163, 223], [122, 90, 58]

pytestmark = [
    pytest.mark.io,
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine"),
]


def documented_page(port: int) -> str:
    """Take the page out of the document, as a reader would, for a port of ours."""
    lines = re.search(r"^<canvas.*?^</script>$", PROGRAMS.read_text(), re.M | re.S)
    assert lines is not None
    return lines[0].replace("127.0.0.1:56781", f"127.0.0.1:{port}")


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox"], timeout=4000 * START_LIMIT_S
        )
        page = await browser.new_page()
        page.set_default_timeout(1000 * START_LIMIT_S)
        yield page
        await browser.close()


async def serve(html: str, host: str) -> asyncio.Server:
    """Serve one page at every path."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        body = f"<!doctype html>{html}".encode()
        head = f"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {len(body)}\r\n"
        writer.write(f"{head}Connection: close\r\n\r\n".encode() + body)
        await writer.drain()
        writer.close()

    return await asyncio.start_server(answer, host, 0)


async def colour(page: Page, x: int, y: int) -> list[int]:
    script = f"[...draw.getImageData({x}, {y}, 1, 1).data].slice(0, 3)"
    found: list[int] = await page.evaluate(script)
    return found


async def until_colour(page: Page, pixel: tuple[int, int], wanted: list[int]) -> None:
    async with asyncio.timeout(START_LIMIT_S):
        while await colour(page, *pixel) != wanted:
            await asyncio.sleep(0.01)


async def test_documented_page_draws_the_horizon(rig: Rig, page: Page) -> None:
    hub = rig.hub("ws-listen:127.0.0.1:0")
    server = await serve(documented_page(hub.listening_ports()[0]), "127.0.0.1")
    async with server:
        await page.goto(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/")
        await rig.until(lambda: bool(hub.clients()))

        def show(roll_rad: float, pitch_rad: float) -> None:
            message = dialect.MAVLink_attitude_message(5, roll_rad, pitch_rad, 0, 0, 0, 0.1)
            rig.publish(hub, rig.vehicle.heartbeat(), rig.vehicle.pack(message))

        show(0.0, 0.0)
        await until_colour(page, (150, 140), SKY)
        await until_colour(page, (150, 160), GROUND)
        show(0.5, 0.0)
        await until_colour(page, (250, 140), GROUND)
        await until_colour(page, (50, 160), SKY)
        show(0.0, 0.3)
        await until_colour(page, (150, 230), SKY)
        await until_colour(page, (150, 250), GROUND)
        assert hub.clients()[0].dropped == 0


async def test_page_of_a_foreign_origin_receives_nothing(rig: Rig, page: Page) -> None:
    """The browser itself sends the page's origin; that of an opened file and a sandbox is null."""
    hub = rig.hub("ws-listen:127.0.0.1:0")
    await page.set_content(documented_page(hub.listening_ports()[0]))
    async with asyncio.timeout(START_LIMIT_S):
        while not await page.evaluate("socket.readyState === WebSocket.CLOSED"):
            await asyncio.sleep(0.01)
    assert not hub.clients()
    assert hub.listeners()[0].turned_away == 1
