"""The page's player, with processes and answers that the test controls."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gateway.live.control_socket import ControlError
from gateway.panel import playback as playback_module
from gateway.panel.playback import MAX_PLAYERS, RECORDED, Playback, PlaybackError
from gateway.panel.state.fleet import FleetState, Origin
from tests.kit.process import until
from tests.panel.messages import heartbeat, short_tlog


class Player:
    """Takes every request at once; its answers wait for `answers`."""

    returncode: int | None = None
    """Of its process, which runs until it is ended."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.answers = asyncio.Event()
        self.answers.set()
        self.refusals = 0
        self._state = "playing"

    async def ask(self, verb: str, **_: Any) -> dict[str, Any]:
        self.asked.append(verb)
        if self.refusals:
            self.refusals -= 1
            raise ControlError("nobody listens")
        self._state = {"play.pause": "paused", "play.resume": "playing"}.get(verb, self._state)
        answer = {"state": self._state, "position_s": 0.0}
        await asyncio.sleep(0)
        if verb == "play.status":
            await self.answers.wait()
        return answer

    def terminate(self) -> None:
        self.returncode = -15


@pytest.fixture
def player(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Player:
    """Return the player of each recording; one of an aircraft 1 is in the temporary folder."""
    made = Player()

    async def start(*_: object, **__: object) -> Player:
        return made

    monkeypatch.setattr(playback_module, "STEP_S", 0.0)
    monkeypatch.setattr(playback_module, "ControlClient", lambda _: made)
    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
    (tmp_path / "day_01.tlog").write_bytes(short_tlog())
    return made


async def opened(folder: Path, fleet: FleetState, page: str) -> Playback:
    uplink: Any = SimpleNamespace(playback_port=1)
    made = Playback(uplink, fleet, page)
    await made.open(folder, "day", fused_again=False)
    assert made.status == {"state": "playing", "position_s": 0.0}
    return made


@pytest.fixture
async def playback(player: Player, tmp_path: Path) -> AsyncIterator[Playback]:
    made = await opened(tmp_path, FleetState(), "page")
    # The page's own question follows at once, the next one after a while.
    await until(lambda: len(player.asked) > 1)
    for _ in range(3):
        await asyncio.sleep(0)
    player.asked.clear()
    yield made
    made.close()


async def asking(playback: Playback, player: Player) -> asyncio.Task[None]:
    """Ask for the status, whose answer is late."""
    player.answers.clear()
    task = asyncio.create_task(playback.refresh())
    while not player.asked:
        await asyncio.sleep(0)
    return task


async def test_late_status_does_not_undo_a_later_pause(playback: Playback, player: Player) -> None:
    early = await asking(playback, player)
    pausing = asyncio.create_task(playback.toggle())
    for _ in range(10):
        await asyncio.sleep(0)
    player.answers.set()
    await asyncio.gather(early, pausing)
    assert playback.status is not None
    assert playback.status["state"] == "paused"


async def test_two_quick_toggles_pause_and_resume(playback: Playback, player: Player) -> None:
    await asyncio.gather(playback.toggle(), playback.toggle())
    assert [verb for verb in player.asked if verb != "play.status"] == ["play.pause", "play.resume"]


async def test_answer_after_closing_is_ignored(playback: Playback, player: Player) -> None:
    early = await asking(playback, player)
    playback.close()
    player.answers.set()
    await early
    assert playback.status is None


async def test_player_that_has_ended_is_closed(playback: Playback, player: Player) -> None:
    player.returncode = 1
    await playback.refresh()
    assert (playback.status, playback.name) == (None, "")


async def test_opening_waits_for_a_late_player(player: Player, tmp_path: Path) -> None:
    """A socket is in its folder before its process listens to it."""
    player.refusals = 3
    playback = await opened(tmp_path, FleetState(), "page")
    assert player.asked == ["play.status"] * 4
    playback.close()
    assert (playback.status, player.returncode) == (None, -15)


async def test_recording_is_visible_only_on_its_page(player: Player, tmp_path: Path) -> None:
    fleet = FleetState()
    playback = await opened(tmp_path, fleet, "mine")
    [first] = playback.aircraft
    fleet.update(heartbeat(), 0)
    fleet.update(heartbeat(system_id=first), 0)
    assert set(fleet.visible("mine")) == {1, first}
    assert set(fleet.visible("another")) == set(fleet.visible("")) == {1}
    other = await opened(tmp_path, fleet, "another")
    assert first not in other.aircraft
    for each in (playback, other):
        each.close()
    assert set(fleet.visible("mine")) == {1}


async def test_number_of_players_is_limited(tmp_path: Path) -> None:
    fleet = FleetState()
    for n in range(MAX_PLAYERS):
        fleet.origins[100 + n] = Origin(RECORDED, 1, f"page {n}")
    with pytest.raises(PlaybackError, match="close one of them first"):
        await Playback(None, fleet, "one more").open(tmp_path, "day", fused_again=False)
