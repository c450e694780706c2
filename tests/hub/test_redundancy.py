"""Which clients are links to one peer, on the manual clock."""

from gateway.hub.redundancy import LINKED_US, RedundantLinks


def test_a_copy_joins_two_links() -> None:
    links = RedundantLinks()
    assert links.group(1) == (1,)
    assert links.note(2, 1, 0)
    assert not links.note(1, 2, 5)
    assert links.group(1) == links.group(2) == (1, 2)


def test_pairs_that_share_a_client_are_one_group() -> None:
    links = RedundantLinks()
    for pair in ((1, 2), (3, 4), (2, 3)):
        links.note(*pair, 0)
    assert {links.group(n) for n in range(1, 5)} == {(1, 2, 3, 4)}


def test_without_copies_they_part() -> None:
    links = RedundantLinks()
    links.note(1, 2, 0)
    links.note(3, 4, 10)
    links.expire(LINKED_US)
    assert links.group(1) == (1, 2)
    links.expire(LINKED_US + 1)
    assert links.group(1) == (1,)
    assert links.group(3) == (3, 4)


def test_who_has_gone_is_in_no_group() -> None:
    links = RedundantLinks()
    links.note(1, 2, 0)
    links.note(2, 3, 0)
    links.forget(2)
    assert [links.group(n) for n in (1, 2, 3)] == [(1,), (2,), (3,)]
