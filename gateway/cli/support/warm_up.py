"""Compiled code, made ready before samples wait for it."""

import gc
import logging
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Final

from gateway.aircraft import AircraftSettings
from gateway.analysis.processes import begin_copy, run_copies
from gateway.cli.support.terminal import console_of
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.complementary.complementary_kernels import KERNELS as COMPLEMENTARY
from gateway.estimation.eskf.eskf_kernels import KERNELS as ESKF
from gateway.estimation.paper.paper_entry import step_live
from gateway.estimation.select import EstimationSettings
from gateway.flightlog.tlog.tlog_scan import scan_at
from gateway.pipeline import Pipeline, PipelineSettings
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
BEHIND: Final = 10
"""Niceness of the process that compiles while telemetry runs."""


def is_kept(name: str) -> bool:
    """Return whether the machine code of an estimator, or of the scanner, is on disk."""
    return all(entry_point.is_kept for entry_point in ENTRY_POINTS[name])


def make_ready(*estimators: str) -> None:
    """Load or compile estimators in this process, and compile the others in the background.

    The machine code is cached beside the source, so only the first start after an upgrade
    compiles: the chosen estimators first, and then the others in a separate process while telemetry
    runs, since a ground station may choose one in flight, when compiling would interrupt the
    attitude for seconds; loading one from disk takes some hundredths of a second. This process
    never imports the compiler, which needs more memory than everything else together.

    Parameters
    ----------
    *estimators : str
        Names of those in the settings.
    """
    missing = [name for name in ENTRY_POINTS if not is_kept(name)]
    if chosen := [name for name in missing if name in (*estimators, SCANNER)]:
        log.info("compiling %s, this once; later starts take a second", " and ".join(chosen))
        begin = time.monotonic()
        with _clock() as show:
            # In separate processes, because the compiler's memory is never freed; this one reads
            # the cache. The largest entry point takes as long as all others together.
            largest = [ENTRY_POINTS[name][0] for name in chosen if name != SCANNER]
            others = [point for name in chosen for point in ENTRY_POINTS[name]]
            shares = [largest, [point for point in others if point not in largest]]
            run_copies(_compile, filter(None, shares), show)
        log.info("compiled in %.0f s", time.monotonic() - begin)
    for name in (*estimators, SCANNER):
        _rehearse(name)
    if behind := [name for name in missing if name not in chosen]:
        log.info("compiling %s for a later choice, behind the telemetry", " and ".join(behind))
        begin_copy(_compile_behind, behind)


@contextmanager
def _clock() -> Iterator[Callable[[], None]]:
    """Show on a terminal that work is in progress, and for how long."""
    # Imported here: most starts compile nothing.
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = console_of(stderr=True)
    # Without a thread: the process that compiles is forked from this one.
    with Progress(
        SpinnerColumn(), TextColumn("compiling the estimator, this once"), TimeElapsedColumn(),
        console=console, transient=True, auto_refresh=False, disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        progress.add_task("", total=None)
        yield progress.refresh


def _compile(entry_points: Iterable[EntryPoint[...]]) -> None:
    # The parent reports an interrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # The collector would take a fifth of the time.
    gc.disable()
    for entry_point in entry_points:
        entry_point.prepare()


def _compile_behind(names: Iterable[str]) -> None:
    os.nice(BEHIND)
    for name in names:
        _compile(ENTRY_POINTS[name])


def _rehearse(name: str) -> None:
    """Load here what is cached, or could not be."""
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
