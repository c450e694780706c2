"""Write the golden flights of `tests/golden`: a short simulated log, and its fused states.

    python -m tools.make_golden [--expected-only]

The expected files are a change indicator: run this after a change of an estimator, commit the
difference, and explain it in the commit.
"""

import argparse
import csv
import gzip
import io
import tempfile
from pathlib import Path

from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.records import BaroRaw, GpsFix
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import DEGE7_PER_DEG
from tools.simulated_flight import fly

GOLDEN = Path(__file__).resolve().parent.parent / "tests" / "golden"
SEED = 77
SECONDS = 75.0
RATE_HZ = 25
EVERY = 50
"""Interval of the stored fused rows."""
ESTIMATORS = ("eskf", "paper")
NAMES = (
    *("time_s", "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "baro_alt_m"),
    *("gps_time_s", "gps_lat", "gps_lon", "gps_alt_m", "gps_vn", "gps_ve", "gps_vd"),
)


def write_log(path: Path) -> None:
    """Simulate a take-off and first turns; GPS is lost for five seconds."""
    outages = ((50.0, 5.0),)
    settings = SimulatorSettings(seed=SEED, imu_rate_hz=RATE_HZ, gps_outages_s=outages)
    flown = fly(settings, duration_s=SECONDS)
    errors = flown.errors
    chain = SensorChain(
        NodeCalibration(
            mag_hard_iron_ut=errors["mag_hard_iron_ut"], mag_soft_iron=errors["mag_soft_iron"]
        ),
    )
    text = io.StringIO()
    text.write(f"# simulated seed={SEED} gps_latency_s={settings.gps_latency_s}\n")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(NAMES)
    baro, gps = [""], [""] * 7
    for record in flown.records():
        match record:
            case BaroRaw():
                baro = [f"{chain.baro(record).alt_pressure_m:.3f}"]
            case GpsFix():
                if record.fix_ok:
                    place = (record.lat_dege7 / DEGE7_PER_DEG, record.lon_dege7 / DEGE7_PER_DEG)
                    vel = [f"{v:.3f}" for v in record.vel_n_mps]
                    gps = [f"{record.time_us / 1e6:.6f}", *(f"{p:.7f}" for p in place)]
                    gps += [f"{record.alt_amsl_m:.3f}", *vel]
            case _:
                sample = chain.imu(record)
                si = [f"{v:.4f}" for v in (*sample.accel_b_mps2, *sample.gyro_b_radps)]
                mag = [f"{v:.2f}" for v in sample.mag_b_ut] if sample.mag_b_ut else [""] * 3
                rows.writerow([f"{record.time_us / 1e6:.6f}", *si, *mag, *baro, *gps])
                baro, gps = [""], [""] * 7
    path.write_bytes(gzip.compress(text.getvalue().encode(), mtime=0))


def fused(log: Path, estimator: str) -> list[str]:
    """Fuse the log with the defaults; keep one row in `EVERY`, and the head."""
    with tempfile.TemporaryDirectory() as folder:
        settings, out = Path(folder) / "defaults.toml", Path(folder) / "out.csv"
        settings.write_text("[estimation.reference]\ngps_latency_s = 0.16\n")
        arguments = ["fuse", str(log), "-o", str(out), "--estimator", estimator]
        result = CliRunner().invoke(app, [*arguments, "--config", str(settings)])
        if result.exit_code != 0:
            raise RuntimeError(result.output)
        lines = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    names, *rows = csv.reader(lines)
    kept = [k for k, name in enumerate(names) if name == "time_us" or name.startswith("nav_")]
    states = [row for row in rows if row[names.index("nav_time_us")]]
    return [",".join(row[k] for k in kept) for row in [names, *states[::EVERY]]]


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--expected-only", action="store_true", help="keep the log")
    log = GOLDEN / "take_off.csv.gz"
    if not parser.parse_args().expected_only:
        write_log(log)
    for estimator in ESTIMATORS:
        lines = fused(log, estimator)
        (GOLDEN / f"take_off.{estimator}.expected.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
