"""Many lines summed up, on the manual clock."""

from gateway.hub.log_rate_limiter import WINDOW_US, Digest


def test_a_few_in_full_and_the_rest_as_a_number() -> None:
    digest = Digest(2, "more came")
    assert [digest.say(line, 0) for line in "abcde"] == [["a"], ["b"], [], [], []]
    assert digest.poll(WINDOW_US - 1) == []
    assert digest.poll(WINDOW_US) == ["3 more came"]
    assert digest.poll(3 * WINDOW_US) == []
    assert digest.say("f", 3 * WINDOW_US) == ["f"]


def test_the_sum_comes_before_the_next_line() -> None:
    digest = Digest(1, "more came")
    for line in "abc":
        digest.say(line, 0)
    assert digest.say("d", WINDOW_US) == ["2 more came", "d"]
