"""The keys under which a fleet finds its sites.

| key                          | what                                                        |
| ---------------------------- | ----------------------------------------------------------- |
| `mavlink/SITE/SYSTEM/out`    | frames of a system of the site                              |
| `mavlink/SITE/SYSTEM/in`     | frames for a system of the site; `0` is for all             |
| `mavlink/SITE/site/SESSION`  | a token that lives as long as the site's session does       |
| `mavlink/SITE/ping`          | the site answers queries at once                            |
| `mavlink/SITE/recordings`    | the site answers queries for its recordings                 |
| `mavlink_raw/out`, `…/in`    | the same without sites, as mavlink-server has it            |

`OWN` is attached to what a site publishes for its gateway's own vehicles. The hub takes no frame in
their name from a client, so such a frame began here and has not gone round any loop. What a client
of the site sent, as an autopilot behind it, and what other programs publish has no attachment.
"""

from typing import Final

ROOT: Final = "mavlink"
ALL_SYSTEMS: Final = "*"
OWN: Final = b"own"


def out_key(site: str, system: object) -> str:
    """Return where frames of a system of a site are published."""
    return f"{ROOT}/{site}/{system}/out"


def in_key(site: str, system: object) -> str:
    """Return where frames for a system of a site are published."""
    return f"{ROOT}/{site}/{system}/in"


def presence_key(site: str, session: object) -> str:
    """Return the token of one session of a site."""
    return f"{ROOT}/{site}/site/{session}"


def ping_key(site: str) -> str:
    """Return where a site answers at once, so that the round trip can be measured."""
    return f"{ROOT}/{site}/ping"


def recordings_key(site: str) -> str:
    """Return where a site answers for its recordings."""
    return f"{ROOT}/{site}/recordings"


def site_of(key: str) -> str:
    """Return the site that a key belongs to; empty if it is none of ours."""
    parts = key.split("/")
    return parts[1] if len(parts) in (3, 4) and parts[0] == ROOT else ""
