"""Compiled code, made ready before samples wait for it."""

import asyncio
import gc
import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Final

from gateway.aircraft import AircraftSettings
from gateway.analysis.processes import begin_copy
from gateway.compiled.entry_point import EntryPoint
from gateway.compiled.machine_code import MachineCode, tell_of_compiling
from gateway.estimation.complementary.complementary_kernels import KERNELS as COMPLEMENTARY
from gateway.estimation.eskf.eskf_kernels import KERNELS as ESKF
from gateway.estimation.paper.paper_entry import step_live
from gateway.estimation.select import EstimationSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.tlog_scan import scan_at
from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuFlags, ImuRaw, NodeId

log = logging.getLogger(__name__)

REHEARSAL_US: Final = 100_000
SAMPLE_US: Final = 10_000
SCANNER: Final = "the reader of tlogs"
"""Shifts the times of a recording, once GPS tells the time."""
ENTRY_POINTS: Final[dict[str, tuple[EntryPoint[...], ...]]] = {
    "paper": (step_live,),
    "complementary": COMPLEMENTARY.live,
    "eskf": ESKF.live,
    SCANNER: (scan_at,),
}
"""The machine code that each estimator needs, the largest first, and what every gateway needs."""
LOAD_AGAIN_S: Final = 5.0
"""After which machine code is loaded that could not be, as there were no file descriptors left."""
BEHIND: Final = 10
"""Niceness of the process that compiles while telemetry runs."""


def is_kept(name: str) -> bool:
    """Return whether the machine code of an estimator, or of the scanner, is on disk."""
    return all(entry_point.is_kept for entry_point in ENTRY_POINTS[name])


def make_ready(*estimators: str) -> "Compilation | None":
    """Load estimators into this process; what is not compiled runs as Python meanwhile.

    The machine code is cached beside the source, so only the first start after an upgrade
    compiles, in a separate process while telemetry runs: the chosen estimators first, and then the
    others, since a ground station may choose one in flight. This process never imports the
    compiler, which needs more memory than everything else together.

    Parameters
    ----------
    *estimators : str
        Names of those in the settings, also several times.

    Returns
    -------
    Compilation, optional
        If something is compiled, to be watched by the event loop.
    """
    needed = dict.fromkeys((SCANNER, *estimators))
    ordered = needed | dict.fromkeys(ENTRY_POINTS)
    missing = [name for name in ordered if name in ENTRY_POINTS and not is_kept(name)]
    for name in missing:
        for entry_point in ENTRY_POINTS[name]:
            entry_point.interpret()
    for name in needed:
        _rehearse(name)
    if not missing:
        return None
    tell_of_compiling("compiling, this once: estimates cost more computing for a minute")
    return Compilation(missing)


class Compilation:
    """A process that compiles, and hands over machine code while telemetry runs.

    Parameters
    ----------
    names : sequence of str
        Of `ENTRY_POINTS`, in the order in which they are compiled.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._missing = {(name, k) for name in names for k in range(len(ENTRY_POINTS[name]))}
        self._received: deque[tuple[str, int, MachineCode]] = deque()
        """What is not loaded yet."""
        self._has_failed = False
        self._receiver = begin_copy(_compile, names)

    def watch(self) -> None:
        """Take the machine code as it comes; needs a running event loop."""
        loop = asyncio.get_running_loop()

        def receive() -> None:
            # A closed loop takes nothing more.
            with suppress(RuntimeError):
                while self._receive():
                    loop.call_soon_threadsafe(self._load)
                self._receiver.close()
                loop.call_soon_threadsafe(self._finish)

        def load_again() -> None:
            self._load()
            if self._received or not self._receiver.closed:
                loop.call_later(LOAD_AGAIN_S, load_again)

        # The loop would wait: a function is longer than a pipe holds, and the rest of it is long in
        # coming from the least urgent of all processes.
        threading.Thread(target=receive, daemon=True).start()
        load_again()

    def take_one(self) -> bool:
        """Wait for the next function, and load it if it can be; return whether there was one."""
        if self._receive():
            self._load()
            return True
        self._finish()
        return False

    def _receive(self) -> bool:
        """Wait for the next function; return whether there was one."""
        try:
            self._received.append(self._receiver.recv())
        except EOFError:
            return False
        return True

    def _finish(self) -> None:
        """Load what is left, and tell if something has never come."""
        self._load()
        if len(self._missing) > len(self._received):
            log.warning("the compiler has failed: estimates go on costing more computing")

    def _load(self) -> None:
        """Load what has been received, as far as that is possible now."""
        while self._received:
            name, place, code = self._received[0]
            try:
                ENTRY_POINTS[name][place].take(code)
            except (OSError, ImportError) as error:
                if not self._has_failed:
                    log.warning("machine code is loaded later: %s", error)
                self._has_failed = True
                return
            log.debug("machine code loaded: %s, function %d", name, place + 1)
            self._received.popleft()
            self._missing.discard((name, place))
            if not self._missing:
                log.info("everything is compiled; later starts find it so")


def _compile(names: Sequence[str], sender: Connection) -> None:
    # The parent ends it. A dead one it would report as a compiler that has failed.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(BEHIND)
    # The collector would take a fifth of the time.
    gc.disable()
    for name in names:
        for place, entry_point in enumerate(ENTRY_POINTS[name]):
            sender.send((name, place, entry_point.code()))


def _rehearse(name: str) -> None:
    """Load here what is cached, and do what comes with the first samples."""
    if name == SCANNER:
        scan_at.prepare()
        return
    settings = AircraftSettings(estimation=EstimationSettings(estimator=name))
    pipeline = Pipeline(PipelineSettings(settings))
    for record in _at_rest():
        pipeline.take(record, record.time_us)


def _at_rest() -> Iterator[ImuRaw | BaroRaw | GpsFix]:
    """Yield a fifth of a second of a node at rest, with every kind of record."""
    node = NodeId(1, 1)
    for time_us in range(REHEARSAL_US, 3 * REHEARSAL_US, SAMPLE_US):
        yield ImuRaw(
            time_us=time_us,
            node=node,
            node_time_us=time_us,
            accel_raw=(0, 0, -4096),
            gyro_raw=(0, 0, 0),
            mag_raw=(230, 0, 440),
            temperature_raw=0,
            accel_range_g=8,
            gyro_range_dps=1000,
            mag_lsb_per_gauss=1090,
            flags=ImuFlags.MAG_NEW,
        )
    yield BaroRaw(time_us, node, time_us, 101_325.0, 20.0)
    yield GpsFix(
        time_us=time_us,
        node=node,
        node_time_us=time_us,
        itow_ms=0,
        fix_type=GpsFixType.FIX_3D,
        fix_ok=True,
        satellites=9,
        lat_dege7=473_977_418,
        lon_dege7=85_455_938,
        alt_amsl_m=488.0,
        vel_n_mps=(0.0, 0.0, 0.0),
        alt_ellipsoid_m=536.0,
        h_acc_m=2.0,
        v_acc_m=3.0,
        speed_acc_mps=0.3,
        course_acc_deg=30.0,
        pdop=1.5,
        utc_us=None,
    )
