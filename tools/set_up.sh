#!/bin/sh
# Make the virtual environment .venv, install locked packages into it, and compile the kernels.
# usage: tools/set_up.sh LOCK_FILE...
# The kernels are compiled while the packages that they do not need are installed.
# Prints one line per step, and the output of a step only if it fails. Installs Debian's
# python3-venv if it is missing and this user may install packages.
set -eu

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

step_of=set-up
. tools/steps.sh
compiling=
kernel_log=$(mktemp) compiler_lock=$(mktemp)
trap 'rm -f "$step_log" "$kernel_log" "$compiler_lock"; [ -z "$compiling" ] || kill "$compiling" 2>/dev/null || :' EXIT

# The lock lists every package with its hashes; packages that it does not list are not installed.
install() {
    .venv/bin/python -m pip install --disable-pip-version-check --no-deps "$@"
}

if [ ! -x .venv/bin/pip ]; then
    if ! "$python" -c 'import ensurepip' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        step "installing python$version-venv" tools/apt_install.sh "python$version-venv"
    fi
    step "virtual environment .venv with $("$python" --version)" "$python" -m venv .venv
fi
awk '/^[a-z]/ { on = /^(msgspec|pygeomag)==/ } on' requirements.lock |
    cat requirements-build.lock - >"$compiler_lock"
step "the packages that compile the kernels" \
    install --require-hashes --requirement "$compiler_lock"
if ! command -v cc >/dev/null; then
    step "a linker, as there is no C compiler" \
        install --require-hashes --requirement requirements-linker.lock
fi
.venv/bin/python -m tools.build_kernels >"$kernel_log" 2>&1 &
compiling=$!
for lock; do
    count=$(grep -c '^[A-Za-z]' "$lock")
    step "$count packages of $lock" install --require-hashes --requirement "$lock"
done
step "mavgate itself" install --no-build-isolation --editable .

end_of_compiling() {
    wait "$compiling" || { cat "$kernel_log"; return 1; }
    compiling=
}
step "the rest of compiling the kernels" end_of_compiling
