"""The statistics of a client before anything was received or sent."""

from gateway.hub.stats import ClientStats

TABLET = ClientStats(
    client_id=1,
    name="tablet",
    endpoint="udp:10.0.0.7:14550",
    remote="10.0.0.7:14550",
    state="open",
    trusted=True,
    systems=(),
    sent=0,
    dropped=0,
    bytes_sent=0,
    received=0,
    bytes_received=0,
    bytes_garbage=0,
    queued=0,
    since_us=0,
    heard_us=None,
    round_trip_us=None,
)
