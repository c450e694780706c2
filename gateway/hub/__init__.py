"""The hub: MAVLink frames from any client to the clients that take them.

Theory of operation
-------------------

    bytes ─ compiled step: route in its table? ──yes── the clients of the route
                 │ no
    bytes ─ transport ─ MavFrame ─ cached route? ──yes── the clients of the route
                                        │ no
                                      Router ─┬─ our vehicles' requests (quota, one a turn)
                                              ├─ addressed: the clients behind which the target is
                                              └─ broadcast: a new route, which is kept
    our frames ─ queue (answers first) ─ Fanout ─ own route ─ numbered and signed ─ transport

1. A transport turns bytes into `MavFrame`s with the splitter. A frame's header is read once, there;
   after that everything uses the fields of the record, and the bytes are sent on unchanged.
2. `fanout.Fanout` keeps, for each source and kind of frame, a `Route`: the clients that get it. A
   route that needs nothing but the headers is entered into the table of `forwarding_step`, one
   compiled function that receives, checks, looks up and sends; it counts in bulk, and the counts
   are added a few times a second (`Route.settle`). Clients that need more of a frame than its
   bytes, such as a queue or a rate limit, get it from Python after that. The one rule: any change
   on which a route depends (clients, options, requested intervals, bandwidths, paths to a system,
   our vehicles) clears all routes, the table too, and the next frame of each kind is routed again.
3. `router.Router` handles frames without a cached route: our own that came back, round-trip
   requests, requests to our vehicles, frames that address a system, and the first broadcast of each
   kind. `routing_table.RoutingTable` has the paths to each system. `duplicates.DuplicateFilter`
   drops copies and late frames of systems that are received on several paths.
4. Our own frames wait in two queues, answers and telemetry, and some are sent at each turn of the
   event loop. When the processor is short of time, old telemetry is dropped and answers are not.
   `fanout.Fanout` renumbers for each client, so that filters leave no gaps; `FrameSigner` signs.
5. A client whose link is slow has a bounded `send_queue.SendQueue`, where answers and attitudes
   overtake; a link of known bandwidth gets telemetry at lower rates (`bandwidth.Bandwidth`).
6. Untrusted clients may cause a bounded number of reads, requests and answers (`limits`), are in no
   routing table, and reach our vehicles only.

An endpoint kind is one file in `transports/` over `base.Client` or `listener.Listener`, with
`datagram` and `stream` between for the common part of datagram sockets and of byte streams. No
transport blocks or raises; each closes itself on an error, and `tick` opens it again. Everything
but `transports/`, `hub.py`, `router.py` and the compiled step is pure: time is an argument, and
nothing is read or written.
"""
