"""The endpoint spellings of other programs, read with their meaning.

| written                                        | by                         | here             |
| ---------------------------------------------- | -------------------------- | ---------------- |
| `udpin:`, `udpin://`, `udps:`                  | MAVProxy, MAVSDK, mavp2p   | `udp-listen:`    |
| `udpout:`, `udpout://`, `udpc:`                | MAVProxy, MAVSDK, mavp2p   | `udp:`           |
| `HOST:PORT`                                    | MAVProxy, mavlink-router   | `udp:`           |
| `udpbcast:`, `udpb:`                          | pymavlink, mavp2p          | `udp-broadcast:` |
| `tcp://`, `tcpout:`, `tcpout://`, `tcpc:`      | MAVSDK, pymavlink, mavp2p  | `tcp:`           |
| `tcpin:`, `tcpin://`, `tcps:`                  | MAVProxy, MAVSDK, mavp2p   | `tcp-listen:`    |
| `ws://`, `wss://`                              | browsers, pymavlink        | `ws:`, `wss:`    |
| `wsserver:`                                    | pymavlink                  | `ws-listen:`     |
| `serial://DEV:BAUD`, `DEV:BAUD`, `DEV,BAUD`    | MAVSDK, routers, MAVProxy  | `serial:`        |

`udp://` listens in MAVSDK, binds and sends in MAVROS, and looks like `udp:`, which sends here: it
is refused, and so is an address to send to that can only be one to listen on.
"""

from typing import Final

ALIASES: Final = {
    "udpin": "udp-listen",
    "udps": "udp-listen",
    "udpout": "udp",
    "udpc": "udp",
    "udpbcast": "udp-broadcast",
    "udpb": "udp-broadcast",
    "mcast": "udp-multicast",
    "tcpin": "tcp-listen",
    "tcps": "tcp-listen",
    "tcpout": "tcp",
    "tcpc": "tcp",
    "wsserver": "ws-listen",
}
ANY_ADDRESS: Final = "0.0.0.0"
SENDING: Final = frozenset({"udp", "tcp", "ws", "wss"})
LISTENING: Final = frozenset({"udp-listen", "tcp-listen", "ws-listen", "wss-listen"})


def respell(address: str) -> tuple[str, str]:
    """Read an endpoint without its options, in any of the spellings.

    Parameters
    ----------
    address : str
        In our own spelling or in one of the table above.

    Returns
    -------
    kind : str
        The word before our own first colon, whether there is such a kind or not.
    place : str
        What follows it.

    Raises
    ------
    ValueError
        If programs differ about its meaning; the error names the unambiguous spellings.
    """
    if address.startswith("/"):
        device, comma, baud = address.partition(",")
        return "serial", f"{device}:{baud}" if comma else address
    word, colon, place = address.partition(":")
    if colon and _is_bare(word, place):
        return "udp", address
    slashes = place.startswith("//")
    kind = ALIASES.get(word, word)
    place = place.removeprefix("//")
    if slashes and word == "udp":
        raise ValueError(_either(word, place))
    host, _, port = place.rpartition(":")
    if kind in LISTENING and not host:
        place = f"{ANY_ADDRESS}:{port}"
    elif kind in SENDING and port.isdecimal() and host in ("", ANY_ADDRESS, "[::]"):
        raise ValueError(_either(kind, place))
    return kind, place


def _is_bare(word: str, place: str) -> bool:
    """Return whether there is no kind: `HOST:PORT`, where a host has a dot or a bracket."""
    return (word.startswith("[") or "." in word or word == "localhost") and not (
        place.startswith("//")
    )


def _either(kind: str, place: str) -> str:
    """Return how to write both possible meanings."""
    host, _, port = place.rpartition(":")
    if not port.isdecimal():
        host, port = place, "PORT"
    anywhere = host in ("", ANY_ADDRESS, "[::]")
    listening = f"{host or ANY_ADDRESS}:{port}"
    sending = f"{'HOST' if anywhere else host}:{port}"
    return (
        f"write {kind}-listen:{listening} to wait for callers there, {kind}:{sending} to send there"
    )
