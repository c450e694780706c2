"""A part gathers, hands over, and gives up what is too much."""

from gateway.live.part import PENDING_LIMIT, TLOG, Part, table_ending


def test_what_is_gathered_is_handed_over_once() -> None:
    part = Part("a", 1, 0)
    part.add(TLOG, b"x")
    part.add(table_ending(3), b"1,")
    part.add(table_ending(3), b"2")
    assert part.size == 4
    assert part.take() == {".tlog": b"x", "_v3.csv": b"1,2"}
    assert part.take() == {}
    assert part.size == 0


def test_too_much_is_counted_but_not_kept() -> None:
    part = Part("a", 1, 0)
    for _ in range(3):
        part.add(TLOG, bytes(PENDING_LIMIT))
    assert part.size == 3 * PENDING_LIMIT
    assert len(part.take()[TLOG]) == PENDING_LIMIT
