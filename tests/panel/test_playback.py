"""The page's player, with processes and answers that the test controls."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from gateway.live.control_socket import ControlError
from gateway.panel import playback as playback_module
from gateway.panel.playback import (
    MAX_PLAYERS,
    RECORDED,
    Playback,
    PlaybackError,
    Profile,
    RecordedAircraft,
)
from gateway.panel.state.fleet import FleetState, Origin
from tests.panel.messages import heartbeat


class Player:
    """Takes every request at once; its answers wait for `answers`."""

    def __init__(self, *, is_playing: bool = True) -> None:
        self.asked: list[str] = []
        self.answers = asyncio.Event()
        self.answers.set()
        self.refusals = 0
        self._state = "playing" if is_playing else "paused"

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


@pytest.fixture
def player() -> Player:
    return Player()


@pytest.fixture
def playback(player: Player) -> Playback:
    made = Playback(None, FleetState(), "page")
    made._control = player
    made.status = {"state": "playing", "position_s": 0.0}
    return made


async def started(task: asyncio.Task[None], player: Player) -> asyncio.Task[None]:
    while not player.asked:
        await asyncio.sleep(0)
    return task


async def test_late_status_does_not_undo_a_later_pause(playback: Playback, player: Player) -> None:
    player.answers.clear()
    asking = await started(asyncio.create_task(playback.refresh()), player)
    pausing = asyncio.create_task(playback.toggle())
    for _ in range(10):
        await asyncio.sleep(0)
    player.answers.set()
    await asyncio.gather(asking, pausing)
    assert playback.status is not None
    assert playback.status["state"] == "paused"


async def test_two_quick_toggles_pause_and_resume(playback: Playback, player: Player) -> None:
    await asyncio.gather(playback.toggle(), playback.toggle())
    assert player.asked == ["play.pause", "play.resume"]


async def test_answer_after_closing_is_ignored(playback: Playback, player: Player) -> None:
    player.answers.clear()
    asking = await started(asyncio.create_task(playback.refresh()), player)
    playback.close()
    player.answers.set()
    await asking
    assert playback.status is None


class Child:
    """A process that runs until it is ended."""

    returncode: int | None = None

    def terminate(self) -> None:
        self.returncode = -15


async def test_opening_waits_for_a_player_that_refuses_at_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, player: Player
) -> None:
    """A socket is in its folder before its process listens to it."""
    player.refusals = 3

    async def start(*_: object, env: dict[str, str], **__: object) -> Child:
        socket = Path(env["XDG_RUNTIME_DIR"]) / "mavgate" / "play.sock"
        socket.parent.mkdir()
        socket.touch()
        return Child()

    monkeypatch.setattr(playback_module, "STEP_S", 0.0)
    monkeypatch.setattr(playback_module, "ControlClient", lambda _: player)
    monkeypatch.setattr(asyncio, "create_subprocess_exec", start)
    monkeypatch.setattr(playback_module, "look_into", lambda _: [[]])
    (tmp_path / "day_01.tlog").write_bytes(b"")

    class Uplink:
        playback_port = 1

    playback = Playback(Uplink(), FleetState(), "page")
    await playback.open(tmp_path, "day", fused_again=False)
    assert playback.status == {"state": "playing", "position_s": 0.0}
    playback.close()
    assert playback.status is None


async def test_recording_is_visible_only_on_the_page_that_opened_it() -> None:
    fleet = FleetState()
    playback = Playback(None, fleet, "mine")
    recorded = RecordedAircraft(1, RECORDED, Profile())
    (first,) = playback._number([[recorded]])
    fleet.update(heartbeat(), 0)
    fleet.update(heartbeat(system_id=first), 0)
    assert set(fleet.visible("mine")) == {1, first}
    assert set(fleet.visible("another")) == set(fleet.visible("")) == {1}
    other = Playback(None, fleet, "another")
    assert other._number([[recorded]]) != [first]
    playback.close()
    assert set(fleet.visible("mine")) == {1}


async def test_number_of_players_is_limited(tmp_path: Path) -> None:
    fleet = FleetState()
    for n in range(MAX_PLAYERS):
        fleet.origins[100 + n] = Origin(RECORDED, 1, f"page {n}")
    with pytest.raises(PlaybackError, match="close one of them first"):
        await Playback(None, fleet, "one more").open(tmp_path, "day", fused_again=False)
