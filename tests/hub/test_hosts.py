"""Pages of this machine may connect, others only if they are named."""

import pytest

from gateway.hub.endpoint import admits_page


@pytest.mark.parametrize(
    "origin",
    [
        "http://localhost",
        "https://LOCALHOST:8443",
        "http://panel.localhost:80",
        "http://127.0.0.1:8080",
        "http://127.8.9.1",
        "http://[::1]:8080",
        "http://[::ffff:127.0.0.1]",
        "http://192.168.4.1:8000",
    ],
)
def test_page_of_this_machine_is_admitted(origin: str) -> None:
    assert admits_page(origin, "192.168.4.1", ())


@pytest.mark.parametrize(
    "origin",
    [
        "https://example.org",
        "http://localhost.example.org",
        "http://notlocalhost",
        "http://127.0.0.1.example.org",
        "http://192.168.4.2",
        "null",
        "",
        "file://",
        "chrome-extension://127.0.0.1",
        "http://[::1",
        "http://127.0.0.1,http://example.org",
        "http://user@example.org#127.0.0.1",
    ],
)
def test_page_of_another_machine_is_admitted_only_if_named(origin: str) -> None:
    assert not admits_page(origin, "192.168.4.1", ())
    assert admits_page(origin.upper(), "192.168.4.1", {origin})


def test_mapped_address_is_the_same_machine() -> None:
    assert admits_page("http://192.168.4.1", "::ffff:192.168.4.1", ())
