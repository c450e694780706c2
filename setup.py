"""The part of the build that pyproject.toml cannot declare: the library of compiled kernels."""

import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
LIBRARY = Path("gateway", "compiled", "kernels.so")
PORTABLE = "manylinux_2_17_"
"""Begins the platform of a wheel that runs with this version of the C library, or a later one."""


class BuildWithKernels(build_py):
    """Adds the library to the packages, unless they are used from the source tree."""

    def run(self) -> None:
        """Copy the packages, and add the compiled kernels."""
        super().run()
        if not self.editable_mode:
            library = Path(self.build_lib).resolve() / LIBRARY
            platform = self.get_finalized_command("bdist_wheel").plat_name or ""
            words = [sys.executable, "-m", "tools.build_kernels"]
            if platform.startswith(PORTABLE):
                words += ["--architecture", platform.removeprefix(PORTABLE)]
                subprocess.run([*words, "--output", str(library)], cwd=ROOT, check=True)
            else:
                subprocess.run(words, cwd=ROOT, check=True)
                self.copy_file(str(ROOT / LIBRARY), str(library))


class PlatformWheel(bdist_wheel):
    """Marks the wheel as one for any Python 3, as the library is no extension module."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of Python, its binary interface and the platform."""
        return ("py3", "none", super().get_tag()[2])


class PlatformDistribution(Distribution):
    """Contains machine code."""

    def has_ext_modules(self) -> bool:
        """Return whether the wheel is for one platform only."""
        return True


setup(
    cmdclass={"bdist_wheel": PlatformWheel, "build_py": BuildWithKernels},
    distclass=PlatformDistribution,
)
