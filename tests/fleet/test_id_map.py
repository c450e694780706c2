"""System ids given once and kept, in memory and on the disk."""

import asyncio
import json
import random
import re
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway import output
from gateway.fleet import id_map
from gateway.fleet.id_map import FIRST_ID, LAST_ID, MAX_WAITING, Handover, IdMap, IdsFile

pytestmark = pytest.mark.io


TRANSCRIPTS = {
    "first vehicle keeps its id, the second gets the lowest free one":
        "a/1=1 b/1=2 b/7=7 c/1=3 a/1=1 b/1=2 c/1=3 2:b/1 9:-",
    "no vehicle gets the id of a ground station": "a/1=1 c/255=2",
    "id assigned by the operator is swapped":
        "a/1=1 b/1=2 c/1=3 d/1=4 b/1!0 d/1!1 a/1=4 c/1=3 d/1=1 e/1!3 c/1=2 e/1=3 f/1!9 f/1=9",
    "site gets no more ids than its limit, save by the operator":
        "f/1=1 f/2=2 f/3=3 f/4=- f/5=- g/1=4 f/4!9 f/4=9",
    "sites of one client share the limit of one site":
        "a@x b@x c@x a/1=1 a/2=2 b/1=3 b/2=- c/1=- f/1=4 c@y c/1=5 b/2=-",
}  # fmt: skip
"""Ids of vehicles: given (=), assigned by hand or left out (!), looked up (:); the client of a site
(@). A site has at most three."""


@pytest.mark.parametrize("name", TRANSCRIPTS)
def test_ids_are_given_and_assigned(name: str) -> None:
    ids = IdMap(per_site=3)
    for word in TRANSCRIPTS[name].split():
        left, mark, right = re.split("([=!:@])", word)
        site, system = left[0], int(left[2:] or 0)
        if mark == "=":
            assert ids.id_of(site, system) == (None if right == "-" else int(right)), word
        elif mark == ":":
            found = ids.vehicle_of(int(left))
            assert found == (None if right == "-" else (right[0], int(right[2:]))), word
        elif mark == "@":
            ids.set_client(site, right)
        elif right == "0":
            ids.leave_out(site, system)
        else:
            ids.set_by_hand(site, system, int(right))
    assert IdMap(dict(ids.items())).items() == ids.items()


def test_id_out_of_range_is_refused() -> None:
    for wrong in (0, 250):
        with pytest.raises(ValueError, match="1 to 249"):
            IdMap().set_by_hand("a", 1, wrong)


def filled(sites: int, systems: int = LAST_ID) -> IdMap:
    """Return a map that as many sites have filled as far as they could."""
    ids = IdMap()
    for number in range(sites):
        for system_id in range(1, systems + 1):
            ids.id_of(f"many-{number}", system_id)
    return ids


def test_vehicles_beyond_the_number_of_ids_wait_for_a_free_one() -> None:
    ids = filled(LAST_ID + 2, 1)
    assert sorted(own_id for _, own_id in ids.items()) == list(range(FIRST_ID, LAST_ID + 1))
    assert ids.unmapped == {("many-249", 1), ("many-250", 1)}
    ids.leave_out("many-7", 1)
    assert ids.id_of("many-7", 1) is None
    assert ids.id_of("many-250", 1) == 8
    assert ids.id_of("many-249", 1) is None
    # One that the operator moves leaves its former id.
    ids.leave_out("many-9", 1)
    ids.set_by_hand("many-0", 1, 10)
    assert ids.id_of("many-249", 1) == 1
    assert not ids.unmapped
    again = IdMap(dict(ids.items()))
    assert again.id_of("many-7", 1) is None
    assert again.left_out == {("many-7", 1), ("many-9", 1)}
    again.set_by_hand("many-7", 1, 8)
    assert again.id_of("many-7", 1) == 8
    assert again.vehicle_of(8) == ("many-7", 1)
    assert again.left_out == {("many-9", 1)}


@pytest.mark.parametrize("sites", [1, 2, 5])
def test_no_site_takes_all_ids(sites: int) -> None:
    ids = filled(sites)
    assert ids.id_of("field", 7) is not None
    assert ids.id_of("many-0", 249) is None


def test_room_is_made_within_the_limit_of_a_client() -> None:
    ids = IdMap(per_site=3)
    for site in "ab":
        ids.set_client(f"forged-{site}", "forger")
    given = [ids.id_of("forged-a", 1), ids.id_of("forged-a", 2), ids.id_of("forged-a", 3)]
    assert (given, ids.id_of("forged-b", 1)) == ([1, 2, 3], None)
    ids.id_of("field", 1)
    for system in range(1, 6):
        ids.set_by_hand("large", system, 10 + system)
    received_us = {vehicle: 1000 for vehicle, _ in ids.items()}
    for idle in (("field", 1), ("large", 1)):
        assert ids.make_room(received_us | {idle: 0}, 1000) is None
    done = ids.make_room(received_us | {("forged-a", 1): 0}, 1000)
    assert done is not None
    assert (done.former, done.holder) == (("forged-a", 1), ("forged-b", 1))


