#!/bin/sh
# Make the virtual environment .venv, install locked packages into it, and compile the kernels.
# usage: tools/set_up.sh [LOCK_FILE...]
# Without a lock file only the kernels are compiled. The compiler is 280 MB that nothing else uses: unless
# a lock file lists it, it has a folder of its own, which is removed after the kernels are compiled.
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
compiler=$PWD/.venv/compiler
kernel_log=$(mktemp) lock_of_step=$(mktemp)
trap 'rm -rf "$step_log" "$kernel_log" "$lock_of_step" .venv/compiler; [ -z "$compiling" ] || kill "$compiling" 2>/dev/null || :' EXIT

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
# `entries NAME...` prints those entries of a lock file, `entries -v NAME...` all others.
entries() {
    [ "$1" = -v ] && { shift; keep=0; } || keep=1
    awk -v keep="$keep" -v names=" $* " '
        /^[A-Za-z]/ { name = $0; sub(/==.*/, "", name); on = (index(names, " " name " ") > 0) == keep } on'
}
case "$*" in *-dev.lock*) compiler= ;; esac
entries msgspec pygeomag <requirements.lock | cat requirements-build.lock - >"$lock_of_step"
step "the packages that compile the kernels: 80 MB${compiler:+, removed later}" \
    install ${compiler:+--target "$compiler" --no-compile} --require-hashes --requirement "$lock_of_step"
if ! command -v cc >/dev/null; then
    step "a linker, as there is no C compiler: 90 MB" install ${compiler:+--target "$compiler" --no-compile} \
        --require-hashes --requirement requirements-linker.lock
fi
PYTHONPATH=$compiler .venv/bin/python -m tools.build_kernels >"$kernel_log" 2>&1 &
compiling=$!
for lock; do
    case $lock in
        # The demo uses neither the fleet's package nor a second event loop.
        requirements.lock) size="96 MB" skipped="eclipse-zenoh uvloop" ;;
        *) size="420 MB" skipped= ;;
    esac
    # shellcheck disable=SC2086 # the list is meant to be split
    entries -v $skipped <"$lock" >"$lock_of_step"
    step "$(grep -c '^[A-Za-z]' "$lock_of_step") packages of $lock: $size" \
        install --no-compile --require-hashes --requirement "$lock_of_step"
done
# Not of tests, and of few dialects: they would be a third of the environment. A file of another version of
# Python, which no program imports, is no failure.
compile_bytecode() {
    .venv/bin/python -m compileall -q -j 0 .venv/lib \
        -x '/tests?/|pymavlink/(tools|generator|dialects/v[01]|dialects/v20/(?!all|common|ardupilotmega|minimal|standard))' || :
}
[ $# = 0 ] || step "bytecode" compile_bytecode
# Only here: pip would not install again what it finds in the folder of the compiler.
[ $# = 0 ] || PYTHONPATH=$compiler step "mavgate itself" install --no-build-isolation --editable .

end_of_compiling() {
    wait "$compiling" || { cat "$kernel_log"; return 1; }
    compiling=
}
step "the rest of compiling the kernels" end_of_compiling
