"""The example sketches: those whose libraries Debian has compile for an AVR."""

import shutil
import subprocess
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parent.parent.parent / "firmware" / "examples"
ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
FOLDERS = ("cores/arduino", "variants/mega", "libraries/Wire/src", "libraries/SPI/src")
NOT_COMPILED = "// Not compiled by the project's tests"
SKETCHES = [p for p in sorted(EXAMPLES.glob("*/*.ino")) if NOT_COMPILED not in p.read_text()]


@pytest.mark.io
@pytest.mark.parametrize("sketch", SKETCHES, ids=[path.stem for path in SKETCHES])
def test_sketch_compiles_for_avr_without_a_warning(sketch: Path, tmp_path: Path) -> None:
    if not ARDUINO.is_dir() or shutil.which("avr-g++") is None:
        pytest.skip("gcc-avr or arduino-core-avr not found: apt-get install both")
    program = tmp_path / "sketch.cpp"
    program.write_text(f'#include <Arduino.h>\n#line 1 "{sketch.name}"\n{sketch.read_text()}')
    command = ["avr-g++", "-c", "-std=gnu++11", "-Os", "-Wall", "-Werror", "-mmcu=atmega2560"]
    command += ["-DF_CPU=16000000UL", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR"]
    command += [f"-I{ARDUINO / folder}" for folder in FOLDERS]
    done = subprocess.run([*command, program, "-o", tmp_path / "sketch.o"], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


def test_only_sketches_of_other_libraries_are_marked_as_not_compiled() -> None:
    assert [path.stem for path in SKETCHES] == ["lines_mpu6050"]
