import asyncio
from typing import Any

from gateway.panel.gateway_client import GatewayWatch
from gateway.panel.state.fleet import FleetState


class Gateway:
    """Its first answer waits until the test lets it go."""

    def __init__(self) -> None:
        self.asked = 0
        self.first = asyncio.Event()

    async def ask(self, _: str) -> dict[str, Any]:
        self.asked += 1
        answer = {"number": self.asked, "recorder": None, "aircraft": []}
        if self.asked == 1:
            await self.first.wait()
        return answer


async def test_a_late_answer_does_not_replace_a_later_one() -> None:
    gateway = Gateway()
    watch = GatewayWatch(gateway, FleetState())  # type: ignore[arg-type]
    early = asyncio.create_task(watch.refresh())
    while not gateway.asked:
        await asyncio.sleep(0)
    late = asyncio.create_task(watch.refresh())
    for _ in range(10):
        await asyncio.sleep(0)
    gateway.first.set()
    await asyncio.gather(early, late)
    assert watch.status is not None
    assert watch.before is not None
    assert (watch.before["number"], watch.status["number"]) == (1, 2)
