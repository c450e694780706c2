#!/bin/sh
# Make the virtual environment .venv and install the locked packages into it.
# usage: tools/set_up.sh LOCK_FILE
# Installs Debian's python3-venv if it is missing and this user may install packages.
set -eu
lock=$1
python=${PYTHON:-}
if [ -z "$python" ]; then
    for candidate in python3.11 python3 python3.12 python3.13; do
        if command -v "$candidate" >/dev/null &&
            "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
            python=$candidate
            break
        fi
    done
fi
if [ -z "$python" ]; then
    echo "set-up: no Python 3.11 or newer found; install it or set PYTHON=/path/to/python3" >&2
    exit 1
fi
if [ ! -x .venv/bin/pip ]; then
    if ! "$python" -c 'import ensurepip' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        tools/apt_install.sh "python$version-venv"
    fi
    echo "set-up: making the virtual environment .venv with $("$python" --version)"
    "$python" -m venv .venv
fi
echo "set-up: installing the packages of $lock (some minutes the first time)"
# The lock lists every package: --no-deps keeps what it leaves out from coming in.
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r "$lock"
if ! command -v cc >/dev/null; then
    echo "set-up: installing a linker, since there is no C compiler"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
        -r requirements-linker.lock
fi
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps \
    --no-build-isolation --editable .
echo "set-up: compiling the kernels"
.venv/bin/python -m tools.build_kernels