def test_received_vehicle_keeps_its_id() -> None:
    ids = filled(8)
    assert ids.id_of("field", 7) is None
    before = ids.items()
    received_us = {vehicle: 1000 for vehicle, _ in before}
    assert ids.make_room(received_us, 1000) is None
    assert ids.items() == before
    idle = min(vehicle for vehicle, _ in before)
    received_us[idle] = 999
    done = ids.make_room(received_us, 1000)
    assert done == Handover(dict(before)[idle], idle, ("field", 7))
    assert ids.id_of("field", 7) == done.own_id
    assert ids.id_of(*idle) is None, "it waits in its turn"


def test_site_gets_no_id_of_a_smaller_site() -> None:
    ids = filled(8)
    received_us = {vehicle: 1000 for vehicle, _ in ids.items()}
    shares = Counter(site for site, _ in received_us)
    (smallest, *_, largest) = sorted(received_us, key=lambda each: shares[each[0]])
    assert largest[0] == "many-0"
    received_us[smallest] = 1
    ids.unmapped = {each for each in ids.unmapped if each[0] == "many-0"}
    assert ids.make_room(received_us, 1000) is None
    received_us[largest] = 2
    done = ids.make_room(received_us, 1000)
    assert done is not None
    assert (done.former, done.holder[0]) == (largest, "many-0")


def test_number_of_waiting_vehicles_is_bounded() -> None:
    ids = filled(8)
    for number in range(MAX_WAITING):
        assert ids.id_of(f"s{number}", 1) is None
    assert len(ids.unmapped) == MAX_WAITING


@pytest.mark.parametrize("seed", range(20))
def test_no_two_vehicles_share_an_id_after_random_operations(seed: int) -> None:
    chance = random.Random(seed)
    ids = IdMap()
    for _ in range(400):
        site, system = f"s{chance.randrange(60)}", chance.randrange(1, 9)
        if chance.random() < 0.3:
            ids.set_by_hand(site, system, chance.randint(FIRST_ID, LAST_ID))
        else:
            ids.id_of(site, system)
        given = [own_id for _, own_id in ids.items()]
        assert len(set(given)) == len(given)
        for vehicle, own_id in ids.items():
            assert ids.vehicle_of(own_id) == vehicle


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[IdsFile]:
    made = IdsFile(tmp_path / "folder" / "fleet.json")
    yield made
    made.close()


def on_disk(kept: IdsFile) -> object:
    return json.loads(kept.file.read_bytes())


async def test_ids_are_saved_for_the_next_start(kept: IdsFile) -> None:
    assert await kept.keep() == ""
    assert not kept.file.exists()
    kept.ids.set_by_hand("field-a", 1, 77)
    kept.ids.leave_out("field-b", 2)
    assert await kept.keep() == ""
    assert on_disk(kept) == {"field-b/2": 0, "field-a/1": 77}
    again = IdsFile(kept.file)
    assert again.ids.items() == kept.ids.items()
    again.close()


async def test_keep_waits_for_the_disk(kept: IdsFile, monkeypatch: pytest.MonkeyPatch) -> None:
    may_write, begun, write_new = threading.Event(), asyncio.Event(), output.write_new
    loop = asyncio.get_running_loop()

    def slow(path: Path, pieces: list[bytes], *, overwrite: bool) -> int:
        loop.call_soon_threadsafe(begun.set)
        may_write.wait()
        return write_new(path, pieces, overwrite=overwrite)

    monkeypatch.setattr(id_map, "write_new", slow)
    kept.ids.set_by_hand("field-a", 1, 77)
    keeping = asyncio.create_task(kept.keep())
    try:
        await begun.wait()
        assert not keeping.done()
    finally:
        may_write.set()
    assert await keeping == ""
    assert on_disk(kept) == {"field-a/1": 77}


async def test_failed_write_is_reported(kept: IdsFile, caplog: pytest.LogCaptureFixture) -> None:
    kept.ids.set_by_hand("field-a", 1, 77)
    kept.file.mkdir(parents=True)
    assert [await kept.keep() for _ in range(2)] == ["Invalid argument"] * 2
    assert [record.getMessage().count("Invalid argument") for record in caplog.records] == [1]
    kept.file.rmdir()
    assert await kept.keep() == ""
    assert on_disk(kept) == {"field-a/1": 77}


async def test_last_ids_are_saved_on_close(kept: IdsFile) -> None:
    kept.ids.set_by_hand("field-a", 1, 77)
    kept.close()
    assert on_disk(kept) == {"field-a/1": 77}
