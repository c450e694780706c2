"""The keys of a fleet and its sites.

| key                          | meaning                                                     |
| ---------------------------- | ----------------------------------------------------------- |
| `mavlink/SITE/SYSTEM/out`    | frames of a system of the site                              |
| `mavlink/SITE/SYSTEM/in`     | frames for a system of the site; `0` is for all             |
| `mavlink/SITE/site/SESSION`  | a liveliness token of one session of the site               |
| `mavlink/SITE/ping`          | the site answers queries at once                            |
| `mavlink/SITE/recordings`    | the site answers queries for its recordings                 |
| `mavlink_raw/out`, `…/in`    | frames without sites, as mavlink-server has them            |
| `mavlink/out`, `…/in`        | messages as JSON, as mavlink-server has them by default     |
| `mavlink/SYSTEM/COMPONENT/NAME[/FIELD]` | the newest one of each kind, and its fields      |

`OWN` is attached to frames of the site's own gateway. The hub accepts no frame in their name from a
client, so such a frame began here and has not gone round a loop. Frames of a client of the site, as
of an autopilot behind it, and of other programs have no attachment.
"""

from typing import Final

ROOT: Final = "mavlink"
ALL_SYSTEMS: Final = "*"
OWN: Final = b"own"
RAW_OUT: Final = "mavlink_raw/out"
RAW_IN: Final = "mavlink_raw/in"
JSON_OUT: Final = "mavlink/out"
JSON_IN: Final = "mavlink/in"
MAX_KEY: Final = 256
"""Letters of a key; ours have at most 150."""


def out_key(site: str, system: object) -> str:
    """Return the key of frames of a system of a site."""
    return f"{ROOT}/{site}/{system}/out"


def in_key(site: str, system: object) -> str:
    """Return the key of frames for a system of a site."""
    return f"{ROOT}/{site}/{system}/in"


def presence_key(site: str, session: object) -> str:
    """Return the key of the token of one session of a site."""
    return f"{ROOT}/{site}/site/{session}"


def ping_key(site: str) -> str:
    """Return the key whose queries a site answers at once, to measure the round trip."""
    return f"{ROOT}/{site}/ping"


def recordings_key(site: str) -> str:
    """Return the key of queries for a site's recordings."""
    return f"{ROOT}/{site}/recordings"


def site_of(key: str) -> str:
    """Return the site of a key; empty if the key is not one of the table."""
    parts = key.split("/")
    return parts[1] if len(parts) in (3, 4) and parts[0] == ROOT else ""
